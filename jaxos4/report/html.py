"""HTML pages that need no other file: their templates, and SVG drawings that follow a page's theme and width."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import jinja2
from markupsafe import Markup, escape

from .style import FAINT, GRID, INK, PAPER

# CSS pixels in a point, and how much a drawing may grow to reach the width of the page's text.
_PIXELS, _GROWTH = 4 / 3, 4 / 3
_THEMED = {INK: "currentColor", GRID: "var(--grid)", FAINT: "var(--faint)", PAPER: "none"}


def render(template: str, *, filters: Mapping[str, Any], **values: Any) -> str:
    """The page that a template in this folder makes of `values`. `filters`: functions for the template, by name."""
    loader, undefined = jinja2.PackageLoader("jaxos4.report", "."), jinja2.StrictUndefined
    environment = jinja2.Environment(
        loader=loader, undefined=undefined, autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= filters
    return environment.get_template(template).render(**values)


def inline(svg: bytes, stem: str, description: str, *, estimators: Sequence[str] = ()) -> Markup:
    """The element `<svg>` for a page, from an SVG file.

    **Arguments:**

    - `stem`: the ids in the element begin with this text.
    - `description`: what a screen reader says.
    - `estimators`: their names, for tooltips.
    """
    text = svg.decode()
    text = text[text.index("<svg") :]
    text = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
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
    head, rest = text.split(">", 1)
    width = re.search(r' width="([\d.]+)pt"', head)
    pixels = _PIXELS * float(width[1]) if width else 0.0
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    style = f"min-width: {0.8 * pixels:.0f}px; max-width: {_GROWTH * pixels:.0f}px"
    text = f'{head} role="img" aria-label="{escape(description)}" style="{style}">{rest}'
    return Markup(text)  # noqa: S704  # text in our SVG is outlines
