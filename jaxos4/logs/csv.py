"""Flights in CSV files.

A header row, then numbers in SI units, separated by commas:

- `t` [s], increasing.
- `omega1..4` [rad/s], measured rotor speeds, or `command1..4`, fractions 0..1 of the airframe's `max_rotor_speed`.
- any of `x, vx, y, vy, z, vz, phi, p, theta, q, psi, r`: the states of Eq. (14), in m, m/s, rad and rad/s.
- any of `ax, ay, az` [m/s^2]: specific force.

A column that is missing and a cell that is empty were not measured.
"""

import csv
import os
import warnings

import numpy as np

from .._files import write_atomically
from ..airframe import Airframe
from ..errors import InputError
from ..flight import STATE_NAMES, Flight
from ._assemble import COLUMN_NAMES as COLUMN_NAMES, FORCE_NAMES, SPEED_NAMES, flight_of
from ._table import printable, read_table

_ROWS_AT_ONCE = 8192


def read_flight(path: str | os.PathLike[str], airframe: Airframe | None = None) -> Flight:
    """The flight in a CSV file; this module's docstring tells the format.

    **Arguments:**

    - `path`: the file.
    - `airframe`: needed where the file holds `command1..4`: its `max_rotor_speed` turns them into rotor speeds.

    **Returns:** a `Flight`. Rows within 1 % of a uniform time grid stand as they were recorded; others are resampled
    (`jaxos4.logs.resample`). Jumps of a turn in roll and yaw are taken out.

    **Raises:** `InputError`, one line: file, row, column, what is wrong and what to do.

    **Warns:** `UserWarning` for what was done to the data: resampling, rotor speeds held over empty cells, unknown
    columns.
    """
    flight, notes = read_flight_and_notes(path, airframe)
    for note in notes:
        warnings.warn(f"{printable(os.fspath(path))}: {note}.", UserWarning, stacklevel=2)
    return flight


def read_flight_and_notes(
    path: str | os.PathLike[str], airframe: Airframe | None = None, *, full_scale: float | None = None
) -> tuple[Flight, tuple[str, ...]]:
    """`read_flight` with its warnings as values: one line each, without the file's name.

    `full_scale`: as `jaxos4.logs.read_log` has it.
    """
    return flight_of(read_table(path, COLUMN_NAMES), airframe, full_scale=full_scale)


def write_flight(flight: Flight, path: str | os.PathLike[str]) -> None:
    """Write a flight as CSV: `t`, `omega1..4`, what was measured of the twelve states and the specific force.

    Numbers are written so that reading gives back every bit, and the file is whole or as it was before.

    **Raises:** `InputError` where the flight holds what a file cannot (an infinity, a rotor speed that is not finite)
    or is a batch; `OSError` where the file cannot be written.
    """
    if flight.time.ndim != 1:
        raise InputError(
            f"{printable(os.fspath(path))}: one file holds one flight, got a batch of shape {flight.time.shape[:-1]}."
        )
    columns = {"t": np.asarray(flight.time), **dict(zip(SPEED_NAMES, np.asarray(flight.omega).T, strict=True))}
    for name, column in columns.items():
        _refuse_to_write(path, name, column, ~np.isfinite(column))
    measured: dict[str, np.ndarray] = dict(zip(STATE_NAMES, np.asarray(flight.states).T, strict=True))
    if flight.specific_force is not None:
        measured.update(zip(FORCE_NAMES, np.asarray(flight.specific_force).T, strict=True))
    for name, column in measured.items():
        _refuse_to_write(path, name, column, np.isinf(column))
        if not np.isnan(column).all():
            columns[name] = column
    with write_atomically(path) as beside, open(beside, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for start in range(0, flight.time.shape[0], _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            cells = [np.where(np.isnan(c[rows]), "", c[rows].astype(str)).tolist() for c in columns.values()]
            writer.writerows(zip(*cells, strict=True))


def _refuse_to_write(path: str | os.PathLike[str], name: str, column: np.ndarray, unusable: np.ndarray) -> None:
    if unusable.any():
        index = int(np.argmax(unusable))
        raise InputError(
            f"{printable(os.fspath(path))}: sample {index}, column {name}: is {column[index]}, "
            "which a flight file cannot hold; cut the flight before it."
        )
