"""Text for terminals and pages: numbers with significant digits, and tables in which no cell is ever cut."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import rich.box
from rich.console import Console, ConsoleDimensions, RenderableType
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

DASH = "–"


def plain(value: float, digits: int = 3) -> str:
    """A number with `digits` significant digits, and a power of ten if it is very small or large. NaN is a dash."""
    if not math.isfinite(value):
        return DASH if math.isnan(value) else f"{value:g}"
    if value == 0:
        return "0"
    mantissa, power = f"{value:.{digits - 1}e}".split("e")
    exponent = int(power)
    if not -3 <= exponent < 6:
        return f"{mantissa}e{exponent}"
    return f"{round(value, digits - 1 - exponent):.{max(digits - 1 - exponent, 0)}f}"


def percent(share: float) -> str:
    """A share in percent, without the sign %. NaN is a dash."""
    return DASH if math.isnan(share) else f"{100 * share:.1f}"


class Listing(NamedTuple):
    """A table as text.

    - `right`: the headings of the columns that are aligned to the right.
    - `notes`: a note for each row, about the item in its first cell; an empty string if there is none.
    - `wraps`: the headings of the columns of words. Their cells can have several lines.
    - `apart`: the number of blanks between columns.
    - `words`: the least width of a column of words, if they are as long: a narrower one would be hard to read.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    right: Sequence[str] = ()
    notes: Sequence[str] = ()
    wraps: Sequence[str] = ()
    apart: int = 2
    words: int = 20

    def print_on(self, console: Console) -> None:
        """Prints the table. Notes are its last column, or lines below it if the terminal is too narrow."""
        if any(self.notes):
            rows = [[*row, note] for row, note in zip(self.rows, self.notes, strict=True)]
            with_notes = Listing([*self.headings, "note"], rows, self.right, wraps=[*self.wraps, "note"]).table()
            if _needed_width(with_notes) <= console.width:
                print_whole(console, with_notes)
                return
        print_whole(console, self.table())
        names: dict[str, list[str]] = {}
        for row, note in zip(self.rows, self.notes, strict=False):
            names.setdefault(note, []).append(row[0])
        for note in filter(None, names):
            say(console, f"{', '.join(names[note])}: {note}")

    def table(self) -> Table:
        """The table without its notes."""
        padding = (0, self.apart - 1, 0, 0)
        table = Table(box=rich.box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=padding)
        for i, heading in enumerate(self.headings):
            widest, wraps = max(len(row[i]) for row in (self.headings, *self.rows)), heading in self.wraps
            width, justify = min(widest, self.words) if wraps else widest, "right" if heading in self.right else "left"
            table.add_column(heading, justify=justify, no_wrap=not wraps, min_width=width)
        for row in self.rows:
            table.add_row(*map(Text, row))
        return table


def say(console: Console, line: str, style: str | None = None) -> None:
    """Prints a line as it is: no markup, and no colours but those of `style`."""
    console.print(line, style=style, markup=False, highlight=False)


def print_whole(console: Console, table: RenderableType) -> None:
    """Prints a table without cutting a cell. If the table is wider than the terminal, the terminal breaks its lines."""
    size = console.size
    console.size = ConsoleDimensions(max(_needed_width(table), size.width), size.height)
    try:
        console.print(table, crop=False, markup=False)
    finally:
        console.size = size


def _needed_width(table: RenderableType) -> int:
    """The number of terminal columns that a table needs if nothing is cut."""
    console = Console(width=10_000)
    return Measurement.get(console, console.options, table).minimum
