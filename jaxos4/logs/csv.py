"""The flight CSV: the project's own log format.

The first row holds the names of the columns, in any order. Cells are separated by commas.

| column | unit | content |
| --- | --- | --- |
| `t` | s | time; it must increase |
| `omega1..4` | rad/s | measured rotor speeds |
| `command1..4` | 0..1 | commands, as fractions of the airframe's `max_rotor_speed` |
| `x, y, z` | m | position |
| `vx, vy, vz` | m/s | velocity |
| `phi, theta, psi` | rad | roll, pitch, yaw |
| `p, q, r` | rad/s | body rates |
| `ax, ay, az` | m/s^2 | specific force |
| `voltage` | V | the battery's voltage |

A missing column or an empty cell means that the value was not measured. Voltage is interpolated over empty cells. A
flight needs `t`, all four rotors (speeds or commands), and at least one of the twelve states of Eq. (14).
"""

import csv
import os
import warnings

import numpy as np

from .._files import write_atomically
from ..airframe import Airframe
from ..errors import InputError
from ..flight import FORCE_NAMES, STATE_NAMES, Flight
from .assemble import COLUMN_NAMES as COLUMN_NAMES, COMMAND_NAMES, SPEED_NAMES, flight_of
from .csv_text import read_table
from .table import LogFormat, Path, printable

_ROWS_AT_ONCE = 8192


def read_flight(path: Path, airframe: Airframe | None = None) -> Flight:
    """Read a flight from a CSV file. The columns are listed in `jaxos4.logs.csv`.

    **Arguments:**

    - `airframe`: its `max_rotor_speed` turns `command1..4` into rotor speeds. A file with `omega1..4` needs none.

    **Returns:** a `Flight`. Rows within 1 % of a uniform time grid keep their values. Other rows are resampled to such
    a grid (see `jaxos4.logs.resample`). Jumps of 2 pi in roll and yaw are removed.

    **Raises:** `InputError`, one line: file, row, column, what is wrong and what to do.

    **Warns:** `UserWarning` for each change to the data: resampling, empty cells of a rotor, ignored columns.
    """
    flight, notes = read_flight_and_notes(path, airframe)
    for note in notes:
        warnings.warn(f"{printable(os.fspath(path))}: {note}.", UserWarning, stacklevel=2)
    return flight


def read_flight_and_notes(
    path: Path, airframe: Airframe | None = None, *, full_scale: float | None = None
) -> tuple[Flight, tuple[str, ...]]:
    """Read a flight, and return the warnings of `read_flight` as notes; `full_scale` is as in `read_log`."""
    return flight_of(read_table(path, COLUMN_NAMES), airframe, full_scale=full_scale)


CSV = LogFormat("CSV", "flight CSV", lambda begin: True, lambda path: (read_table(path, COLUMN_NAMES), ()))


def write_flight(flight: Flight, path: Path, airframe: Airframe | None = None) -> None:
    """Write a flight as CSV: `t`, `omega1..4`, and the measured columns of states, specific force and voltage.

    Reading the file gives back every bit. If writing fails, an older file at `path` is unchanged.

    **Arguments:**

    - `airframe`: its `max_rotor_speed` turns the rotor speeds of a `commanded` flight into `command1..4`. Without it,
      the file has `omega1..4`, and a reader takes them for measured speeds.

    **Raises:** `InputError` for a batch of flights, or for values that a file cannot contain (an infinity, a rotor
    speed that is not finite); `OSError` if the file cannot be written.
    """
    if flight.time.ndim != 1:
        raise InputError(
            f"{printable(os.fspath(path))}: one file holds one flight, got a batch of shape {flight.time.shape[:-1]}; "
            "write each flight to its own file."
        )
    names, omega = SPEED_NAMES, np.asarray(flight.omega)
    if flight.commanded and airframe is not None and np.isfinite(airframe.max_rotor_speed):
        names, omega = COMMAND_NAMES, omega / np.asarray(airframe.max_rotor_speed)
    columns = {"t": np.asarray(flight.time), **dict(zip(names, omega.T, strict=True))}
    for name, column in columns.items():
        _check_cells(path, name, column, np.isfinite(column))
    measured: dict[str, np.ndarray] = dict(zip(STATE_NAMES, np.asarray(flight.states).T, strict=True))
    if flight.specific_force is not None:
        measured.update(zip(FORCE_NAMES, np.asarray(flight.specific_force).T, strict=True))
    if flight.voltage is not None:
        measured["voltage"] = np.asarray(flight.voltage)
    for name, column in measured.items():
        _check_cells(path, name, column, ~np.isinf(column))
        if not np.isnan(column).all():
            columns[name] = column
    with write_atomically(path) as beside, open(beside, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for start in range(0, flight.time.shape[0], _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            cells = [np.where(np.isnan(c[rows]), "", c[rows].astype(str)).tolist() for c in columns.values()]
            writer.writerows(zip(*cells, strict=True))


def _check_cells(path: Path, name: str, column: np.ndarray, usable: np.ndarray) -> None:
    if not usable.all():
        index = int(np.argmin(usable))
        raise InputError(
            f"{printable(os.fspath(path))}: sample {index}, column {name}: is {column[index]}, "
            "which a flight file cannot contain; cut the flight before it."
        )
