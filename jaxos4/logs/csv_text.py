"""The text of a CSV file to columns of numbers, or to one line that says which cell is wrong.

A parser of our own: `numpy.loadtxt` takes no empty cells and accepts `nan` and `inf`, `numpy.genfromtxt` reads text as
NaN, and neither gives the row of the file and the name of the column.
"""

import csv
import math
import re
from collections.abc import Collection, Iterator
from operator import itemgetter
from typing import TextIO

import numpy as np

from .table import MAX_ROWS, Path, Table, opened, quoted, refuse

_LONGEST_LINE = 1 << 20
_BLOCK = 1 << 20  # characters parsed at once: the whole text never has to fit in memory
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_NO_NUMBER = {"nan", "na", "n/a", "nil", "null", "none", "inf", "infinity", "-", "--"}
_EMPTY = "leave the cell empty if it was not measured"
_NOT_UTF8 = "is not text in UTF-8; export the log as CSV in UTF-8"


def read_table(path: Path, known: Collection[str], *, skip: int = 0, missing: Collection[str] = ()) -> Table:
    """Read the columns of a CSV file whose names are `known`; the names of the others are listed in the table.

    The text is UTF-8 with any line ends, with or without a byte-order mark. Blanks around cells are ignored.

    **Arguments:**

    - `skip`: number of lines before the header.
    - `missing`: cells that mean "not measured", in addition to the empty cell.

    **Raises:** `InputError`, one line with file, row and column, whatever the file contains.
    """
    with opened(path) as file:
        for _ in range(skip):
            file.readline(_LONGEST_LINE)
        header = _header(path, file.readline(_LONGEST_LINE), known, skip + 1)
        return _parse(path, file, header, known, skip + 2, frozenset(missing))


def _header(path: Path, line: str, known: Collection[str], row: int) -> list[str]:
    if not line:
        refuse(path, "is empty; a flight needs a header row and at least two rows of data")
    if "\0" in line or not _decoded(line):
        refuse(path, _NOT_UTF8, row=row)
    if len(line) >= _LONGEST_LINE:
        refuse(path, "is longer than a million characters; export the log as CSV with a header row", row=row)
    try:
        names = [name.strip() for name in next(csv.reader([line.rstrip("\n")]), [])]
    except csv.Error:
        refuse(path, "contains a name that is too long; write the header row by hand", row=row)
    if not any(names):
        refuse(path, "is empty; the first row must be the header", row=row)
    if len(names) == 1:
        for separator, shown in ((";", "';'"), ("\t", "tabs"), ("|", "'|'"), (" ", "blanks")):
            if separator in line.strip():
                refuse(path, f"is separated by {shown}; separate by commas, with points in the numbers", row=row)
    if all(_NUMBER.fullmatch(name) for name in names if name):
        refuse(path, "contains numbers instead of the header; write the names of the columns in a first row", row=row)
    for name in known:
        if names.count(name) > 1:
            refuse(path, f"occurs {names.count(name)} times in the header; keep one of them", row=row, column=name)
    return names


def _parse(
    path: Path, file: TextIO, header: list[str], known: Collection[str], first_row: int, missing: frozenset[str]
) -> Table:
    wanted = [(name, itemgetter(i)) for i, name in enumerate(header) if name in known]
    parts: dict[str, list[np.ndarray]] = {name: [np.empty(0)] for name, _ in wanted}
    row = first_row
    for lines in _blocks(path, file, first_row):
        rows = [_cells(path, line, row + i) for i, line in enumerate(lines)]
        widths = list(map(len, rows))
        if widths.count(len(header)) != len(rows):
            i = next(i for i, width in enumerate(widths) if width != len(header))
            if not lines[i].strip():
                refuse(path, "is blank; delete it", row=row + i)
            count = "1 cell" if widths[i] == 1 else f"{widths[i]} cells"
            refuse(path, f"has {count}, but the header has {len(header)}; repair or delete the row", row=row + i)
        for name, cell in wanted:
            cells = list(map(cell, rows))
            cells = ["" if text.strip() in missing else text for text in cells] if missing else cells
            parts[name].append(_numbers(path, name, cells, row))
        row += len(rows)
        if row - first_row > MAX_ROWS:
            refuse(path, f"has more than {MAX_ROWS:,} rows; cut the log into flights, or keep fewer rows")
    if row - first_row < 2:
        refuse(path, f"has a header and {['no data', 'one row of data'][row - first_row]}; a flight needs two rows")
    columns = {name: np.concatenate(parts.pop(name)) for name, _ in wanted}
    return Table(path, columns, tuple(name for name in header if name not in known), first_row)


def _blocks(path: Path, file: TextIO, row: int) -> Iterator[list[str]]:
    """Some lines at a time, without the blank lines at the end of the file."""
    blank: list[str] = []  # at the end of the last block: allowed only if no other line follows
    while text := file.read(_BLOCK):
        rest = file.readline(_LONGEST_LINE)
        lines = blank + (text + rest).removesuffix("\n").split("\n")
        if len(rest) >= _LONGEST_LINE:
            refuse(path, "is longer than a million characters; give a CSV file", row=row + len(lines) - 1)
        end = len(lines)
        while end and not lines[end - 1].strip():
            end -= 1
        blank = lines[end:]
        if len(blank) > _LONGEST_LINE:
            refuse(path, "and a million rows after it are blank; delete them", row=row + end)
        if end:
            yield lines[:end]
            row += end


def _cells(path: Path, line: str, row: int) -> list[str]:
    try:
        return next(csv.reader([line]), [])  # line by line, so that an open quote ends with its line
    except csv.Error:
        refuse(path, "contains a cell that is too long; repair or delete the row", row=row)


def _numbers(path: Path, column: str, cells: list[str], row: int) -> np.ndarray:
    text = "".join(cells)
    if text.isascii() and "_" not in text:  # float() also reads "1_0" and the digits of other scripts
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
    if cell.lower().lstrip("+-") in _NO_NUMBER or cell in _NO_NUMBER:
        return f"contains {quoted(cell)}; {_EMPTY}"
    if _NUMBER.fullmatch(cell):
        return f"contains {quoted(cell)}, which is too large for a number; {_EMPTY}"
    if not _decoded(cell) or "\0" in cell:
        return _NOT_UTF8
    return f"contains {quoted(cell)}, which is not a number; correct it, or {_EMPTY}"


def _decoded(text: str) -> bool:
    """Whether every byte of `text` could be decoded."""
    return text.isascii() or not any("\ud800" <= character <= "\udfff" for character in text)
