"""What all log formats share: the columns as a `Table`, the description of a format, opening and refusing files."""

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import BinaryIO, NamedTuple, NoReturn, TextIO

import numpy as np

from ..errors import InputError
from .facts import LogFacts

Path = str | os.PathLike[str]

MAX_ROWS = 5_000_000  # 83 minutes at 1 kHz; a longer flight does not fit in the memory of an ordinary machine


class Table(NamedTuple):
    """Columns of a log. NaN means not measured; all other values are finite.

    - `columns`: arrays of one length, with the names, units and frame of the flight CSV (see `jaxos4.logs.csv`).
    - `unknown`: names of the columns that the reader ignored.
    - `first_row`: the row of the file, counted from 1, that holds entry 0; `None` if the format has no rows.
    - `names`: the log's own name of a column, if it is another.
    - `remedy`: advice for an impossible number, if the user cannot choose the units of the format.
    - `facts`: what the log says beside its columns. How often motors and gyro were written follows from the cells, if
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


@contextlib.contextmanager
def opened(path: Path) -> Iterator[TextIO]:
    """Open a log as UTF-8 text, with other bytes escaped. Raises `InputError` if it cannot be opened or read."""
    with _explained(path), open(path, encoding="utf-8-sig", errors="surrogateescape", newline=None) as file:
        yield file


@contextlib.contextmanager
def opened_bytes(path: Path) -> Iterator[BinaryIO]:
    """Open a log as bytes. Raises the errors of `opened`."""
    with _explained(path), open(path, "rb") as file:
        yield file


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    if "\0" in os.fspath(path):
        refuse(path, "is not a file name, because it contains a null character; give the path of a log")
    try:
        yield
    except FileNotFoundError:
        refuse(path, "there is no such file; give the path of a log")
    except IsADirectoryError:
        refuse(path, "is a folder, not a file; give the path of a log")
    except PermissionError:
        refuse(path, "cannot be opened (permission denied); change its permissions or copy it")
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "its name or content cannot be decoded"
        refuse(path, f"cannot be read ({reason}); give the path of a log")


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
