"""HTML pages that need no other file: sections of texts, tables, figures and signals."""

import functools
import os
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from markupsafe import Markup, escape

from .._files import templates, write_file
from .panels import Figure, Line, Style
from .svg import inline, swatch
from .text import WORDED


class Section(NamedTuple):
    """Parts below a heading. `link`: its name in the bar, if it has no estimators. `level`: of the heading."""

    id: str
    title: str
    parts: Sequence[Markup]
    link: str = ""
    level: int = 2


def with_code(text: str) -> Markup:
    """A text in which names between backticks are code."""
    return Markup(re.sub("`([^`]*)`", r"<code>\1</code>", str(escape(text))))  # noqa: S704  # escaped


@functools.cache
def template(name: str) -> Any:
    """A template of this folder. Its filter `code`: `with_code`."""
    found = templates("jaxos4.report")
    found.filters["code"], found.globals["worded"] = with_code, WORDED
    return found.get_template(name)


def _part(kind: str, *given: Any) -> Markup:
    return getattr(template("parts.html.j2").module, kind)(*given)


def table(
    id: str,
    caption: str,
    headings: Sequence[str],
    rows: Sequence[str | Sequence[str]],
    notes: Sequence[str] = (),
    estimators: Sequence[str] = (),
) -> Markup:
    """A table; nothing without rows. On a narrow screen each row is a card, in which headings stand above cells.

    - `headings`: column heads, some with a unit: `"rate [Hz]"`.
    - `rows`: the name of each row and its cells; a text instead of a row is the name of the rows below it. The second
      line of a cell is small.
    - `notes`: paragraphs below the table.
    - `estimators`: those of the page's bar, which hides the rows that have their names.
    """
    return _part("table", id, caption, headings, rows, notes, estimators) if rows else Markup()


def picture(figure: Figure, caption: str, title: str = "") -> Markup:
    """A figure with its caption, whose first sentence is what a screen reader says."""
    return _part("picture", figure.stem, inline(figure, title or caption.split(". ")[0]), caption, title)


def signals(drawn: str, caption: str, *, choice: str = "", names_part: bool = False) -> Markup:
    """Signals on a time axis, see `timeline.py`.

    `choice`: the name of the list of views. `names_part`: whether the part in sight is named, for the command line.
    """
    return _part("signals", drawn, caption, choice, names_part)


def text(given: str | Sequence[str], look: str = "", id: str = "") -> Markup:
    """A paragraph, or a list of sentences; nothing if there are none. `look`: a class of the style sheet `page.css`."""
    return _part("text", given, look, id) if given else Markup()


def folded(summary: str, *parts: Markup, id: str = "", is_open: bool = False) -> Markup:
    """Parts that a click on the `summary` shows."""
    return _part("folded", summary, parts, id, is_open)


def write_page(
    path: str | os.PathLike[str],
    *,
    title: str,
    about: str,
    top: Sequence[Markup],
    sections: Sequence[Section],
    end: Sequence[Markup] = (),
    command: str = "",
    provenance: Sequence[tuple[str, str]] = (),
    estimators: dict[str, Style] | None = None,
) -> None:
    """Writes a page, completely or not at all: its `title`, what it is `about`, the `top`, sections, how it was made.

    Sections without parts are left out.

    - `command`, `end`, `provenance`: the last section. Provenance: labels and values.
    - `estimators`: which the bar shows and hides, instead of links to the sections.

    **Raises:** `OSError`.
    """
    swatches = {
        name: Markup(swatch(Line([], [], look.color, dash=look.dash, marker=look.marker)))  # noqa: S704  # our own
        for name, look in (estimators or {}).items()
    }
    filled = [each for each in sections if any(each.parts)]
    given = {"title": title, "about": about, "top": top, "sections": filled, "end": end, "command": command}
    has_signals = any('id="timeline"' in part for each in filled for part in each.parts)  # its scripts are long
    given |= {"provenance": provenance, "swatches": swatches, "has_signals": has_signals}
    write_file(path, template("page.html.j2").render(given))
