"""Columns of numbers, of whichever format, and a CSV file's text to them, or one line that says where it cannot be."""

import contextlib
import csv
import math
import os
import re
from collections.abc import Collection, Iterator, Mapping
from operator import itemgetter
from types import MappingProxyType
from typing import BinaryIO, NamedTuple, NoReturn, TextIO

import numpy as np

from ..errors import InputError

MAX_ROWS = 5_000_000  # 83 minutes at 1 kHz; beyond it a flight no longer fits an ordinary machine's memory
_LONGEST_LINE = 1 << 20
_BLOCK = 1 << 20  # characters parsed at once, so that the text is never in memory as a whole
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_NOTHING = {"nan", "na", "n/a", "nil", "null", "none", "inf", "infinity", "-", "--"}


class Table(NamedTuple):
    """Columns of a log; what was not measured is NaN, and nothing else is not finite.

    **Arguments:**

    - `path`: the file, as messages name it.
    - `columns`: by the names of the project's own CSV, in its units and frame.
    - `unknown`: names of columns that are left out.
    - `first_row`: the row of the file, counted from 1, in which entry 0 of a column stands; `None`: there are no rows.
    - `names`: what the log itself calls a column, where that is something else.
    - `remedy`: what to do about a number that no quadrotor has, where the format leaves its user no choice of units.
    """

    path: str
    columns: dict[str, np.ndarray]
    unknown: tuple[str, ...] = ()
    first_row: int | None = 2
    names: Mapping[str, str] = MappingProxyType({})
    remedy: str = ""

    def refuse(self, what: str, *, index: int | None = None, column: str | None = None) -> NoReturn:
        """Raise the `InputError` of entry `index` of `column`."""
        if self.first_row is None and index is not None and column != "t":
            what = f"at {self.columns['t'][index]:.6g} s {what}"
        row = None if index is None or self.first_row is None else index + self.first_row
        name = None if column is None else self.names.get(column, column)
        refuse(self.path, what, row=row, column=name, kind="column" if self.first_row is not None else "field")


def read_table(
    path: str | os.PathLike[str], known: Collection[str], *, skip: int = 0, missing: Collection[str] = ()
) -> Table:
    """The columns of `path` whose names are `known`; the other names are listed, their cells not looked at.

    The text is UTF-8, with or without a byte-order mark, with any line ends; blanks around cells do not matter.

    **Arguments:**

    - `skip`: lines before the header.
    - `missing`: cells that stand for "not measured", besides the empty one.

    **Raises:** `InputError`, one line with file, row and column, and nothing else for whatever the file holds.
    """
    shown = printable(os.fspath(path))
    with opened(path) as file:
        for _ in range(skip):
            file.readline(_LONGEST_LINE)
        header = _header(shown, file.readline(_LONGEST_LINE), known, skip + 1)
        return _parse(shown, file, header, known, skip + 2, frozenset(missing))


@contextlib.contextmanager
def opened(path: str | os.PathLike[str]) -> Iterator[TextIO]:
    """The text of a log, in UTF-8 with what cannot be decoded escaped.

    **Raises:** `InputError`, one line, where the file cannot be opened or read.
    """
    with _explained(path), open(path, encoding="utf-8-sig", errors="surrogateescape", newline=None) as file:
        yield file


@contextlib.contextmanager
def opened_bytes(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """The bytes of a log. Raises as `opened` does."""
    with _explained(path), open(path, "rb") as file:
        yield file


@contextlib.contextmanager
def _explained(path: str | os.PathLike[str]) -> Iterator[None]:
    shown = printable(os.fspath(path))
    if "\0" in os.fspath(path):
        refuse(shown, "is no file name: it holds a null character; give the path of a log")
    try:
        yield
    except FileNotFoundError:
        refuse(shown, "there is no such file; give the path of a flight's log")
    except IsADirectoryError:
        refuse(shown, "is a folder, not a file; give the path of a flight's log")
    except PermissionError:
        refuse(shown, "may not be read by you (permission denied); change its permissions or copy it")
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "its name or content cannot be decoded"
        refuse(shown, f"cannot be read ({reason}); give the path of a flight's log")


def refuse(
    path: str, what: str, *, row: int | None = None, column: str | None = None, kind: str = "column"
) -> NoReturn:
    """Raise an `InputError` of one line: file, row, column (or another `kind` of name), what is wrong, what to do."""
    place = ", ".join([f"row {row}"] * (row is not None) + [f"{kind} {printable(column or '')}"] * (column is not None))
    raise InputError(": ".join(filter(None, (path, place, what))) + ".")


def printable(text: str) -> str:
    """`text` on one line, whatever it holds."""
    return text if text.isprintable() else repr(text)[1:-1]


def quoted(text: str) -> str:
    """`text` as it may be shown in a message: in quotes, on one line and short."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


def _header(path: str, line: str, known: Collection[str], row: int) -> list[str]:
    if not line:
        refuse(path, "is empty; a flight needs a header row and at least two rows of data")
    if "\0" in line or not _decoded(line):
        refuse(path, "is not text in UTF-8; export the log as CSV in UTF-8", row=row)
    if len(line) >= _LONGEST_LINE:
        refuse(path, "has no end within a million characters; export the log as CSV with a header row", row=row)
    try:
        names = [name.strip() for name in next(csv.reader([line.rstrip("\n")]), [])]
    except csv.Error:
        refuse(path, "holds a name too long to be one; write the header row by hand", row=row)
    if not any(names):
        refuse(path, "is empty; the first row must be the header", row=row)
    if len(names) == 1:
        for separator, shown in ((";", "';'"), ("\t", "tabs"), ("|", "'|'"), (" ", "blanks")):
            if separator in line.strip():
                refuse(path, f"is separated by {shown}; separate by commas, with points in the numbers", row=row)
    if all(_NUMBER.fullmatch(name) for name in names if name):
        refuse(path, "holds numbers where the header should be; write the columns' names into a first row", row=row)
    for name in known:
        if names.count(name) > 1:
            refuse(path, f"stands {names.count(name)} times in the header; keep one of them", row=row, column=name)
    return names


def _parse(
    path: str, file: TextIO, header: list[str], known: Collection[str], first_row: int, missing: frozenset[str]
) -> Table:
    wanted = [(name, itemgetter(i)) for i, name in enumerate(header) if name in known]
    parts: dict[str, list[np.ndarray]] = {name: [np.empty(0)] for name, _ in wanted}
    row = first_row
    for lines in _blocks(path, file, first_row):
        rows = _split(path, lines, row)
        widths = list(map(len, rows))
        if widths.count(len(header)) != len(rows):
            i = next(i for i, width in enumerate(widths) if width != len(header))
            if not lines[i].strip():
                refuse(path, "is blank; delete it", row=row + i)
            cells = "1 cell" if widths[i] == 1 else f"{widths[i]} cells"
            refuse(path, f"has {cells} where the header has {len(header)}; repair or delete the row", row=row + i)
        for name, cell in wanted:
            parts[name].append(_numbers(path, name, _without(missing, list(map(cell, rows))), row))
        row += len(rows)
        if row - first_row > MAX_ROWS:
            refuse(path, f"has more than {MAX_ROWS:,} rows; cut the log into flights, or thin it out")
    if row == first_row:
        refuse(path, "holds a header and no data; a flight needs at least two rows")
    if row == first_row + 1:
        refuse(path, "holds one row of data; a flight needs at least two")
    columns = {name: np.concatenate(parts.pop(name)) for name, _ in wanted}
    return Table(path, columns, tuple(name for name in header if name not in known), first_row)


def _blocks(path: str, file: TextIO, row: int) -> Iterator[list[str]]:
    """Some lines at a time, without the blank ones at the file's end."""
    held: list[str] = []  # blank lines at the last block's end: no fault if nothing follows
    while text := file.read(_BLOCK):
        rest = file.readline(_LONGEST_LINE)
        lines = (text + rest).removesuffix("\n").split("\n")
        if len(rest) >= _LONGEST_LINE:
            refuse(path, "has no end within a million characters; this is no CSV", row=row + len(held) + len(lines) - 1)
        lines = held + lines
        end = len(lines)
        while end and not lines[end - 1].strip():
            end -= 1
        held = lines[end:]
        if len(held) > _LONGEST_LINE:
            refuse(path, "and a million more are blank; delete them", row=row + end)
        if end:
            yield lines[:end]
            row += end


def _split(path: str, lines: list[str], row: int) -> list[list[str]]:
    if not any('"' in line for line in lines):
        return [line.split(",") for line in lines]
    rows = []
    for i, line in enumerate(lines):  # one by one: a quote that is not closed ends with its line
        try:
            rows.append(next(csv.reader([line]), []))
        except csv.Error:
            refuse(path, "holds a quoted cell too long to be one; repair or delete the row", row=row + i)
    return rows


def _without(missing: frozenset[str], cells: list[str]) -> list[str]:
    return ["" if cell.strip() in missing else cell for cell in cells] if missing else cells


def _numbers(path: str, column: str, cells: list[str], row: int) -> np.ndarray:
    text = "".join(cells)
    if text.isascii() and "_" not in text:  # Python's float takes both for more than we do
        try:
            values = np.array([float(cell) if cell else math.nan for cell in cells])
        except ValueError:
            pass
        else:
            if np.count_nonzero(np.isfinite(values)) + cells.count("") == len(cells):
                return values
    values = np.empty(len(cells))
    for i, cell in enumerate(map(str.strip, cells)):
        values[i] = float(cell) if _NUMBER.fullmatch(cell) else math.nan
        if cell and not math.isfinite(values[i]):
            refuse(path, _complaint(cell), row=row + i, column=column)
    return values


def _complaint(cell: str) -> str:
    if cell.lower().lstrip("+-") in _NOTHING or cell in _NOTHING:
        return f"holds {quoted(cell)}; leave the cell empty where nothing was measured"
    if _NUMBER.fullmatch(cell):
        return f"holds {quoted(cell)}, more than a number can be; leave the cell empty where nothing was measured"
    if not _decoded(cell) or "\0" in cell:
        return "is not text in UTF-8; export the log as CSV in UTF-8"
    return (
        f"holds {quoted(cell)}, which is not a number; correct it, or leave the cell empty where nothing was measured"
    )


def _decoded(text: str) -> bool:
    """Whether no byte of `text` had to be escaped."""
    return text.isascii() or not any("\ud800" <= character <= "\udfff" for character in text)
