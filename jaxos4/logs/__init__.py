"""Files of recorded flights to `Recording` and `Flight`, and back to CSV.

A log format is a `LogFormat` in a file here and a line in `FORMATS`, or an entry point of another package in
`jaxos4.log_formats`.
"""

import contextlib
import os
import re
import warnings
from collections.abc import Sequence
from typing import Any, cast

from .._files import read_toml
from .._registry import Registry
from ..airframe import Airframe
from ..errors import InputError, in_words, printable
from ..flight import SIGNALS, Flight
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
    LogPath,
    Recording as Recording,
    Sampling as Sampling,
    Table as Table,
    opened,
    refuse,
    signals_of,
)
from .ulog import ULOG
from .values import without_impossible

FORMATS: tuple[LogFormat, ...] = (ULOG, ROS, ARDUPILOT, CRAZYFLIE, BLACKBOX, NEUROBEM, CSV)
"""The formats in the order in which they are tried. A file that none recognises is a flight CSV.

Only formats of other packages are asked about files that are a zip or tar.
"""
_OTHERS: Registry[LogFormat] = Registry("jaxos4.log_formats", {})

# Files that no reader takes, by their first bytes: their kind, and how to make a log of them that is read.
_IN_PYTHON = "read it in Python, and give its arrays to jaxos4.read_log"
_ARCHIVE = rb"PK\x03\x04|.{257}ustar"
_UNREAD = {
    _ARCHIVE: (
        "an archive (zip, tar, or .xlsx, .npz)",
        f"unpack it, export its table as CSV, or {_IN_PYTHON}",
    ),
    rb"\x1f\x8b|BZh|\xfd7zXZ|7z\xbc\xaf|\x28\xb5\x2f\xfd|\x04\x22\x4d\x18": ("a compressed file", "unpack it"),
    rb"\x89HDF": ("an HDF5 file (netCDF, MATLAB 7.3)", f"{_IN_PYTHON} (xarray.open_dataset, h5py)"),
    rb"MATLAB 5": ("a MATLAB file", f"{_IN_PYTHON} (scipy.io.loadmat), or export CSV by `writetable`"),
    rb"\x93NUMPY": ("a NumPy file", f"{_IN_PYTHON} (numpy.load)"),
    rb"PAR1|ARROW1|FEA1": ("a Parquet or Arrow file", f"{_IN_PYTHON} (pandas.read_parquet, pandas.read_feather)"),
    rb"\xd0\xcf\x11\xe0": ("an Excel file", "export it as CSV"),
    rb"\xff\xfe|\xfe\xff": ("text in UTF-16", "save it as CSV in UTF-8"),
    rb"FMT, ": ("a text log of ArduPilot", "give the .BIN file of which it was made"),
    rb"\0[\x03-\x07].{6}[\xfd\xfe]": ("a telemetry log of MAVLink (.tlog)", "give the log of the vehicle's own card"),
    rb"\xa3\x95\x80.{,80}Labels": (
        "a log of PX4 from before ULog (.px4log)",
        "convert it to CSV by sdlog2_dump.py (of PX4 before version 1.10), and give a column map",
    ),
    rb".{16}BUILD|.{242}DJI": ("a log of DJI", "decode it by DatCon, and give its CSV with a column map"),
    rb"""(?:\xef\xbb\xbf)?\s*\{\s*(?:\}|"[^"\n]*"\s*:)""": (
        "a JSON file",
        "the result of `jaxos4 estimate` is read by `jaxos4 report`, `export` and `predict`; give a log here",
    ),
    rb"[^\n]{0,4000}[\0-\x08\x0e-\x1f]": ("of a kind that is not known", "export it as CSV, and give a column map"),
}
_TOML = (
    "a TOML file, not a log",
    "give a log here (an airframe, a column map or the specification of a study goes elsewhere)",
)
_BEGIN = 1 << 18  # bytes by which a format is recognised

Source = Flight | Recording | str | os.PathLike[str] | Any
"""A flight, the path of a log, or its arrays as `read_log` takes them."""


def read_log(
    log: LogPath | Any,
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
    note = found.facts.too_slow_note
    return found.flight, (*found.notes, note) if note else found.notes


def read_recording(
    log: LogPath | Any,
    airframe: Airframe | None = None,
    *,
    full_scale: float | None = None,
    columns: ColumnsGiven = None,
) -> Recording:
    """`jaxos4.read_log` for a `Recording`, named by its path. If it was written too rarely, its facts say so."""
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


def read_flight(path: LogPath, airframe: Airframe | None = None) -> Flight:
    """Read a flight from a CSV file. Its columns: docs/index.md.

    Rows within 1 % of a uniform time grid keep their values. Other rows are resampled to such a grid. Jumps of 2 pi in
    roll and yaw are removed. Each change to the data is a `UserWarning`. For arguments and errors see `read_log`.
    """
    found = recording_of(*CSV.read(path), airframe)
    for note in found.notes:
        warnings.warn(f"{printable(os.fspath(path))}: {note}.", UserWarning, stacklevel=2)
    return found.flight


def log_format(path: LogPath) -> LogFormat:
    """The format of a log: the first of `FORMATS` that recognises it, or `CSV`.

    Formats of other packages are asked last; one that fails is a `UserWarning`. A pipe can be read only once, so it is
    always a `CSV`.
    Raises `InputError` if the file cannot be opened, or is evidently of another kind.
    """
    inside = os.path.join(path, "metadata.yaml")  # of a folder: a bag of ROS 2
    source = inside if os.path.isfile(inside) else path
    with opened(source, "rb") as file:
        begin = file.read(_BEGIN) if file.seekable() else b""
    # An archive may begin with a log that it holds without compression.
    formats = () if re.match(_ARCHIVE, begin, re.DOTALL) else FORMATS
    kind = next((each for each in formats if each.recognises(begin)), None) or _of_others(begin)
    if kind is not None:
        return kind
    unread = [each for magic, each in _UNREAD.items() if re.match(magic, begin, re.DOTALL)]
    with contextlib.suppress(InputError):  # no rows of a CSV are TOML
        if not unread and 0 < len(begin) < _BEGIN and read_toml(source):
            unread = [_TOML]
    if unread:
        what, remedy = unread[0]
        labels = ", ".join((*(each.label for each in FORMATS), *_OTHERS))
        refuse(path, f"is {what}; {remedy}. Logs that are read: {labels}")
    return CSV


def _of_others(begin: bytes) -> LogFormat | None:
    """The format of another package that recognises a log. A package that fails is skipped."""
    for name in _OTHERS:
        try:
            if _OTHERS[name].recognises(begin):
                return _OTHERS[name]
        except Exception as error:  # noqa: BLE001 - whatever another package does
            what = f"the log format {name} of another package fails ({in_words(error)}); update or uninstall it"
            warnings.warn(what, UserWarning, stacklevel=4)
    return None


def as_recordings(flights: Source | Sequence[Source], airframe: Airframe | None = None) -> tuple[Recording, ...]:
    """One or several flights as recordings, see `as_recording`. The names of several are numbered from 1."""
    single = isinstance(flights, Recording | str) or not isinstance(flights, Sequence)
    every = [flights] if single else cast(Sequence[Any], flights)
    names = [f"flight {i + 1}" if len(every) > 1 else "flight" for i in range(len(every))]
    return tuple(as_recording(each, name, airframe) for each, name in zip(every, names, strict=True))


def as_recording(flight: Source, name: str = "flight", airframe: Airframe | None = None) -> Recording:
    """A flight as a recording of this name, without impossible values. A recording stays as it is.

    A path, or arrays by their names, are read as a log of this `airframe`. Raises `InputError`, as `read_log`.
    """
    if isinstance(flight, Recording):
        return flight
    if not isinstance(flight, Flight):
        return read_recording(flight, airframe)
    found = Recording.of(flight, name)
    columns = {"t": found.time, **found.columns(inputs=False)}
    table = without_impossible(Table(name, columns, first_row=None))
    if not table.impossible:
        return found
    inputs = {field: getattr(found, field) for field, signal in SIGNALS.items() if signal.is_input}
    return found._replace(**signals_of(table.columns) | inputs, notes=(table.impossible_note,))
