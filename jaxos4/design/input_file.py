"""The file of an input: a flight CSV with `t` and `omega1..4` alone."""

import os
from os import PathLike

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from ..flight import STATE_NAMES, Flight
from ..logs import write_flight
from ..logs.assemble import SPEED_NAMES
from ..logs.csv import read_table
from ..logs.table import printable
from .fitting import DesignedInput

# How far a sample time may be off, as a share of it.
PRECISION = 1e-3


def write_input(designed: DesignedInput, path: str | PathLike[str]) -> None:
    """Write the rotor speeds of an input."""
    samples = designed.omega.shape[0]
    nothing = np.full((samples, len(STATE_NAMES)), np.nan)
    write_flight(Flight(designed.dt * np.arange(samples), designed.omega, nothing), path)


def read_input(path: str | PathLike[str], dt: float) -> Float[np.ndarray, "samples 4"]:
    """Read rotor speeds [rad/s] with the sample time `dt` [s]. Other columns are ignored.

    **Raises:** `InputError`, one line: file, what is wrong and what to do.
    """
    columns = read_table(path, ("t", *SPEED_NAMES)).columns
    name = printable(os.fspath(path))
    missing = [column for column in ("t", *SPEED_NAMES) if column not in columns]
    if missing:
        raise InputError(f"{name}: column {missing[0]} is missing; an input has t and omega1..4.")
    omega, time = np.stack([columns[rotor] for rotor in SPEED_NAMES], axis=1), columns["t"]
    if not (np.isfinite(time).all() and (omega >= 0).all()):
        raise InputError(f"{name}: a cell is empty or negative; give every rotor speed of every sample.")
    if len(time) < 2 or np.abs(np.diff(time) - dt).max() > PRECISION * dt:
        raise InputError(f"{name}: is not sampled every {dt:g} s; design the input with this sample time.")
    return omega
