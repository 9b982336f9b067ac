"""Figures on Matplotlib's axes: for notebooks, and as PDF."""

import contextlib
import io
from collections.abc import Iterator
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawn
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..airframe import INERTIAS, MOTIONS
from ..analysis.frequency_response import HIGHEST
from ..analysis.prediction import decisive_horizon
from ..errors import InputError, check_choice
from ..flight import RATE_NAMES
from ..identification.results import Identification, VehicleIdentification
from ..identification.tables import physical_quantities
from .identification_figures import gain
from .panels import BOUND_DASHES, FAINT, GRID, INK, Band, Figure, Line, Panel, Scale, Style, Words, styles

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


def as_pdf(figure: Figure) -> bytes:
    """The figure with its legend as PDF."""
    columns = min(figure.columns, len(figure.panels))
    rows, (width, height) = -(-len(figure.panels) // columns), (figure.panels[0].width, figure.panels[0].height)
    with drawing():
        drawn = Drawn(figsize=(columns * width / 108, rows * height / 108 + 0.4), layout="constrained")
        for place, panel in enumerate(figure.panels):
            draw(panel, drawn.add_subplot(rows, columns, place + 1))
        if named := figure.legend():
            handles = [
                Patch(color=mark.color, alpha=mark.opacity) if isinstance(mark, Band) else Line2D([], [], **_look(mark))
                for mark in named.values()
            ]
            drawn.legend(handles, list(named), loc="outside lower center", ncols=2 * columns, handlelength=3)
        return rendered(drawn, "pdf")


def rendered(drawn: Drawn, kind: str) -> bytes:
    """A figure of Matplotlib as a file: `"svg"` or `"pdf"`. The same figure gives the same bytes."""
    buffer = io.BytesIO()
    drawn.savefig(buffer, format=kind, metadata={"Date" if kind == "svg" else "CreationDate": None})
    return buffer.getvalue()


def _look(mark: Line) -> dict[str, Any]:
    look = {"color": mark.color, "linewidth": _POINT * mark.width, "linestyle": mark.dash if mark.width else "none"}
    look |= {"marker": mark.marker or "none", "markersize": _POINT * mark.size}
    return look | ({"markerfacecolor": "none"} if mark.hollow else {})


class Plots(NamedTuple):
    """Figures of an identification. Each method draws on `ax`, or a new one, and returns it, or raises `InputError`."""

    found: Identification

    def rates(self, rate: str = "p", *, horizon: float | None = None, ax: Axes | None = None) -> Axes:
        """A measured body rate, and what was predicted at the nearest `horizon` [s] before, by default 0.25 s.

        Data that were not fitted. `rate`: `"p"`, `"q"` or `"r"`.
        """
        ahead = self.found.predictions if isinstance(self.found, VehicleIdentification) else None
        if ahead is None:
            raise InputError(
                "the result has no predictions of data that were not fitted; give `holdout` or `validate`."
            )
        column = _place("rate", rate, RATE_NAMES)
        known = np.isfinite(ahead.measured).any(axis=(0, 2))
        far = None if horizon is None else np.abs(ahead.horizons - horizon)
        nearest = decisive_horizon(ahead.horizons, known) if far is None else int(far.argmin())
        time = ahead.start * self.found.provenance.sample_time + ahead.horizons[nearest]
        columns = np.stack([time, ahead.measured[:, nearest, column], ahead.predicted[:, nearest, column]])
        time, measured, predicted = np.insert(columns, ahead.breaks, np.nan, axis=1)
        ax = _axes(ax)
        ax.plot(time, measured, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[1], label="measured")
        label = f"predicted {ahead.horizons[nearest]:.3g} s ahead"
        ax.plot(time, predicted, color=self._look.color, linewidth=1.2, label=label)
        ax.set(xlabel="time [s]", ylabel=f"{rate} [rad/s]")
        ax.legend()
        return ax

    def inertias(self, *, ax: Axes | None = None) -> Axes:
        """The moments of inertia with 95 % intervals, and those of the airframe's file (crosses)."""
        rows = [row for row in physical_quantities(self.found) if row.name in INERTIAS]
        if not rows:
            raise InputError("the result has no moments of inertia.")
        ax, given = _axes(ax), dict(zip(INERTIAS, np.asarray(self.found.airframe.inertia), strict=True))
        for place, row in enumerate(rows):
            ax.plot([place, place], row.ci95, color=self._look.color if row.trusted else FAINT)
            ax.plot(place, row.value, "o", color=self._look.color if row.trusted else FAINT)
            ax.plot(place, given[row.name], "x", color=INK)
        ax.set_xticks(range(len(rows)), [row.name for row in rows])
        ax.set(ylabel="kg m²", xlim=(-0.5, len(rows) - 0.5))
        return ax

    def response(self, axis: str = "roll", *, ax: Axes | None = None) -> Axes:
        """The gain of the measured over the modelled angular acceleration, with its 95 % band where it is clear.

        `axis`: `"roll"`, `"pitch"` or `"yaw"`. Dashed: the model.
        """
        response = self.found.response if isinstance(self.found, VehicleIdentification) else None
        if response is None:
            raise InputError("the result has no frequency response: it is of an OS4, has no answer, or is older.")
        panel = gain(axis, [*response][_place("axis", axis, MOTIONS)], self._look)
        x = Scale("log", (1.0, HIGHEST), {at: f"{at}" for at in (1, 2, 5, 10, 20, 40)}, "frequency [Hz]")
        ax = _axes(ax)
        draw(panel._replace(x=x), ax)
        return ax

    @property
    def _look(self) -> Style:
        return styles([self.found.estimator])[self.found.estimator]


def _place(argument: str, value: str, names: tuple[str, ...]) -> int:
    check_choice(argument, value, names)
    return names.index(value)


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    from matplotlib import pyplot  # chooses how figures are shown

    return pyplot.subplots()[1]
