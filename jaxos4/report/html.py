"""HTML pages that need no other file: their templates, and the panels of SVG drawings in a page's theme and width."""

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup, escape
from matplotlib.figure import Figure
from matplotlib.markers import MarkerStyle

from .._templates import templates
from .style import FAINT, GRID, INK, PAPER, Style, panel_boxes, svg
from .text import DASH, plain

_THEMED = {INK: "currentColor", GRID: "var(--grid)", FAINT: "var(--faint)", PAPER: "none"}


class Drawing(NamedTuple):
    """A figure: the stem of the names of its file and ids, its SVG, and the boxes of its panels."""

    stem: str
    svg: bytes
    boxes: list[list[float]]


def draw(figure: Figure, stem: str) -> Drawing:
    """Draws a figure for a page."""
    return Drawing(stem, svg(figure), panel_boxes(figure).tolist())


def render(template: str, **values: Any) -> str:
    """The page that a template in this folder makes of `values`."""
    environment = templates("jaxos4.report")
    environment.filters |= {"inline": inline, "plain": plain, "number": _number}
    environment.filters["interval"] = lambda ends: "" if ends is None else " to ".join(map(_number, ends))
    environment.filters["share"] = lambda value: DASH if value is None else f"{value:.2f}"
    return environment.get_template(template).render(**values)


def _number(value: float | None, digits: int = 4) -> str:
    return DASH if value is None else plain(value, digits)


def inline(drawing: Drawing, description: str, estimators: Sequence[str] = ()) -> Markup:
    """The panels of a drawing, each as an element `<svg>`, as many side by side as the page's width allows; no legend.

    `description`: what a screen reader says. `estimators`: their names, for tooltips.
    """
    text, stem = drawing.svg.decode(), drawing.stem
    # Coordinates to a hundredth of a point: a third of the bytes.
    text = re.sub(r'(?<= )(d|x|y)="[^"]*"', lambda match: re.sub(r"(\.\d\d)\d+", r"\1", match[0]), text)

    def estimator(match: re.Match[str]) -> str:
        place = int(match[1])
        tip = match[2] or (escape(estimators[place]) if place < len(estimators) else "")
        return f'<g data-estimator="{place}">' + (f"<title>{tip}</title>" if tip else "")

    text = re.sub(r'<g id="estimator-(\d+)(?:: ([^"]*))?">', estimator, text)
    text = re.sub(r'\bid="([^"]+)"', rf'id="{stem}--\1"', text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{stem}--\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{stem}--\1)", text)
    for color, themed in _THEMED.items():
        text = text.replace(color, themed)
    panels = re.findall(r'^  <g id="\S+--axes_\d+">$.*?^  </g>$', text, flags=re.DOTALL | re.MULTILINE)
    panels[-1] += text[text.rindex("<defs>") : text.rindex("</svg>")]
    panels = list(map(_compact, panels))
    points, columns = drawing.boxes[0][2], len({round(box[0]) for box in drawing.boxes})
    width, shrinks, grows = 4 / 3 * points, 0.78, 1.5  # a CSS pixel is 3/4 of a point
    style = f"--least: {shrinks * width:.0f}px; --most: {grows * width:.0f}px; --columns: {columns}"
    shown = [
        f'<svg viewBox="{" ".join(f"{x:.1f}" for x in box)}">{panel}</svg>'
        for box, panel in zip(drawing.boxes, panels, strict=True)
    ]
    label = escape(" ".join(description.split()))
    return Markup(f'<div class="panels" role="img" aria-label="{label}" style="{style}">{"".join(shown)}</div>')  # noqa: S704  # text in our SVG is outlines


def _compact(panel: str) -> str:
    """The same drawing in half of the bytes: no comments, no blanks between elements, no ids that nothing refers to."""
    panel = re.sub(r"<!--.*?-->", "", panel, flags=re.DOTALL)
    panel = re.sub(r' id="[^"]*--(line2d|patch|[xy]tick|matplotlib\.axis)_\d+"', "", panel).replace(
        "xlink:href", "href"
    )
    panel = re.sub(r' d="[^"]*"', lambda path: " d" + re.sub(r"\s*([A-Za-z])\s+", r"\1", path[0][2:]), panel)
    panel = re.sub(r"translate\([^)]*\)", lambda moved: re.sub(r"(\.\d\d)\d+", r"\1", moved[0]), panel)
    return re.sub(r">\s+<", "><", panel)


def swatch(look: Style) -> Markup:
    """A line of 32 x 16 pixels with a mark, as a figure draws a series: the content of an element `<svg>`."""
    marker, (_, dash) = MarkerStyle(look.marker), look.dash
    points = np.asarray(marker.get_path().transformed(marker.get_transform()).to_polygons()[0])
    mark = " ".join(f"{16 + 9 * x:.1f},{8 - 9 * y:.1f}" for x, y in points)
    dashes = " ".join(f"{1.6 * length:g}" for length in dash)
    line = f'<path d="M0 8H32" stroke="{look.color}" stroke-width="1.6" stroke-dasharray="{dashes}"/>'
    return Markup(f'{line}<polygon points="{mark}" fill="{look.color}"/>')  # noqa: S704  # text of our own
