"""Text for terminals and pages: numbers with significant digits, and tables in which no cell is ever cut."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import rich.box
from rich.console import Console, ConsoleDimensions, RenderableType
from rich.measure import Measurement
from rich.table import Table

MISSING = "–"
_WIDEST = 10_000
_WORDS = 20  # columns of a terminal; a narrower column of words would be hard to read


def plain(value: float, digits: int = 3) -> str:
    """`value` with so many significant digits, and a power of ten if it is very small or large; a dash if it is NaN."""
    if not math.isfinite(value):
        return MISSING if math.isnan(value) else f"{value:g}"
    if value == 0:
        return "0"
    mantissa, power = f"{value:.{digits - 1}e}".split("e")
    exponent = int(power)
    if not -3 <= exponent < 6:
        return f"{mantissa}e{exponent}"
    return f"{round(value, digits - 1 - exponent):.{max(digits - 1 - exponent, 0)}f}"


def percent(share: float, digits: int = 1) -> str:
    """A share in percent, without the sign %; a dash if it is NaN."""
    return MISSING if math.isnan(share) else f"{100 * share:.{digits}f}"


class Listing(NamedTuple):
    """A table as text.

    - `right`: the headings of the columns that are aligned to the right.
    - `notes`: one for each row, about the item in its first cell; an empty string for none.
    - `wraps`: the headings of columns of words, whose cells may have several lines.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    right: Sequence[str] = ()
    notes: Sequence[str] = ()
    wraps: Sequence[str] = ()

    def print_on(self, console: Console) -> None:
        """Prints the table. Notes are its last column, or lines below it if the terminal is too narrow."""
        if any(self.notes):
            rows = [[*row, note] for row, note in zip(self.rows, self.notes, strict=True)]
            table = self._table(rows, last="note")
            if _needed_width(table) <= console.width:
                print_whole(console, table)
                return
        print_whole(console, self._table(self.rows))
        names: dict[str, list[str]] = {}
        for row, note in zip(self.rows, self.notes, strict=False):
            names.setdefault(note, []).append(row[0])
        for note in filter(None, names):
            console.print(f"{', '.join(names[note])}: {note}", markup=False, highlight=False)

    def _table(self, rows: Sequence[Sequence[str]], *, last: str = "") -> Table:
        table = Table(box=rich.box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
        for i, heading in enumerate((*self.headings, *[last] * bool(last))):
            widest = max(len(cell) for cell in (heading, *(row[i] for row in rows)))
            wraps = heading in (last, *self.wraps)
            table.add_column(
                heading,
                justify="right" if heading in self.right else "left",
                no_wrap=not wraps,
                min_width=min(widest, _WORDS) if wraps else widest,
            )
        for row in rows:
            table.add_row(*row)
        return table


def print_whole(console: Console, table: RenderableType) -> None:
    """Prints a table, wider than the terminal if it must be: the terminal then breaks its lines."""
    size = console.size
    console.size = ConsoleDimensions(max(_needed_width(table), size.width), size.height)
    try:
        console.print(table, crop=False, markup=False)
    finally:
        console.size = size


def _needed_width(table: RenderableType) -> int:
    """The number of terminal columns that a table needs if nothing is cut."""
    console = Console(width=_WIDEST)
    return Measurement.get(console, console.options, table).minimum
