"""The files of designs: a flight CSV with `t` and `omega1..4` alone, and a CSV of references."""

import os
from os import PathLike

import numpy as np
from jaxtyping import Float

from .._files import write_atomically
from ..errors import InputError
from ..flight import STATE_NAMES, Flight
from ..logs import write_flight
from ..logs.assemble import SPEED_NAMES
from ..logs.csv import read_table
from ..logs.table import printable
from .task import Designed, Inputs

_REFERENCE_NAMES = ("roll_reference", "pitch_reference", "yaw_reference", "az_reference")
# The largest error of a sample time, as a share of it.
_PRECISION = 1e-3


def write_input(designed: Designed, path: str | PathLike[str]) -> None:
    """Write rotor speeds as a flight CSV with the columns t and omega1..4."""
    samples = designed.inputs.shape[0]
    nothing = np.full((samples, len(STATE_NAMES)), np.nan)
    write_flight(Flight(designed.dt * np.arange(samples), designed.inputs, nothing), path)


def write_references(designed: Designed, path: str | PathLike[str]) -> None:
    """Write references as CSV, with the columns t, roll_reference, pitch_reference, yaw_reference and az_reference."""
    rows = np.column_stack([designed.dt * np.arange(len(designed.inputs)), designed.inputs])
    with write_atomically(path) as beside:
        np.savetxt(beside, rows, delimiter=",", header=",".join(("t", *_REFERENCE_NAMES)), comments="", fmt="%.8g")


def read_input(path: str | PathLike[str], dt: float) -> Float[np.ndarray, "samples 4"]:
    """Read rotor speeds [rad/s] with the sample time `dt` [s]. Other columns are ignored.

    **Raises:** `InputError`, one line: file, what is wrong and what to do.
    """
    time, omega, name = _read(path, SPEED_NAMES, "an input has t and omega1..4")
    if not (np.isfinite(time).all() and (omega >= 0).all()):
        raise InputError(f"{name}: a cell is empty or negative; give every rotor speed of every sample.")
    if len(time) < 2 or np.abs(np.diff(time) - dt).max() > _PRECISION * dt:
        raise InputError(f"{name}: is not sampled every {dt:g} s; design the input with this sample time.")
    return omega


def read_references(path: str | PathLike[str]) -> tuple[Inputs, float]:
    """Read references and their sample time [s]. Other columns are ignored.

    **Raises:** `InputError`, one line: file, what is wrong and what to do.
    """
    time, references, name = _read(path, _REFERENCE_NAMES, f"references have t, {', '.join(_REFERENCE_NAMES)}")
    if not (np.isfinite(time).all() and np.isfinite(references).all()):
        raise InputError(f"{name}: a cell is empty; give every reference at every sample.")
    steps = np.diff(time)
    if not steps.size or not np.all(np.abs(steps - steps.mean()) < _PRECISION * steps.mean()):
        raise InputError(f"{name}: is not sampled at equal times; give one row for each sample.")
    return references, float(steps.mean())


def _read(path: str | PathLike[str], names: tuple[str, ...], contents: str) -> tuple[np.ndarray, np.ndarray, str]:
    """Times, the columns `names`, and the name of the file for messages."""
    columns, name = read_table(path, ("t", *names)).columns, printable(os.fspath(path))
    missing = [column for column in ("t", *names) if column not in columns]
    if missing:
        raise InputError(f"{name}: column {missing[0]} is missing; {contents}.")
    return columns["t"], np.stack([columns[column] for column in names], axis=1), name
