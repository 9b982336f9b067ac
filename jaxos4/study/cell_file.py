"""The file of a finished cell: its results as NumPy arrays."""

import io

import numpy as np

from ..results import NAMES

OUTCOMES = (*NAMES, "failed", "not_run")
"""How an estimate ended. `failed`: its cell could not be computed; `not_run`: not yet. Files hold the place in here."""

LEVELS = (0.5, 0.9, 0.95, 0.99)
"""The levels of the intervals that are kept."""


def encode(results: dict[str, np.ndarray]) -> bytes:
    """The bytes of a cell's file; equal results give equal bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, **results)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def decode(data: bytes) -> dict[str, np.ndarray]:
    """The results in the bytes of a cell's file. Raises an exception of `_files.BROKEN` for other bytes."""
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def failed(message: str) -> dict[str, np.ndarray]:
    """The results of a cell that could not be computed: the reason, in one line."""
    return {"failed": np.asarray(" ".join(message.split())[:500])}
