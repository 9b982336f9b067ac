"""The file of references: a CSV with `t` [s], three angles [rad] and the vertical acceleration [m/s^2]."""

import os
from os import PathLike

import numpy as np

from .._files import write_atomically
from ..errors import InputError
from ..logs.csv import read_table
from ..logs.table import printable
from .closed_loop import DesignedReferences
from .input_file import PRECISION
from .references import Shape

COLUMNS = ("t", "roll_reference", "pitch_reference", "yaw_reference", "az_reference")


def write_references(designed: DesignedReferences, path: str | PathLike[str]) -> None:
    """Write references as CSV, with the columns t, roll_reference, pitch_reference, yaw_reference and az_reference."""
    rows = np.column_stack([designed.dt * np.arange(len(designed.references)), designed.references])
    with write_atomically(path) as beside:
        np.savetxt(beside, rows, delimiter=",", header=",".join(COLUMNS), comments="", fmt="%.8g")


def read_references(path: str | PathLike[str]) -> tuple[Shape, float]:
    """Read references and their sample time [s]. Other columns are ignored.

    **Raises:** `InputError`, one line: file, what is wrong and what to do.
    """
    columns, name = read_table(path, COLUMNS).columns, printable(os.fspath(path))
    missing = [column for column in COLUMNS if column not in columns]
    if missing:
        raise InputError(f"{name}: column {missing[0]} is missing; references have {', '.join(COLUMNS)}.")
    time, *references = (columns[column] for column in COLUMNS)
    if not np.isfinite([time, *references]).all():
        raise InputError(f"{name}: a cell is empty; give every reference at every sample.")
    steps = np.diff(time)
    if not steps.size or not np.all(np.abs(steps - steps.mean()) < PRECISION * steps.mean()):
        raise InputError(f"{name}: is not sampled at equal times; give one row for each sample.")
    return np.stack(references, axis=1), float(steps.mean())
