"""Files of recorded flights to `Recording` and `Flight`, and back to CSV.

Each log format is one file and one line in `FORMATS`, or an entry point of another package in `jaxos4.log_formats`.
"""

import itertools
import os
import warnings
from typing import Any

from .._registry import Registry
from ..airframe import Airframe
from ..errors import printable
from ..flight import Flight
from .ardupilot import ARDUPILOT
from .assemble import recording_of
from .blackbox import BLACKBOX
from .columns import ColumnsGiven, array_table, column_map
from .crazyflie import CRAZYFLIE
from .csv import CSV, NEUROBEM, write_flight as write_flight
from .ros import ROS
from .table import (
    LogFacts as LogFacts,
    LogFormat as LogFormat,
    Path,
    Recording as Recording,
    Sampling as Sampling,
    Table as Table,
    opened,
    refuse,
)
from .ulog import ULOG
from .unread import unread_kind

FORMATS: tuple[LogFormat, ...] = (ULOG, ROS, ARDUPILOT, CRAZYFLIE, BLACKBOX, NEUROBEM, CSV)
"""The formats in the order in which they are tried. A new format is one line here, before the last."""
_OTHERS: Registry[LogFormat] = Registry("jaxos4.log_formats", {})

_FIRST_BYTES = 1 << 18


def read_log(
    log: Path | Any,
    airframe: Airframe | None = None,
    *,
    full_scale: float | None = None,
    columns: ColumnsGiven = None,
) -> tuple[Flight, tuple[str, ...]]:
    """Read a log of any known format, recognised from the first bytes of the file. Its columns: docs/logs.md.

    **Arguments:**

    - `log`: a path; or a mapping of arrays, pandas DataFrame or xarray Dataset, with the columns of the flight CSV.
    - `airframe`: its `max_rotor_speed` turns commands into rotor speeds. A log with rotor speeds needs no airframe.
    - `full_scale`: rotor speed of command 1 [rad/s] if the airframe gives none. With 1, commands stay as they are.
    - `columns`: which columns or topics hold what: the path of a column map, the name of a preset, or a table.

    **Returns:** the flight, and notes on what the reader changed or assumed: one line each, without the file's name.

    **Raises:** `InputError`, one line: the file, the place in it, what is wrong and what to do.
    """
    found = read_recording(log, airframe, full_scale=full_scale, columns=columns)
    return found.flight, (*found.notes, *([found.facts.too_slow] if found.facts.too_slow else []))


def read_recording(
    log: Path | Any,
    airframe: Airframe | None = None,
    *,
    full_scale: float | None = None,
    columns: ColumnsGiven = None,
) -> Recording:
    """Read a log in any format that `jaxos4.read_log` knows, named by its path. Arguments and errors are the same.

    If the log was written too rarely, its facts say so, and not its notes.
    """
    if not isinstance(log, str | os.PathLike):
        return recording_of(array_table(log, column_map(columns)), (), airframe, full_scale=full_scale)
    kind = log_format(log)
    if columns is None:
        found = kind.read(log)
    elif kind.mapped is None:
        refuse(log, f"has the columns of its format ({kind.label}), and takes no column map; leave it out")
    else:
        found = kind.mapped(log, column_map(columns))
    recording = recording_of(*found, airframe, full_scale=full_scale)
    return recording._replace(facts=recording.facts._replace(format=kind))


def read_flight(path: Path, airframe: Airframe | None = None) -> Flight:
    """Read a flight from a CSV file. Its columns: docs/index.md.

    Rows within 1 % of a uniform time grid keep their values. Other rows are resampled to such a grid. Jumps of 2 pi in
    roll and yaw are removed. Each change to the data is a `UserWarning`. Arguments and errors are those of `read_log`.
    """
    found = recording_of(*CSV.read(path), airframe)
    for note in found.notes:
        warnings.warn(f"{printable(os.fspath(path))}: {note}.", UserWarning, stacklevel=2)
    return found.flight


def log_format(path: Path) -> LogFormat:
    """The format of a log: the first of `FORMATS` that recognises it, or the last (the flight CSV).

    Formats of other packages are asked before the last. A pipe can be read only once, so it always counts as the last.

    **Raises:** `InputError` if the file cannot be opened, or is evidently of another kind.
    """
    inside = os.path.join(path, "metadata.yaml")  # of a folder: a bag of ROS 2
    with opened(inside if os.path.isfile(inside) else path, "rb") as file:
        begin = file.read(_FIRST_BYTES) if file.seekable() else b""
    formats = itertools.chain(FORMATS[:-1], _OTHERS.values())
    kind = next((each for each in formats if each.recognises(begin)), FORMATS[-1])
    if kind is FORMATS[-1] and (unread := unread_kind(begin)):
        refuse(path, f"{unread}. Logs that are read: {', '.join(each.label for each in (*FORMATS, *_OTHERS.values()))}")
    return kind
