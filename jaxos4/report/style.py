"""The style of figures: colours for colour-blind readers, markers, dashes, axes, legends, and reproducible files."""

import contextlib
import io
import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullLocator

INK = "#1b1e23"
GRID = "#d9dce1"
PAPER = "#ffffff"
FAINT = "#8a9099"

# A dash pattern: its offset, then lengths of ink and gap, in line widths.
Dash = tuple[float, tuple[float, ...]]
_SOLID: Dash = (0, ())
_DASHED: Dash = (0, (4, 1.6))
_DOTTED: Dash = (0, (1, 1.65))


class Style(NamedTuple):
    """The style of one series."""

    color: str
    marker: str
    dash: Dash

    @property
    def line(self) -> dict[str, Any]:
        """The arguments of Matplotlib for a line with markers."""
        return {"color": self.color, "marker": self.marker, "linestyle": self.dash}


# Nine estimators and the ant colony, each with a colour, a mark and dashes of its own. The first colours are of Okabe
# and Ito (2008). For readers with normal vision, without red cones and without green cones, the colours are at least
# 17 apart in CIELAB; the contrast is at least 3:1 on white and on dark paper.
_STYLES = {
    "ibss": Style("#0072b2", "o", _SOLID),
    "network": Style("#d55e00", "s", _DASHED),
    "hybrid": Style("#009e73", "D", (0, (6.4, 1.6, 1, 1.6))),
    "output-error": Style("#fc486c", "^", _DOTTED),
    "filter-error": Style("#5448fc", "v", (0, (9, 2))),
    "equation-error": Style("#54783c", "P", (0, (3, 1, 1, 1, 1, 1))),
    "rls": Style("#549cc0", "X", (0, (2, 1))),
    "svsf": Style("#846084", "*", (0, (1, 2.2))),
    "kalman": Style("#d80030", "<", (0, (10, 2, 2, 2))),
    "ant-colony": Style("#4884fc", "p", (0, (5, 1, 2, 1))),
}
BOUND_DASHES = (_SOLID, _DOTTED, _DASHED)

_INKED = ("axes.edgecolor", "axes.labelcolor", "axes.titlecolor", "text.color", "xtick.color", "ytick.color")
_RC: dict[Any, Any] = {
    **dict.fromkeys(_INKED, INK),
    **dict.fromkeys(("axes.labelsize", "font.size", "legend.fontsize"), 8.5),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize"), 8),
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.linewidth": 0.7,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 9,
    "figure.facecolor": PAPER,
    "axes.facecolor": "none",
    "font.family": "DejaVu Sans",
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "lines.markersize": 5,
    "svg.fonttype": "path",
    "svg.hashsalt": "jaxos4",
    "text.parse_math": False,  # names come from files: a dollar sign in one is a dollar sign
}


@contextlib.contextmanager
def drawing() -> Iterator[None]:
    """Applies the style of this library inside the context."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_RC)
        yield


def styles(estimators: Sequence[str]) -> dict[str, Style]:
    """A style for each estimator: its own, or an unused one if the table does not have the estimator."""
    known = list(_STYLES)
    free = (place for place in itertools.count() if place >= len(known) or known[place] not in estimators)
    return {name: _STYLES[name] if name in _STYLES else style(next(free)) for name in estimators}


def style(place: int) -> Style:
    """Style number `place`. Beyond the table, a colour comes with the marker and dashes of another row."""
    table, count = list(_STYLES.values()), len(_STYLES)
    return table[(place + place // count) % count]._replace(color=table[place % count].color)


def estimator_gid(place: int, tip: str = "") -> str:
    """The id of a drawing's parts that belong to one estimator. The page hides them, and shows `tip` as a tooltip."""
    return f"estimator-{place}: {tip}" if tip else f"estimator-{place}"


def grid(panels: int, *, columns: int, width: float = 9.0, height: float = 2.1) -> tuple[Figure, list[Axes]]:
    """A figure with a grid of panels. `height`: the height of one row of panels [inch]."""
    columns = min(columns, panels)
    rows = -(-panels // columns)
    figure = Figure(figsize=(width, height * rows + 0.5), layout="constrained")
    return figure, [figure.add_subplot(rows, columns, i + 1) for i in range(panels)]


def label(figure: Figure, *, x: str, y: str = "") -> None:
    """Labels the x axis of every panel, so that a panel can stand alone, and y once beside all panels."""
    for panel in figure.axes:
        panel.set_xlabel(x)
    if y:
        figure.supylabel(y, fontsize=_RC["axes.labelsize"])


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
    ticks_at(axes.xaxis, scales)
    axes.set_xlim(scales.min() / 1.8, scales.max() * 1.8)


def ticks_at(axis: Axis, values: Sequence[float] | np.ndarray) -> None:
    """Ticks with plain numbers at these values, and no others."""
    axis.set_major_locator(FixedLocator(list(values)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def legend(figure: Figure, estimators: Sequence[str], *, bounds: Sequence[str] = ()) -> None:
    """Adds a legend below the figure: an entry for each bound and each estimator. A page has its bar instead."""
    handles = [
        Line2D([], [], color=INK, linestyle=d, linewidth=1.1) for d, _ in zip(BOUND_DASHES, bounds, strict=False)
    ]
    labels = [f"bound, {name}" for name in bounds[: len(handles)]]
    handles += [Line2D([], [], **look.line) for look in styles(estimators).values()]
    labels += estimators
    rows = -(-len(labels) // int(figure.get_figwidth() / 1.4))  # an entry is 1.4 inches wide
    columns = -(-len(labels) // rows)
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, handlelength=3)


def svg(figure: Figure) -> bytes:
    """The figure as SVG. The same figure gives the same bytes. A browser shrinks it to the width of its window."""
    buffer, resolution = io.BytesIO(), figure.dpi
    # `savefig` also restores the resolution, but draws twice.
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
    figure.set_dpi(resolution)
    figure.set_layout_engine("none")  # keeps the layout for the boxes of the panels
    return buffer.getvalue().replace(b"<svg ", b'<svg style="max-width: 100%; height: auto" ', 1)


def panel_boxes(figure: Figure) -> np.ndarray:
    """The box of each panel with its labels in an SVG just drawn: x, y, width, height [pt], with equal margins."""
    resolution, figure.dpi = figure.dpi, 72  # of SVG: a pixel is a point
    inner = np.array([panel.bbox.extents for panel in figure.axes])
    outer = np.array([(panel.get_tightbbox() or panel.bbox).extents for panel in figure.axes])
    figure.set_dpi(resolution)
    margin = np.abs(outer - inner).max(axis=0) * [-1, -1, 1, 1] + [-2, -2, 2, 2]
    left, bottom, right, top = (inner + margin).T
    return np.stack([left, 72 * figure.get_figheight() - top, right - left, top - bottom], axis=1)
