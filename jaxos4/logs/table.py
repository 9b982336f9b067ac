"""Shared by all log formats: columns as a `Table`, facts beside them, a flight as a `Recording`, refusing a file."""

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import IO, Any, NamedTuple, NoReturn

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from .._files import at_once
from ..errors import InputError, printable
from ..flight import SIGNALS, Flight, with_force

LogPath = str | os.PathLike[str]

MAX_ROWS = 5_000_000  # 83 minutes at 1 kHz; a longer flight does not fit in the memory of an ordinary machine
SLOWEST_RATE = 40.0
"""The fewest samples a second of motors and gyro that identify a vehicle [Hz].

Rotors follow their commands with a lag of 20 to 80 ms. In closed loop, commands at 10 Hz make inertias 1.4 to 2.1 times
too large, commands at 20 Hz 1.1 to 1.2 times; at 40 Hz the error is below 6 %.
"""


class Sampling(NamedTuple):
    """The `rate` [Hz] at which a log holds something, and its `source`, as the log names it."""

    source: str
    rate: float


class LogFacts(NamedTuple):
    """Facts that a log states beside the flight. `None`: the log does not state it.

    - `motors`, `gyro`: how often rotor speeds or commands, and body rates, were written, before any resampling.
    - `faster`: how to make the vehicle write them more often.
    - `landed`: from when to when the vehicle itself says that it is on the ground [s], in the flight's time.
    - `rotor_positions`: x forward and y left of each rotor [m], in the order of the rotors in the flight.
    - `rotor_spins`: +1 for counter-clockwise seen from above, -1 for clockwise.
    - `format`: the format of the file.
    """

    motors: Sampling | None = None
    gyro: Sampling | None = None
    faster: str = "log motors and gyro at 100 Hz or more, and fly again"
    landed: tuple[tuple[float, float], ...] = ()
    rotor_positions: tuple[tuple[float, float], ...] | None = None
    rotor_spins: tuple[float, ...] | None = None
    format: "LogFormat | None" = None

    @property
    def too_slow_note(self) -> str:
        """Why the log was written too rarely to identify a vehicle, and what to do; empty if it was not."""
        every = (("the motors were", self.motors), ("the gyro was", self.gyro))
        slow = [f"{what} logged at {s.rate:.2g} Hz ({s.source})" for what, s in every if s and not fast_enough(s.rate)]
        needs = f"rotors answer within 20 to 80 ms, which needs {SLOWEST_RATE:g} Hz or more; {self.faster}"
        return f"{' and '.join(slow)}, too rarely to identify a vehicle: {needs}" if slow else ""


def fast_enough(rate: float) -> bool:
    """Whether samples at this rate [Hz] identify a vehicle. A log at a nominal rate may be 5 % slower."""
    return rate >= 0.95 * SLOWEST_RATE


class Table(NamedTuple):
    """Columns of a log. NaN means not measured; all other values are finite.

    - `columns`: arrays of one length, with the names, units and frame of the flight CSV (docs/index.md).
    - `unknown`: names of the columns that the reader ignored.
    - `first_row`: the row of the file, counted from 1, that holds entry 0; `None` if the format has no rows.
    - `names`: by column, its name in the log, if that is another.
    - `remedy`: advice for an impossible number, if the user cannot choose the units of the format.
    - `facts`: see `LogFacts`. How often motors and gyro were written follows from the cells, if
      `facts` does not say it.
    - `held`: whether a measured rotor speed is the mean until the next row (zero-order hold), not that of an instant.
    - `impossible`: by column, how many values `jaxos4.logs.values` took out, and the first of them.
    """

    path: LogPath
    columns: dict[str, np.ndarray]
    unknown: tuple[str, ...] = ()
    first_row: int | None = 2
    names: Mapping[str, str] = MappingProxyType({})
    remedy: str = ""
    facts: LogFacts = LogFacts()
    impossible: Mapping[str, tuple[int, str]] = MappingProxyType({})
    held: bool = False

    def refuse(self, what: str, *, index: int | None = None, column: str | None = None) -> NoReturn:
        """Raise an `InputError` about entry `index` of `column`."""
        if self.first_row is None and index is not None and column != "t":
            what = f"at {self.columns['t'][index]:.6g} s {what}"
        row = None if index is None or self.first_row is None else index + self.first_row
        name = self.names.get(column, column) if column else None
        refuse(self.path, what, row=row, column=name, kind="column" if self.first_row is not None else "field")

    def holds(self, *names: str) -> bool:
        """Whether all these columns are there."""
        return self.columns.keys() >= set(names)

    @property
    def impossible_note(self) -> str:
        """The impossible values that were taken out, in words."""
        what = [f"{self.names.get(name, name)}: {k} (first {first})" for name, (k, first) in self.impossible.items()]
        return f"impossible values count as not measured, in {', '.join(what)}"


class LogFormat(NamedTuple):
    """A log format. To add one, write a file that makes a `LogFormat`, and add a line to `jaxos4.logs.FORMATS`.

    - `name`: short name, as in the JSON of `jaxos4 inspect`.
    - `label`: the name that users see.
    - `recognises`: takes the first bytes of a file; returns whether the file has this format.
    - `read`: takes a path; returns the columns and the notes on what the reader assumed, one line each. Raises
      `InputError` (by `refuse`) for a file that cannot be used.
    - `mapped`: takes a path and a column map, and returns the same; `None` if the columns of the format are fixed.
    - `of_vehicles`: whether only real vehicles write it.
    """

    name: str
    label: str
    recognises: Callable[[bytes], bool]
    read: Callable[[LogPath], tuple[Table, tuple[str, ...]]]
    mapped: Callable[[LogPath, Any], tuple[Table, tuple[str, ...]]] | None = None
    of_vehicles: bool = True


_ARRAYS = ("time", *SIGNALS)


class Recording(NamedTuple):
    """A recorded flight as NumPy arrays in double precision, its name, and the facts that its log states.

    Fields are as in `Flight`, in SI units. Recordings are cleaned, cut and concatenated, and become a `Flight` last.

    - `name`: in messages and in the provenance. Usually the path of the file.
    - `notes`: the reader's changes to the data, one line each. `facts`: statements of the log beside the flight.
    """

    time: Float[np.ndarray, " samples"]
    omega: Float[np.ndarray, "samples 4"]
    states: Float[np.ndarray, "samples 12"]
    specific_force: Float[np.ndarray, "samples 3"] | None = None
    voltage: Float[np.ndarray, " samples"] | None = None
    body_velocity: Float[np.ndarray, "samples 3"] | None = None
    stretch: Int[np.ndarray, " samples"] | None = None
    commanded: bool = False
    name: str = "flight"
    notes: tuple[str, ...] = ()
    facts: LogFacts = LogFacts()
    held: bool = True
    within: Float[np.ndarray, "samples parts 4"] | None = None
    averaging_time: float = 0.0

    @classmethod
    def of(cls, flight: Flight, name: str = "flight") -> "Recording":
        """A recording of a `Flight`."""
        arrays: dict[str, Any] = {
            field: np.asarray(value, int if field == "stretch" else float)
            for field in _ARRAYS
            if (value := getattr(flight, field)) is not None
        }
        averaging_time = float(flight.averaging_time)
        return cls(**arrays, commanded=flight.commanded, name=name, held=flight.held, averaging_time=averaging_time)

    @property
    def flight(self) -> Flight:
        """The `Flight`, in the precision of JAX."""
        arrays: dict[str, Any] = {field: getattr(self, field) for field in _ARRAYS}
        arrays["stretch"] = None if self.stretch is None else jax.device_put(self.stretch)
        return Flight(**arrays, commanded=self.commanded, held=self.held, averaging_time=self.averaging_time)

    @property
    def dt(self) -> float:
        """The sample time [s]."""
        return float((self.time[-1] - self.time[0]) / (self.time.size - 1))

    def columns(self, *, inputs: bool = True) -> dict[str, Float[np.ndarray, " samples"]]:
        """The columns of signals in a log, by name; without `inputs`, only those in which NaN marks a gap."""
        return {
            name: column
            for field, signal in SIGNALS.items()
            if signal.columns and (inputs or not signal.is_input) and (rows := getattr(self, field)) is not None
            for name, column in zip(signal.columns, rows.reshape(len(rows), -1).T, strict=True)
        }

    @property
    def channels(self) -> Float[np.ndarray, "samples 15"]:
        """Every channel in the order of `CHANNEL_NAMES`; NaN: not measured."""
        return with_force(self.states, self.specific_force, np)

    def rows(self, which: slice | Bool[np.ndarray, " samples"]) -> "Recording":
        """Some samples of the recording; their time stays as recorded."""
        return self._replace(**{f: x[which] for f in _ARRAYS if (x := getattr(self, f)) is not None})

    @property
    def vehicle_evidence(self) -> str:
        """The evidence that this is the log of a real vehicle, as the end of a sentence; empty if there is none."""
        if self.commanded:
            return "has commands, not rotor speeds"
        if self.specific_force is not None:
            return "has an accelerometer"
        kind = self.facts.format
        return f"is a log of a vehicle ({kind.label})" if kind and kind.of_vehicles else ""

    @property
    def named_notes(self) -> tuple[str, ...]:
        """The notes, each with the name in front."""
        return tuple(f"{self.name}: {note}" for note in self.notes)

    def same_data(self, other: "Recording") -> bool:
        """Whether both hold the same samples: times, rotor speeds and states."""
        mine, others = ((each.time, each.omega, each.states) for each in (self, other))
        return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(mine, others, strict=True))


def signals_of(columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The signals that columns of a log make, by name: NaN for missing columns, `None` for signals without any."""
    nothing = np.full(len(next(iter(columns.values()))), np.nan)
    signals: dict[str, Any] = dict.fromkeys(SIGNALS)
    for field, signal in SIGNALS.items():
        if signal.columns.keys() & columns.keys():
            rows = np.column_stack([columns.get(name, nothing) for name in signal.columns])
            signals[field] = rows.reshape(nothing.size, *(signal.shape or ()))
    return signals


def items(name: str, count: int) -> list[str]:
    """The names of the numbers in an array: `name[0]`, `name[1]`, ..."""
    return [f"{name}[{i}]" for i in range(count)]


def order_note(first: str) -> str:
    """The note on the order of the rotors; `first`: the name of rotor 1 in the log."""
    same = "rotor_positions and rotor_spins must be in the same order"
    return f"rotors keep the log's order ({first} is rotor 1): {same}"


_UNREADABLE = {
    FileNotFoundError: "there is no such file; give the path of an existing file",
    IsADirectoryError: "is a folder, not a file; give the path of a log",
    PermissionError: "cannot be opened (permission denied); change its permissions or copy it",
}


@contextlib.contextmanager
def opened(path: LogPath, mode: str = "r") -> Iterator[IO]:
    """Open a log as UTF-8 text with other bytes escaped, or in mode `rb`. Raises `InputError` if it cannot be read."""
    if "\0" in os.fspath(path):
        refuse(path, "is not a file name, because it contains a null character; give the path of a log")
    encoding, errors = ("utf-8-sig", "surrogateescape") if mode == "r" else (None, None)
    try:
        with open(path, mode, encoding=encoding, errors=errors, opener=at_once) as file:
            yield file
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "its name or content cannot be decoded"
        refuse(path, _UNREADABLE.get(type(error), f"cannot be read ({reason}); give the path of a log"))


def read_bytes(path: LogPath, most: int) -> bytes:
    """The content of a log. Raises `InputError` if it has more than `most` bytes."""
    content = bytearray()
    with opened(path, "rb") as file:
        while more := file.read(1 << 20):
            content += more
            if len(content) > most:
                refuse(path, f"has more than {most:,} bytes, far more than one flight; cut the log into flights")
    return bytes(content)


def refuse(
    path: LogPath, what: str, *, row: int | None = None, column: str | None = None, kind: str = "column"
) -> NoReturn:
    """Raise an `InputError` of one line: the place, `what` is wrong and what to do, without its full stop."""
    places = [f"row {row}"] * (row is not None) + [f"{kind} {column}"] * (column is not None)
    raise InputError(": ".join(filter(None, (printable(os.fspath(path)), ", ".join(places), what))) + ".")
