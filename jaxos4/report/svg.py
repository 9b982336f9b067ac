"""Figures as SVG, in a page or as a file."""

import itertools
import math

import numpy as np
from jaxtyping import Float
from markupsafe import Markup, escape

from .panels import FAINT, GRID, INK, PAPER, Band, Figure, Line, Mark, Panel, Scale, Words

_THEMED = {INK: "currentColor", GRID: "var(--grid)", FAINT: "var(--faint)"}
_LETTERS, _LINE = 12.0, 18.0  # the size of letters, and the height of a line of text [px]
_LETTER = 0.62 * _LETTERS  # the width of a letter [px], of a wide font, so that labels do not overlap
_TOP, _RIGHT = 8.0, 12.0  # room around the axes [px]
_SHORT = 120.0  # axes below this height [px] have two labels or more, others three
_BEYOND = 9.0  # coordinates are clipped this many panel sizes outside of the panel
# Marks: the number of their corners, the angle of the first one [degrees], and the radii of corners in turn.
_MARKS = {"o": (20, 0, (1.0,)), "s": (4, 45, (1.25,)), "D": (4, 90, (1.25,)), "^": (3, 90, (1.35,))}
_MARKS |= {"v": (3, -90, (1.35,)), "<": (3, 180, (1.35,)), "p": (5, 90, (1.15,)), "*": (10, 90, (1.4, 0.6))}
_MARKS |= {"P": (8, 90, (1.3, 0.5)), "X": (8, 45, (1.3, 0.5))}


def inline(figure: Figure, description: str) -> Markup:
    """A legend and the panels, each as an element `<svg>`, as many side by side as the page's width allows.

    Estimators are in the page's bar, not in the legend. `description`: what a screen reader says.
    """
    least, most = 0.75, 1.5  # so much is a panel shrunk or enlarged
    width, columns = max(panel.width for panel in figure.panels), min(figure.columns, len(figure.panels))
    panels = "".join(
        f'<svg viewBox="0 0 {panel.width:.0f} {panel.height:.0f}">{_panel(panel, f"{figure.stem}-area-{i}")}</svg>'
        for i, panel in enumerate(figure.panels)
    )
    legend = "".join(
        f'<span><svg class="swatch" viewBox="0 0 32 16">{swatch(mark)}</svg>{escape(name)}</span>'
        for name, mark in figure.legend().items()
        if isinstance(mark, Band) or mark.group is None
    )
    style = f"--least: {least * width:.0f}px; --most: {most * width:.0f}px; --columns: {columns}"
    label = escape(" ".join(description.split()))
    drawn = f'<div class="panels" role="img" aria-label="{label}" style="{style}">{panels}</div>'
    drawn = f'<p class="legend">{legend}</p>{drawn}' if legend else drawn
    for paint, color in itertools.product(("fill", "stroke"), _THEMED):  # in a text, quotation marks are escaped
        drawn = drawn.replace(f'{paint}="{color}"', f'{paint}="{_THEMED[color]}"')
    return Markup(drawn)  # noqa: S704  # texts are escaped


def as_file(figure: Figure) -> str:
    """The figure with its legend as a file. The same figure gives the same text."""
    columns = min(figure.columns, len(figure.panels))
    across, down = (max(size) for size in zip(*((each.width, each.height) for each in figure.panels), strict=True))
    parts = [
        f'<g transform="translate({across * (i % columns):.0f} {down * (i // columns):.0f})">'
        f"{_panel(each, f'area-{i}')}</g>"
        for i, each in enumerate(figure.panels)
    ]
    x, y, width = 10.0, down * -(-len(figure.panels) // columns) + 4, across * columns
    for name, mark in figure.legend().items():
        room = 60 + _LETTER * len(name)
        if x > 10 and x + room > width:
            x, y = 10.0, y + _LINE
        parts.append(f'<g transform="translate({x:.0f} {y:.0f})">{swatch(mark)}{_text(38, 12, name)}</g>')
        x += room
    height = y + _LINE + 4
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" '
        f'height="{height:.0f}" font-family="DejaVu Sans, system-ui, sans-serif" font-size="{_LETTERS:g}" fill="{INK}" '
        f'style="max-width: 100%; height: auto"><rect width="{width:.0f}" height="{height:.0f}" fill="{PAPER}"/>'
        f"{''.join(parts)}</svg>\n"
    )


def swatch(mark: Line | Band) -> str:
    """A sample of a mark in 32 x 16 pixels: the content of an element `<svg>`."""
    if isinstance(mark, Band):
        return f'<rect y="2" width="32" height="12" fill="{mark.color}" fill-opacity="{mark.opacity}"/>'
    sample, ends = mark._replace(width=min(mark.width, 3.0), size=min(max(mark.size, 6.0), 9.0)), np.array([0.0, 32.0])
    return _stroke(ends, np.full(2, 8.0), sample) + _marks(ends[1:] / 2, np.array([8.0]), sample)


def _panel(panel: Panel, area: str) -> str:
    """The elements of a panel. `area`: the id of the place inside its axes."""
    panel = panel.fitted()
    titles = [text for text in (panel.title, panel.subtitle) if text]
    top = _TOP + _LINE * len(titles)
    has_line = panel.x.label or panel.x.labelled()[1]
    height = panel.height - top - (_TOP if panel.bare else 22 + _LINE * bool(has_line))
    labels, power = panel.y.labelled(2 if height < _SHORT else 3)
    left = _TOP if panel.bare else 12 + _LETTER * max(map(len, [*labels.values(), _power(power)]))
    width = panel.width - left - _RIGHT
    if panel.equal:
        panel = panel._replace(**_equal(panel.x, panel.y, width, height))
    parts = [f'<clipPath id="{area}"><rect width="{width:.1f}" height="{height:.1f}"/></clipPath>']
    if not panel.bare:
        parts += _axes(panel, width, height)
    drawn = "".join(_mark(mark, panel, width, height) for mark in panel.marks)
    parts.append(f'<g clip-path="url(#{area})">{drawn}</g>')
    for each in panel.marks:
        if isinstance(each, Words):
            x, y = width * panel.x.place(each.x), height * (1 - panel.y.place(each.y))
            shift = {"start": 5, "middle": 0, "end": -5}[each.anchor]
            parts.append(_text(float(x) + shift, float(y) + 4, each.text, each.anchor))
    parts += [_text(0, _LINE * (row - len(titles)) + 10, text) for row, text in enumerate(titles)]
    return f'<g transform="translate({left:.1f} {top:.1f})">{"".join(parts)}</g>'


def _axes(panel: Panel, width: float, height: float) -> list[str]:
    """Grid, ticks and labels."""
    labels, power = panel.x.labelled()
    texts, lines, free, below = [], "", -math.inf, height + 16
    for at, text in labels.items():
        x, half = width * float(panel.x.place(at)), _LETTER * len(text) / 2
        lines += f"M{x:.1f} 0V{height:.1f}" if panel.x.lines else ""
        if x - half > free:  # a label that would touch the one before is left out
            texts.append(_text(x, below, text, "middle"))
            free = x + half + 3
    texts.append(_text(width, below + _LINE, _power(power), "end"))
    labels, power = panel.y.labelled(2 if height < _SHORT else 3)
    for at, text in labels.items():
        y = height * (1 - float(panel.y.place(at)))
        texts.append(_text(-6, y + 4, text, "end"))
        lines += f"M0 {y:.1f}H{width:.1f}" if panel.y.lines else ""
    middle = min(width / 2, width + _RIGHT - _LETTER * len(panel.x.label) / 2)
    texts += [_text(-6, -10, _power(power), "end"), _text(middle, below + _LINE, panel.x.label, "middle")]
    grid = f'<path d="{lines}" stroke="{GRID}" fill="none"/>'
    return [grid, f'<path d="M0 0V{height:.1f}H{width:.1f}" stroke="{INK}" fill="none"/>', *texts]


def _equal(x: Scale, y: Scale, width: float, height: float) -> dict[str, Scale]:
    """Both axes with the same middles, and one length of a unit."""
    ends = [scale.ends or (0.0, 1.0) for scale in (x, y)]
    unit = max((high - low) / size for (low, high), size in zip(ends, (width, height), strict=True)) / 2
    made = [
        ((low + high) / 2 - unit * s, (low + high) / 2 + unit * s)
        for (low, high), s in zip(ends, (width, height), strict=True)
    ]
    return {"x": x._replace(ends=made[0]), "y": y._replace(ends=made[1])}


def _mark(mark: Mark, panel: Panel, width: float, height: float) -> str:
    if isinstance(mark, Words):
        return ""
    x = width * np.clip(panel.x.place(mark.x), -_BEYOND, _BEYOND)
    ys = (mark.low, mark.high) if isinstance(mark, Band) else (mark.y, mark.y)
    low, high = (height * np.clip(1 - panel.y.place(each), -_BEYOND, _BEYOND) for each in ys)
    if isinstance(mark, Line):
        drawn, group = _stroke(x, low, mark) + _marks(x, low, mark), mark.group
        tip = mark.tip or (mark.name if group is not None else "")
        owner, title = f' data-estimator="{group}"' if group is not None else "", f"<title>{escape(tip)}</title>"
        return f"<g{owner}>{title if tip else ''}{drawn}</g>" if drawn and (owner or tip) else drawn
    known, d = np.isfinite(x + low + high), ""
    for part in np.split(np.arange(known.size), np.flatnonzero(np.diff(known)) + 1):
        if known[part].any():
            back = part[::-1]
            d += f"{_path(np.append(x[part], x[back]), np.append(high[part], low[back]))}z"
    return f'<path d="{d}" fill="{mark.color}" fill-opacity="{mark.opacity}"/>' if d else ""


def _stroke(x: np.ndarray, y: np.ndarray, mark: Line) -> str:
    d, dashes = _path(x, y) if mark.width else "", " ".join(f"{mark.width * length:.3g}" for length in mark.dash[1])
    dash = f' stroke-dasharray="{dashes}"' if dashes else ""
    return f'<path d="{d}" fill="none" stroke="{mark.color}" stroke-width="{mark.width:.3g}"{dash}/>' if d else ""


def _marks(x: np.ndarray, y: np.ndarray, mark: Line) -> str:
    if not mark.marker:
        return ""
    shape, known = mark.size / 2 * corners(mark.marker), np.isfinite(x + y)
    d = "".join(f"{_path(*(shape * [1, -1] + [a, b]).T)}z" for a, b in zip(x[known], y[known], strict=True))
    look = f'fill="none" stroke="{mark.color}"' if mark.hollow else f'fill="{mark.color}"'
    return f'<path d="{d}" {look}/>' if d else ""


def _path(x: np.ndarray, y: np.ndarray) -> str:
    """A path through points, which begins anew after a gap."""
    known = np.isfinite(x + y)
    begins = known & ~np.append(False, known[:-1])
    points = zip(begins.tolist(), x.tolist(), y.tolist(), known.tolist(), strict=True)
    return "".join(f"{'M' if begin else ' '}{a:.1f} {b:.1f}" for begin, a, b, seen in points if seen)


def corners(marker: str) -> Float[np.ndarray, "corners 2"]:
    """The corners of a mark as large as a circle of radius 1."""
    count, first, radii = _MARKS[marker]
    angle = np.radians(first) + 2 * np.pi * np.arange(count) / count
    return np.resize(radii, count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _power(power: int) -> str:
    return f"×1e{power}" if power else ""


def _text(x: float, y: float, text: str, anchor: str = "start") -> str:
    where = f' text-anchor="{anchor}"' if anchor != "start" else ""
    return f'<text x="{x:.1f}" y="{y:.1f}"{where}>{escape(text)}</text>' if text else ""
