"""An SVG file as a part of a page: it follows the page's theme and width, and each estimator in it can be hidden."""

import re

from .style import FAINT, GRID, INK, PAPER

# Pixels a point: the drawing may grow by a third, to the width of the page's text.
_PIXELS = 4 / 3 * 4 / 3
_THEMED = {INK: "currentColor", GRID: "var(--grid)", FAINT: "var(--faint)", PAPER: "none"}


def inline(svg: bytes, stem: str, label: str) -> str:
    """The element `<svg>`, with ids that begin with `stem`. `label` is what a screen reader says, already escaped."""
    text = svg.decode()
    text = text[text.index("<svg") :]
    text = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="estimator-(\d+)"', r'data-estimator="\1"', text)
    text = re.sub(r'\bid="([^"]+)"', rf'id="{stem}--\1"', text)
    text = re.sub(r'href="#([^"]+)"', rf'href="#{stem}--\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{stem}--\1)", text)
    for color, themed in _THEMED.items():
        text = text.replace(color, themed)
    width = re.search(r'<svg[^>]* width="([\d.]+)pt"', text)
    points = float(width.group(1)) if width else 0.0
    head, rest = text.split(">", 1)
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    return f'{head} role="img" aria-label="{label}" style="max-width: {points * _PIXELS:.0f}px">{rest}'
