"""HTML pages that need no other file: sections of texts, tables, figures and signals."""

from collections.abc import Sequence
from typing import NamedTuple

from markupsafe import Markup

from .._templates import templates
from .panels import Figure, Line
from .style import Style
from .svg import inline, swatch
from .text import DASH, plain


class Entry(NamedTuple):
    """A number as text, with its interval and its mark."""

    text: str
    interval: str = ""
    mark: str = ""


class Row(NamedTuple):
    """A row of a table: its name and its cells.

    `estimator`: the number of the estimator whose row it is, which the page hides with it. `reference`: not estimated.
    """

    name: str
    cells: Sequence[Entry]
    estimator: int | None = None
    reference: bool = False

    @classmethod
    def of(cls, name: str, *cells: str | Entry, reference: bool = False) -> "Row":
        """A row of texts."""
        return cls(name, [Entry(cell) if isinstance(cell, str) else cell for cell in cells], reference=reference)


class Table(NamedTuple):
    """A table. On a narrow screen each row is a card, in which headings stand above cells; if `wide`, on a tablet too.

    - `headings`: of all columns, some with a unit: `"rate [Hz]"`.
    - `groups`: rows below a name; an empty one: no group.
    - `notes`: paragraphs below the table.
    """

    id: str
    caption: str
    headings: Sequence[str]
    groups: Sequence[tuple[str, Sequence[Row]]]
    notes: Sequence[str] = ()
    wide: bool = False
    kind = "table"


class Picture(NamedTuple):
    """A figure with its caption, whose first sentence is what a screen reader says."""

    figure: Figure
    caption: str
    title: str = ""
    kind = "picture"

    @property
    def drawn(self) -> Markup:
        """The figure as SVG."""
        return inline(self.figure, self.title or self.caption.split(". ")[0])


class Signals(NamedTuple):
    """Signals on a time axis, see `timeline.py`.

    `choice`: the name of the list of views. `range`: whether the part in sight is named, for the command line.
    """

    signals: str
    caption: str
    choice: str = ""
    range: bool = False
    kind = "signals"


class Text(NamedTuple):
    """A paragraph, or a list of sentences. `look`: a class of the style sheet `page.css`."""

    text: str | Sequence[str]
    look: str = ""
    id: str = ""
    kind = "text"


class Folded(NamedTuple):
    """Parts that a click on the `summary` shows."""

    summary: str
    parts: Sequence["Part"]
    id: str = ""
    is_open: bool = False
    kind = "folded"


Part = Table | Picture | Signals | Text | Folded


class Section(NamedTuple):
    """Parts below a heading. `link`: its name in the bar, if it has no estimators. `level`: of the heading."""

    id: str
    title: str
    parts: Sequence[Part]
    link: str = ""
    level: int = 2


def page(
    *,
    title: str,
    about: str,
    top: Sequence[Part],
    sections: Sequence[Section],
    command: str = "",
    notes: Sequence[str] = (),
    provenance: Sequence[tuple[str, str]] = (),
    after: Sequence[Part] = (),
    estimators: dict[str, Style] | None = None,
) -> str:
    """A page of sections below its `title`, what it is `about`, and the parts at the `top`.

    - `command`, `notes`, `provenance`, `after`: its end. Text: labels and values.
    - `estimators`: which the bar shows and hides, instead of links to the sections.
    """
    samples = {
        name: Markup(swatch(Line([], [], look.color, dash=look.dash, marker=look.marker)))  # noqa: S704  # our own
        for name, look in (estimators or {}).items()
    }
    has_signals = any(isinstance(part, Signals) for section in sections for part in section.parts)
    return (
        templates("jaxos4.report")
        .get_template("page.html.j2")
        .render(
            title=title,
            about=about,
            top=top,
            sections=[each for each in sections if each.parts],
            command=command,
            notes=notes,
            provenance=provenance,
            after=after,
            swatches=samples,
            has_signals=has_signals,
        )
    )


def number(value: float | None, digits: int = 4) -> str:
    """A number with so many digits, or a dash."""
    return DASH if value is None else plain(value, digits)


def span(ends: Sequence[float | None] | None) -> str:
    """An interval in words; empty if there is none."""
    return "" if ends is None else " to ".join(map(number, ends))
