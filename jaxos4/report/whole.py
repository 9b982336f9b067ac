"""Tables for a terminal in which no cell is ever cut."""

from collections.abc import Sequence
from typing import NamedTuple

import rich.box
from rich.console import Console, ConsoleDimensions, RenderableType
from rich.measure import Measurement
from rich.table import Table

_WIDEST = 10_000
_WORDS = 20  # columns of a terminal; a narrower column of words would be hard to read


class Listing(NamedTuple):
    """A table as text.

    - `right`: the headings of the columns that are aligned to the right.
    - `notes`: one for each row, about what the first cell names; empty cells where there is none.
    - `wraps`: the headings of columns of words, whose cells may have several lines.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    right: Sequence[str] = ()
    notes: Sequence[str] = ()
    wraps: Sequence[str] = ()

    def print_on(self, console: Console) -> None:
        """Print the table. Notes are its last column, or lines below it if the terminal is too narrow."""
        if any(self.notes):
            rows = [[*row, note] for row, note in zip(self.rows, self.notes, strict=True)]
            table = self._table(rows, last="note")
            if needed_width(table) <= console.width:
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


def needed_width(table: RenderableType) -> int:
    """How many columns of a terminal hold a table of which nothing is cut."""
    console = Console(width=_WIDEST)
    return Measurement.get(console, console.options, table).minimum


def print_whole(console: Console, table: RenderableType) -> None:
    """Print a table, wider than the terminal if it must be: the terminal then breaks its lines."""
    size = console.size
    console.size = ConsoleDimensions(max(needed_width(table), size.width), size.height)
    try:
        console.print(table, crop=False, markup=False)
    finally:
        console.size = size
