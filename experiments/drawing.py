"""What the figures of experiments share: axes, points with bars, and the command that writes them."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr

from jaxos4._files import write_file
from jaxos4.report.matplotlib_figures import as_pdf
from jaxos4.report.panels import EVERYWHERE, Figure, Line, Mark, Panel, Scale, Style, Values, spread
from jaxos4.report.svg import as_file

PERCENT = Scale(ends=(-5.0, 105.0))


def level(y: float, **look: Any) -> Line:
    """A line across a panel."""
    return Line(EVERYWHERE, (y, y), width=1.3)._replace(**look)


def named_axis(names: Iterable[object], label: str = "") -> Scale:
    """An x axis with a name at each whole number."""
    ticks: dict[float, str] = {place: str(name) for place, name in enumerate(names)}
    return Scale(ends=(-0.6, len(ticks) - 0.4), ticks=ticks, label=label, lines=False)


def named_rows(names: Iterable[object]) -> Scale:
    """A y axis with a name at each whole number, from top to bottom."""
    columns = named_axis(names)
    return columns._replace(ends=(len(columns.ticks or ()) - 0.4, -0.6))


def axis_at(values: Iterable[float], label: str, kind: Literal["linear", "log"] = "linear") -> Scale:
    """An axis with a tick at each of these values."""
    return Scale(kind, ticks={float(value): f"{value:g}" for value in values}, label=label)


def points(x: Values, y: Values, look: Style, name: str = "", half: Values | None = None, **others: Any) -> list[Mark]:
    """A line through points in this style, with bars of these half-widths."""
    found: list[Mark] = [Line(x, y, look.color, 1.6, look.dash, look.marker, 5.5, name=name)._replace(**others)]
    if half is not None:
        y, half = np.asarray(y, dtype=float), np.asarray(half, dtype=float)
        found.append(spread(x, y - half, y + half, color=look.color, width=1.3))
    return found


def of_parameters(x: np.ndarray, values: xr.DataArray, look: Style, name: str, **others: Any) -> list[Mark]:
    """The geometric mean over the parameters at each x, with a bar from the smallest to the largest."""
    values = values.transpose(..., "parameter")
    mean = np.exp(xr.apply_ufunc(np.log, values.where(values > 0)).mean("parameter").values)
    low, high = (end.values for end in (values.min("parameter"), values.max("parameter")))
    return [*points(x, mean, look, name, **others), spread(x, low, high, color=look.color, width=1.3)]


def alike(panels: Sequence[Panel]) -> list[Panel]:
    """Panels with one y axis, which has room for all of them."""
    ends = [end for panel in panels for end in panel.fitted().y.ends or ()]
    return [panel._replace(y=panel.y._replace(ends=(min(ends), max(ends)))) for panel in panels]


def plotter(read: Callable[[Path], Any], drawn: dict[str, Callable[[Any], Figure | None]]) -> Callable[..., None]:
    """The command that reads results and writes figures, by the names of their files, as SVG and PDF.

    A figure that is `None` is left out.
    """

    def main(results: Path, figures: Path) -> None:
        """Draws the results of the experiment."""
        found = read(results)
        figures.mkdir(parents=True, exist_ok=True)
        for name, draw in drawn.items():
            if (figure := draw(found)) is not None:
                write_file(figures / f"{name}.svg", as_file(figure))
                write_file(figures / f"{name}.pdf", as_pdf(figure))

    return main
