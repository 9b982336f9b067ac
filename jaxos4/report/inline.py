"""An SVG file as a part of a page: it follows the page's theme and width, and each estimator in it can be hidden."""

import re
from collections.abc import Sequence
from typing import NamedTuple

from markupsafe import Markup, escape

from .style import FAINT, GRID, INK, PAPER

# CSS pixels in a point, and how much a drawing may grow to reach the width of the page's text.
_PIXELS, _GROWTH = 4 / 3, 4 / 3
_THEMED = {INK: "currentColor", GRID: "var(--grid)", FAINT: "var(--faint)", PAPER: "none"}


class Drawing(NamedTuple):
    """One choice of a figure on a page: its label, the element `<svg>`, and whether the page shows it first."""

    label: str
    svg: Markup
    chosen: bool


def drawings(
    files: Sequence[bytes],
    labels: Sequence[str],
    chosen: int,
    *,
    stem: str,
    description: str,
    estimators: Sequence[str] = (),
) -> tuple[Drawing, ...]:
    """SVG files, one of which the page shows at a time.

    **Arguments:**

    - `labels`, `chosen`: of the files in the page's list of choices; the index of the first choice.
    - `stem`: the ids in the elements begin with it.
    - `description`: what a screen reader says.
    - `estimators`: their names, for tooltips.
    """
    made = []
    for i, (file, label) in enumerate(zip(files, labels, strict=True)):
        said = escape(f"{description}, {label}" if label else description)
        element = Markup(_inline(file, f"{stem}-{i}", said, estimators))  # noqa: S704  # names in our SVG are outlines
        made.append(Drawing(label, element, i == chosen))
    return tuple(made)


def _inline(svg: bytes, stem: str, description: str, estimators: Sequence[str]) -> str:
    text = svg.decode()
    text = text[text.index("<svg") :]
    text = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'(?<= )(d|x|y)="[^"]*"', _rounded, text)

    def estimator(found: re.Match[str]) -> str:
        place = int(found[1])
        tip = found[2] or (escape(estimators[place]) if place < len(estimators) else "")
        return f'<g data-estimator="{place}">' + (f"<title>{tip}</title>" if tip else "")

    text = re.sub(r'<g id="estimator-(\d+)(?:: ([^"]*))?">', estimator, text)
    text = re.sub(r'\bid="([^"]+)"', rf'id="{stem}--\1"', text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{stem}--\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{stem}--\1)", text)
    for color, themed in _THEMED.items():
        text = text.replace(color, themed)
    head, rest = text.split(">", 1)
    width = re.search(r' width="([\d.]+)pt"', head)
    pixels = _PIXELS * float(width[1]) if width else 0.0
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    style = f"min-width: {0.8 * pixels:.0f}px; max-width: {_GROWTH * pixels:.0f}px"
    return f'{head} role="img" aria-label="{description}" style="{style}">{rest}'


def _rounded(attribute: re.Match[str]) -> str:
    """Coordinates to a hundredth of a point: a third of the bytes."""
    return re.sub(r"(\.\d\d)\d+", r"\1", attribute[0])
