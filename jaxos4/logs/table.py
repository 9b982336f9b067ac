"""Shared by all log formats: columns as a `Table`, facts beside them, the description of a format, refusing a file."""

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import IO, NamedTuple, NoReturn, TypeVar

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from .sampling import REACH, Series, at_rows, averaged_to, root_mean_square, unwrap

Path = str | os.PathLike[str]
Found = TypeVar("Found")

MAX_ROWS = 5_000_000  # 83 minutes at 1 kHz; a longer flight does not fit in the memory of an ordinary machine
SLOWEST_RATE = 40.0
"""The fewest samples a second of motors and gyro that identify a vehicle [Hz].

Rotors follow their commands with a lag of 20 to 80 ms. Commands one lag apart or further say too little about speeds
between them. In closed loop, with the lag and delay that fit best, commands at 10 Hz make inertias 1.4 to 2.1 times too
large, commands at 20 Hz 1.1 to 1.2 times; at 40 Hz the error is below 6 %.
"""

_JITTER = 0.95  # a log at a nominal rate may be this much slower
_AT_ONCE = 1 << 20  # bytes
_FASTEST_ROWS = 0.001  # [s]; a faster gyro is averaged to this step, because no vehicle's motion needs more


class Sampling(NamedTuple):
    """How often something was written to the log: its `source`, as the log names it, and its `rate` [Hz]."""

    source: str
    rate: float


class LogFacts(NamedTuple):
    """Facts that a log states beside the flight. `None`: the log does not state it.

    - `motors`, `gyro`: how often rotor speeds or commands, and body rates, were written, before any resampling.
    - `faster`: what to do so that the vehicle writes them more often.
    - `landed`: from when to when the vehicle itself says that it is on the ground [s], in the flight's time.
    - `rotor_positions`: x forward and y left of each rotor [m], in the order of the rotors in the flight.
    - `rotor_spins`: +1 for counter-clockwise seen from above, -1 for clockwise.
    - `cells`: number of the battery's cells in series.
    """

    motors: Sampling | None = None
    gyro: Sampling | None = None
    faster: str = "log motors and gyro at 100 Hz or more, and fly again"
    landed: tuple[tuple[float, float], ...] = ()
    rotor_positions: tuple[tuple[float, float], ...] | None = None
    rotor_spins: tuple[float, ...] | None = None
    cells: int | None = None

    @property
    def too_slow(self) -> str:
        """Why the log was written too rarely to identify a vehicle, and what to do; empty if it was not."""
        every = (("the motors were", self.motors), ("the gyro was", self.gyro))
        slow = [
            f"{what} logged at {sampling.rate:.2g} Hz ({sampling.source})"
            for what, sampling in every
            if sampling is not None and not fast_enough(sampling.rate)
        ]
        if not slow:
            return ""
        return (
            f"{' and '.join(slow)}, too rarely to identify a vehicle: rotors answer within 20 to 80 ms, which needs "
            f"{SLOWEST_RATE:g} Hz or more; {self.faster}"
        )


def fast_enough(rate: float) -> bool:
    """Whether samples at this rate [Hz] identify a vehicle."""
    return rate >= _JITTER * SLOWEST_RATE


class Table(NamedTuple):
    """Columns of a log. NaN means not measured; all other values are finite.

    - `columns`: arrays of one length, with the names, units and frame of the flight CSV (see `jaxos4.logs.csv`).
    - `unknown`: names of the columns that the reader ignored.
    - `first_row`: the row of the file, counted from 1, that holds entry 0; `None` if the format has no rows.
    - `names`: the log's own name of a column, if it is another.
    - `remedy`: advice for an impossible number, if the user cannot choose the units of the format.
    - `facts`: see `LogFacts`. How often motors and gyro were written follows from the cells, if
      `facts` does not say it.
    """

    path: Path
    columns: dict[str, np.ndarray]
    unknown: tuple[str, ...] = ()
    first_row: int | None = 2
    names: Mapping[str, str] = MappingProxyType({})
    remedy: str = ""
    facts: LogFacts = LogFacts()

    def refuse(self, what: str, *, index: int | None = None, column: str | None = None) -> NoReturn:
        """Raise an `InputError` about entry `index` of `column`."""
        if self.first_row is None and index is not None and column != "t":
            what = f"at {self.columns['t'][index]:.6g} s {what}"
        row = None if index is None or self.first_row is None else index + self.first_row
        name = None if column is None else self.names.get(column, column)
        refuse(self.path, what, row=row, column=name, kind="column" if self.first_row is not None else "field")


class LogFormat(NamedTuple):
    """A log format. To add one, write a file that makes a `LogFormat`, and add a line to `jaxos4.logs.FORMATS`.

    **Arguments:**

    - `name`: short name, as in the JSON of `jaxos4 inspect`.
    - `label`: the name that users see.
    - `recognises`: takes the first bytes of a file; returns whether the file has this format.
    - `read`: takes a path; returns the columns and the notes on what the reader assumed, one line each. Raises
      `InputError` (by `refuse`) for a file that cannot be used.
    """

    name: str
    label: str
    recognises: Callable[[bytes], bool]
    read: Callable[[Path], tuple[Table, tuple[str, ...]]]


def gyro_rows(
    path: Path,
    rates: Series,
    rotors: Series,
    *,
    measured: bool,
    others: Mapping[tuple[str, ...], Series | None],
) -> tuple[Float[np.ndarray, " rows"], dict[str, np.ndarray]]:
    """Use the gyro's samples as rows, and bring rotors and `others` to them. Series are in our units and frame.

    A gyro that is faster than 1 kHz is averaged to 1 kHz.

    **Arguments:**

    - `rotors`: `measured` speeds [rad/s], or commands [0..1].
    - `others`: the other sensors, by the names of their columns; `None`: not logged.

    **Returns:** the times of the rows [s], and the columns of a `Table`; `t` is 0 in the first row.

    **Raises:** `InputError` if rates and rotors do not overlap in time, or there are more than `MAX_ROWS` rows.
    """
    rates = averaged_to(_FASTEST_ROWS, rates)
    step = float(np.median(np.diff(rotors.t))) if rotors.t.size > 1 else 0.0
    inside = (rates.t >= rotors.t[0]) & (rates.t <= rotors.t[-1] + REACH * step)
    if np.count_nonzero(inside) < 2:
        refuse(path, "rates and motors were not logged at the same time; record both in one flight")
    rows = rates.t[inside]
    if rows.size > MAX_ROWS:
        refuse(path, f"has more than {MAX_ROWS:,} samples of the gyro; cut the log into flights")
    columns = {"t": rows - rows[0], **dict(zip("pqr", rates.values[inside].T, strict=True))}
    speeds, prefix = root_mean_square(rotors, rows, linear=measured), "omega" if measured else "command"
    columns |= {f"{prefix}{i + 1}": column for i, column in enumerate(speeds.T)}
    for names, series in others.items():
        if series is not None:
            columns |= zip(names, at_rows(rows, series).T, strict=True)
    return rows, columns


def needed(path: Path, found: Found | None, what: str, remedy: str) -> Found:
    """Return `found`, or raise `InputError` if the reader found nothing."""
    if found is None:
        refuse(path, f"holds no {what}; {remedy}")
    return found


def attitude_of(t: np.ndarray, quaternion: Float[np.ndarray, "samples 4"]) -> Series:
    """Roll, pitch, yaw [rad] of quaternions (w, x, y, z), which need not be normalised. NaN if one is zero."""
    with np.errstate(all="ignore"):
        w, x, y, z = (quaternion / np.sqrt((quaternion**2).sum(axis=1, keepdims=True))).T
    phi = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    theta = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return unwrapped(t, np.column_stack([phi, theta, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))]))


def unwrapped(t: np.ndarray, angles: Float[np.ndarray, "samples 3"]) -> Series:
    """Roll, pitch, yaw [rad] as a series, with the jumps of 2 pi removed from roll and yaw."""
    return Series(t, np.column_stack([unwrap(angles[:, 0])[0], angles[:, 1], unwrap(angles[:, 2])[0]]))


def order_note(first: str) -> str:
    """The note on the order of the rotors; `first`: what the log calls rotor 1."""
    return (
        f"rotors keep the log's order ({first} is rotor 1): rotor_positions and rotor_spins must be in the same order"
    )


@contextlib.contextmanager
def opened(path: Path, mode: str = "r") -> Iterator[IO]:
    """Open a log as UTF-8 text with other bytes escaped, or in mode `rb`. Raises `InputError` if it cannot be read."""
    if "\0" in os.fspath(path):
        refuse(path, "is not a file name, because it contains a null character; give the path of a log")
    encoding, errors = ("utf-8-sig", "surrogateescape") if mode == "r" else (None, None)
    try:
        with open(path, mode, encoding=encoding, errors=errors) as file:
            yield file
    except FileNotFoundError:
        refuse(path, "there is no such file; give the path of a log")
    except IsADirectoryError:
        refuse(path, "is a folder, not a file; give the path of a log")
    except PermissionError:
        refuse(path, "cannot be opened (permission denied); change its permissions or copy it")
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "its name or content cannot be decoded"
        refuse(path, f"cannot be read ({reason}); give the path of a log")


def read_bytes(path: Path, most: int) -> bytes:
    """The content of a log. Raises `InputError` if it has more than `most` bytes."""
    content = bytearray()
    with opened(path, "rb") as file:
        while part := file.read(_AT_ONCE):
            content += part
            if len(content) > most:
                refuse(path, f"has more than {most:,} bytes, far more than one flight; cut the log into flights")
    return bytes(content)


def refuse(
    path: Path, what: str, *, row: int | None = None, column: str | None = None, kind: str = "column"
) -> NoReturn:
    """Raise an `InputError` of one line: the place, `what` is wrong and what to do, without its full stop."""
    place = ", ".join([f"row {row}"] * (row is not None) + [f"{kind} {printable(column or '')}"] * (column is not None))
    raise InputError(": ".join(filter(None, (printable(os.fspath(path)), place, what))) + ".")


def printable(text: str) -> str:
    """`text` on one line, with unprintable characters escaped."""
    return text if text.isprintable() else repr(text)[1:-1]


def quoted(text: str) -> str:
    """`text` in quotes, on one line, with at most 40 characters."""
    return repr(text if len(text) <= 40 else text[:37] + "...")
