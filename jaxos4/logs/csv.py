"""The flight CSV, the log format of this project. Its columns: docs/index.md."""

import contextlib
import csv
import itertools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import IO

import numpy as np

from .._files import write_atomically
from ..airframe import Airframe
from ..errors import counted, quoted
from ..flight import COMMAND_NAMES, SPEED_NAMES, Flight
from .columns import ColumnMap, column_map, mapped_rows
from .table import MAX_ROWS, LogFormat, LogPath, Recording, Table, opened, refuse
from .values import COLUMNS

LINES_AT_ONCE = 10_000  # for the memory; it changes no number
_LONGEST_LINE = 1 << 20
_IN_NUMBERS = dict.fromkeys(map(ord, "-+.0123456789eE \t"))  # float() also reads "nan" and "1_0"
_NO_NUMBER = {"nan", "na", "n/a", "nil", "null", "none", "inf", "infinity", "", "-"}
_NOT_UTF8 = "is not text in UTF-8; export the log as CSV in UTF-8"


def read_mapped(path: LogPath, columns: ColumnMap) -> tuple[Table, tuple[str, ...]]:
    """Read a CSV file by a column map. Raises `InputError`."""
    known = {name for source in columns.sources.values() for name in source.names}
    return mapped_rows(read_table(path, known, missing=("NaN", "nan")), columns), ()


def _is_neurobem(begin: bytes) -> bool:
    header = begin.partition(b"\n")[0].decode(errors="replace")
    return {"ang vel x", "mot 1"} <= {name.strip() for name in header.split(",")}


NEUROBEM = LogFormat(
    "NeuroBEM", "NeuroBEM CSV", _is_neurobem, lambda path: read_mapped(path, column_map("neurobem")), read_mapped
)
CSV = LogFormat(
    "CSV",
    "flight CSV",
    lambda begin: False,  # a file that no other format recognises
    lambda path: (read_table(path, COLUMNS), ()),
    read_mapped,
    of_vehicles=False,
)


def read_table(path: LogPath, known: Collection[str], *, skip: int = 0, missing: Collection[str] = ()) -> Table:
    """Read the columns of a CSV file whose names are `known`; the names of the others are listed in the table.

    The text is UTF-8 with any line ends, with or without a byte-order mark. Blanks around cells are ignored.

    - `skip`: number of lines before the header.
    - `missing`: cells that mean "not measured", in addition to the empty cell.

    **Raises:** `InputError`, one line with file, row and column, whatever the file contains.
    """
    count, found = 0, []
    with opened(path) as file:
        for _ in range(skip):
            file.readline(_LONGEST_LINE)
        header = _header(path, file.readline(_LONGEST_LINE), known, skip + 1)
        wanted = {name: header.index(name) for name in header if name in known}
        rows = _rows(path, file, len(header), skip + 2)
        while batch := list(itertools.islice(rows, LINES_AT_ONCE)):
            cells = [*zip(*batch, strict=True)]
            columns = {name: cells[place] for name, place in wanted.items()}
            found.append(_numbers(path, columns, missing, skip + 2 + count))
            count += len(batch)
            if count > MAX_ROWS:
                refuse(path, f"has more than {MAX_ROWS:,} rows; cut the log into flights, or keep fewer rows")
    if count < 2:
        refuse(path, f"has a header and {['no data', 'one row of data'][count]}; a flight needs two rows")
    columns = {name: np.concatenate([batch[name] for batch in found]) for name in wanted}
    return Table(path, columns, tuple(name for name in header if name not in known), skip + 2)


def write_flight(flight: Flight, path: LogPath, airframe: Airframe | None = None) -> None:
    """Write a flight as CSV: `t`, `omega1..4`, and the measured columns of its signals.

    Reading the file gives back every bit of measured speeds and states; angles are unwrapped. If writing fails, an
    older file at `path` is unchanged.

    `airframe`: its `max_rotor_speed` turns the rotor speeds of a `commanded` flight into `command1..4`. Without it, the
    file has `omega1..4`, and a reader takes them for measured speeds.

    **Raises:** `InputError` for a batch of flights, an infinity, or a rotor speed that is not finite; `OSError`.
    """
    if flight.time.ndim != 1:
        shape = flight.time.shape[:-1]
        refuse(path, f"one file holds one flight, got a batch of shape {shape}; write each flight to its own file")
    names, omega = SPEED_NAMES, np.asarray(flight.omega)
    if flight.commanded and airframe is not None and np.isfinite(airframe.max_rotor_speed):
        names, omega = COMMAND_NAMES, omega / np.asarray(airframe.max_rotor_speed)
    needed = {"t": np.asarray(flight.time), **dict(zip(names, omega.T, strict=True))}
    measured = Recording.of(flight).columns()
    for name, column in {**needed, **measured}.items():
        usable = np.isfinite(column) if name in needed else ~np.isinf(column)
        if not usable.all():
            index = int(np.argmin(usable))
            what = f"is {column[index]}, which a flight file cannot contain; cut the flight before it"
            refuse(path, f"sample {index}, column {name}: {what}")
    columns = needed | {name: column for name, column in measured.items() if not np.isnan(column).all()}
    with write_atomically(path) as beside, open(beside, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        rows = np.column_stack([*columns.values()])
        writer.writerows(["" if math.isnan(x) else x for x in row.tolist()] for row in rows)


def _header(path: LogPath, line: str, known: Collection[str], row: int) -> list[str]:
    """The names of the columns."""
    if not _readable(line):
        refuse(path, _NOT_UTF8, row=row)
    names = [name.strip() for name in _cells(path, line.rstrip("\n"), row)]
    if not line:
        refuse(path, "is empty; a flight needs a header row and at least two rows of data")
    if not any(names):
        refuse(path, "is empty; the first row must be the header", row=row)
    for each, shown in {";": "';'", "\t": "tabs", "|": "'|'", " ": "blanks"}.items():
        if len(names) == 1 and each in line.strip():
            refuse(path, f"is separated by {shown}; separate by commas, with points in the numbers", row=row)
    if not any(math.isnan(_float(name)) for name in names if name):
        refuse(path, "contains numbers instead of the header; write the names of the columns in a first row", row=row)
    for name in known:
        if names.count(name) > 1:
            refuse(path, f"occurs {names.count(name)} times in the header; keep one of them", row=row, column=name)
    return names


def _rows(path: LogPath, file: IO[str], width: int, first: int) -> Iterator[list[str]]:
    """The cells of each line, from row `first` on, without the blank lines at the end of the file."""
    blank = None
    for row in itertools.count(first):
        line = file.readline(_LONGEST_LINE)
        if not line:
            return
        if line.isspace():
            blank = row if blank is None else blank
            continue
        if blank is not None:
            refuse(path, "is blank; delete it", row=blank)
        cells = _cells(path, line.rstrip("\n"), row)
        if len(cells) != width:
            what = f"has {counted(len(cells), 'cell')}, but the header has {width}; repair or delete the row"
            refuse(path, what, row=row)
        yield cells


def _cells(path: LogPath, line: str, row: int) -> list[str]:
    """The cells of one line: an open quote ends with its line."""
    if len(line) >= _LONGEST_LINE - 1:
        refuse(path, "is longer than a million characters; export the log as CSV with a header row", row=row)
    if '"' not in line:
        return line.split(",")
    try:
        return next(csv.reader([line]))
    except csv.Error:
        refuse(path, "contains a cell that is too long; repair or delete the row", row=row)


def _numbers(
    path: LogPath, columns: Mapping[str, Sequence[str]], missing: Collection[str], first: int
) -> dict[str, np.ndarray]:
    """The numbers in columns of cells, from row `first` on; NaN for cells without one."""
    found, faults = {}, []
    for name, cells in columns.items():
        found[name] = np.array(_floats(cells))
        suspects = ((i, cells[i].strip()) for i in np.flatnonzero(~np.isfinite(found[name])).tolist())
        wrong = ((i, name, cell) for i, cell in suspects if cell and cell not in missing)
        faults += itertools.islice(wrong, 1)
    if faults:
        index, name, cell = min(faults, key=lambda fault: fault[0])
        fault = ", which is not a number; correct it, or"
        if math.isinf(_float(cell)):
            fault = ", which is too large for a number;"
        elif cell.lower().lstrip("+-") in _NO_NUMBER:
            fault = ";"
        what = f"contains {quoted(cell)}{fault} leave the cell empty if it was not measured"
        refuse(path, what if _readable(cell) else _NOT_UTF8, row=first + index, column=name)
    return found


def _floats(cells: Sequence[str]) -> list[float]:
    """The numbers in cells; NaN for other cells. Cells that are numbers or empty take a third of the time."""
    if not "".join(cells).translate(_IN_NUMBERS):
        with contextlib.suppress(ValueError):
            return [float(cell) if cell else math.nan for cell in cells]
    return [*map(_float, cells)]


def _float(cell: str) -> float:
    try:
        return math.nan if cell.translate(_IN_NUMBERS) else float(cell)
    except ValueError:
        return math.nan


def _readable(text: str) -> bool:
    """Whether every byte of the text could be decoded, and none is zero."""
    return "\0" not in text and (text.isascii() or not any("\ud800" <= each <= "\udfff" for each in text))
