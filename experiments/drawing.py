"""Matplotlib's figures in the style of this library: grids of panels, logarithmic axes, and reproducible files."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullLocator

from jaxos4._files import write_file
from jaxos4.report.matplotlib_figures import drawing, rendered
from jaxos4.report.panels import Style


def grid(panels: int, *, columns: int, width: float = 9.0, height: float = 2.1) -> tuple[Figure, list[Axes]]:
    """A figure with a grid of panels. `height`: the height of one row of panels [inch]."""
    columns = min(columns, panels)
    rows = -(-panels // columns)
    figure = Figure(figsize=(width, height * rows + 0.5), layout="constrained")
    return figure, [figure.add_subplot(rows, columns, i + 1) for i in range(panels)]


def log_axis(axes: Axes, which: str) -> None:
    """Logarithmic axes with plain numbers: `"x"`, `"y"` or `"xy"`."""
    for letter in which:
        getattr(axes, f"set_{letter}scale")("log")
        axis: Axis = getattr(axes, f"{letter}axis")
        low, high = sorted(getattr(axes, f"get_{letter}lim")())
        if low > 0 and high / low < 5:
            axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))  # 1 is a tick if it is in the range
        elif low > 0 and high / low < 30:
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}".replace("e-0", "e-")))
        axis.set_minor_locator(NullLocator())  # minor ticks are slow to draw


def scale_axis(axes: Axes, scales: np.ndarray) -> None:
    """A logarithmic x axis with a tick at each noise scale."""
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(FixedLocator(list(scales)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlim(scales.min() / 1.8, scales.max() * 1.8)


def name_axis(axes: Axes, names: Sequence[str]) -> None:
    """An x axis with a name at each whole number."""
    axes.set_xticks(range(len(names)), names)
    axes.grid(visible=False, axis="x")


def line(look: Style, **others: Any) -> dict[str, Any]:
    """A style as arguments of Matplotlib."""
    return {"color": look.color, "marker": look.marker, "linestyle": look.dash} | others


def legend(figure: Figure, panel: Axes, columns: int) -> None:
    """The legend of one panel below all panels; each label once."""
    handles, labels = panel.get_legend_handles_labels()
    named = dict(zip(labels, handles, strict=True))
    figure.legend(list(named.values()), list(named), loc="outside lower center", ncols=columns)


def draw_spread(panel: Axes, x: np.ndarray, values: xr.DataArray, look: Style, label: str) -> None:
    """Draws the geometric mean over the parameters at each x, with a bar from the smallest to the largest."""
    values = values.transpose(..., "parameter")
    finite = values.notnull().any("parameter").values
    logarithm = xr.apply_ufunc(np.log, values.where(values > 0))
    panel.plot(x, np.exp(logarithm.mean("parameter").values), label=label, **line(look))
    low, high = (end.values[finite] for end in (values.min("parameter"), values.max("parameter")))
    panel.vlines(x[finite], low, high, color=look.color, linewidth=1.0)


def plotter(read: Callable[[Path], Any], drawn: dict[str, Callable[[Any], Figure | None]]) -> Callable[..., None]:
    """The command that reads results and writes figures, by the names of their files, as SVG and PDF.

    A figure that is `None` is left out.
    """

    def main(results: Path, figures: Path) -> None:
        """Draws the results of the experiment."""
        found = read(results)
        figures.mkdir(parents=True, exist_ok=True)
        for name, draw in drawn.items():
            with drawing():
                if (figure := draw(found)) is not None:
                    for kind in ("svg", "pdf"):
                        write_file(figures / f"{name}.{kind}", rendered(figure, kind))

    return main
