"""Figures of an identification for notebooks: `found.plot`."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from ..airframe import INERTIAS, MOTIONS
from ..analysis.frequency_response import HIGHEST
from ..analysis.prediction import decisive_horizon
from ..errors import InputError
from ..identification.results import Identification, VehicleIdentification
from ..identification.tables import physical_quantities
from .identification_figures import gain
from .matplotlib_figures import draw
from .panels import Scale
from .style import BOUND_DASHES, FAINT, INK, Style, styles

_RATES = ("p", "q", "r")


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
        column = _place("rate", rate, _RATES)
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
    if value not in names:
        raise InputError(f"`{argument}`: must be one of {', '.join(names)}, got {value!r}.")
    return names.index(value)


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    from matplotlib import pyplot  # chooses how figures are shown

    return pyplot.subplots()[1]
