"""Figures on Matplotlib's axes: for notebooks, and as PDF."""

import contextlib
import io
from collections.abc import Iterator
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawn
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from .panels import Band, Figure, Line, Panel, Words
from .style import GRID, INK

_POINT = 0.75  # of a pixel
_RC: dict[Any, Any] = {
    **dict.fromkeys(("axes.edgecolor", "axes.labelcolor", "text.color", "xtick.color", "ytick.color"), INK),
    **dict.fromkeys(("axes.spines.right", "axes.spines.top", "legend.frameon"), False),
    **dict.fromkeys(("axes.grid", "axes.axisbelow"), True),
    **{"axes.titlelocation": "left", "axes.titlesize": 9, "axes.linewidth": 0.7, "axes.facecolor": "none"},
    **{"font.size": 8.5, "grid.color": GRID, "grid.linewidth": 0.6, "lines.linewidth": 1.4, "lines.markersize": 5},
    **{"pdf.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": "jaxos4"},  # in a PDF, letters stay letters
    "text.parse_math": False,  # names come from files: a dollar sign in one is a dollar sign
}


@contextlib.contextmanager
def drawing() -> Iterator[None]:
    """Applies the style of this library inside the context."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_RC)
        yield


def draw(panel: Panel, axes: Axes) -> None:
    """Draws a panel."""
    panel = panel.fitted()
    for scale, axis, which in ((panel.x, axes.xaxis, "x"), (panel.y, axes.yaxis, "y")):
        ends = scale.ends or (0.0, 1.0)
        getattr(axes, f"set_{which}scale")(scale.kind)
        axes.set(**{f"{which}lim": ends, f"{which}label": scale.label})
        ticks, power = scale.labelled()
        labels = [f"{text}e{power}" if power and at else text for at, text in ticks.items()]
        axis.set_ticks(list(ticks), labels=labels)
        axis.set_ticks([], minor=True)
        axis.grid(scale.lines)
    for mark in panel.marks:
        if isinstance(mark, Words):
            axes.text(mark.x, mark.y, mark.text, ha={"start": "left", "middle": "center", "end": "right"}[mark.anchor])
            continue
        x = panel.x.inside(mark.x)
        if isinstance(mark, Band):
            low, high = panel.y.inside(mark.low), panel.y.inside(mark.high)
            axes.fill_between(x, low, high, color=mark.color, alpha=mark.opacity, linewidth=0)
        else:
            axes.plot(x, panel.y.inside(mark.y), **_look(mark))
    if panel.equal:
        axes.set_aspect("equal")
    if panel.bare:
        axes.set_axis_off()
    axes.set_title(f"{panel.title}\n{panel.subtitle}" if panel.subtitle else panel.title)


def as_matplotlib(figure: Figure) -> Drawn:
    """The figure with its legend as Matplotlib draws it. For use in `drawing`."""
    columns = min(figure.columns, len(figure.panels))
    rows, (width, height) = -(-len(figure.panels) // columns), (figure.panels[0].width, figure.panels[0].height)
    drawn = Drawn(figsize=(columns * width / 108, rows * height / 108 + 0.4), layout="constrained")
    for place, panel in enumerate(figure.panels):
        draw(panel, drawn.add_subplot(rows, columns, place + 1))
    if named := figure.legend():
        handles = [
            Patch(color=mark.color, alpha=mark.opacity) if isinstance(mark, Band) else Line2D([], [], **_look(mark))
            for mark in named.values()
        ]
        drawn.legend(handles, list(named), loc="outside lower center", ncols=2 * columns, handlelength=3)
    return drawn


def as_pdf(figure: Figure) -> bytes:
    """The figure as PDF."""
    with drawing():
        return rendered(as_matplotlib(figure), "pdf")


def rendered(drawn: Drawn, kind: str) -> bytes:
    """A figure of Matplotlib as a file: `"svg"` or `"pdf"`. The same figure gives the same bytes."""
    buffer = io.BytesIO()
    drawn.savefig(buffer, format=kind, metadata={"Date" if kind == "svg" else "CreationDate": None})
    return buffer.getvalue()


def _look(mark: Line) -> dict[str, Any]:
    look = {"color": mark.color, "linewidth": _POINT * mark.width, "linestyle": mark.dash if mark.width else "none"}
    look |= {"marker": mark.marker or "none", "markersize": _POINT * mark.size}
    return look | ({"markerfacecolor": "none"} if mark.hollow else {})
