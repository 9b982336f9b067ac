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


def plain(value: float | None, digits: int = 3) -> str:
    """A number with `digits` significant digits, and a power of ten if it is very small or large.

    NaN and `None` are a dash.
    """
    if value is None or not math.isfinite(value):
        return DASH if value is None or math.isnan(value) else f"{value:g}"
    if value == 0:
        return "0"
    mantissa, power = f"{value:.{digits - 1}e}".split("e")
    exponent = int(power)
    if not -3 <= exponent < 6:
        return f"{mantissa}e{exponent}"
    return f"{round(value, digits - 1 - exponent):.{max(digits - 1 - exponent, 0)}f}"


def span(ends: Sequence[float | None] | None, digits: int = 4) -> str:
    """An interval in words; empty if there is none."""
    return "" if ends is None else " to ".join(plain(end, digits) for end in ends)


WORDED = ("note", "use", "cause", "size", "what to do", "pooled value")
"""The headings of columns of words, whose cells can have several lines."""
_WORDS = 20  # characters; the least width of such a column, if its words are as long: a narrower one is hard to read


class Listing(NamedTuple):
    """A table as text.

    - `right`: the headings of the columns that are aligned to the right.
    - `apart`: the number of blanks between columns.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    right: Sequence[str] = ()
    apart: int = 2

    def print_on(self, console: Console) -> None:
        """Prints the table. A last column of notes becomes lines below it if the terminal is too narrow."""
        has_notes, names = self.headings[-1] == "note", dict[str, list[str]]()
        for row in self.rows if has_notes else ():
            names.setdefault(row[-1], []).append(row[0])
        names.pop("", None)
        if not has_notes or (names and _needed_width(self.table()) <= console.width):
            print_whole(console, self.table())
            return
        short = Listing(self.headings[:-1], [row[:-1] for row in self.rows], self.right, self.apart)
        print_whole(console, short.table())
        for note, rows in names.items():
            say(console, f"{', '.join(rows)}: {note}")

    def table(self) -> Table:
        """The table with all its columns."""
        padding = (0, self.apart - 1, 0, 0)
        table = Table(box=rich.box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=padding)
        for i, heading in enumerate(self.headings):
            widest, wraps = max(len(row[i]) for row in (self.headings, *self.rows)), heading in WORDED
            width, justify = min(widest, _WORDS) if wraps else widest, "right" if heading in self.right else "left"
            table.add_column(heading, justify=justify, no_wrap=not wraps, min_width=width)
        for row in self.rows:
            table.add_row(*map(Text, row))
        return table


def with_unit(name: str, unit: str) -> str:
    """A name with its unit, such as "Ix [kg m^2]"; a number has none."""
    return name if unit == "1" else f"{name} [{unit}]"


def say(console: Console, line: str, style: str | None = None, *, soft_wrap: bool = False) -> None:
    """Prints a line as it is: no markup, and no colours but those of `style`. `soft_wrap`: the terminal breaks it."""
    console.print(line, style=style, markup=False, highlight=False, soft_wrap=soft_wrap)


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
