"""Matplotlib's figures in the style of this library: grids of panels, logarithmic axes, and reproducible files."""

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullLocator


def grid(panels: int, *, columns: int, width: float = 9.0, height: float = 2.1) -> tuple[Figure, list[Axes]]:
    """A figure with a grid of panels. `height`: the height of one row of panels [inch]."""
    columns = min(columns, panels)
    rows = -(-panels // columns)
    figure = Figure(figsize=(width, height * rows + 0.5), layout="constrained")
    return figure, [figure.add_subplot(rows, columns, i + 1) for i in range(panels)]


def log_axis(axes: Axes, which: str) -> None:
    """A logarithmic axis with plain numbers."""
    getattr(axes, f"set_{which}scale")("log")
    axis: Axis = getattr(axes, f"{which}axis")
    low, high = sorted(getattr(axes, f"get_{which}lim")())
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


def rendered(figure: Figure, kind: str) -> bytes:
    """The figure as a file: `"svg"` or `"pdf"`. The same figure gives the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, metadata={"Date" if kind == "svg" else "CreationDate": None})
    return buffer.getvalue()
