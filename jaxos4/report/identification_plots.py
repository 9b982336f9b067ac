"""Figures of an identification on one axis each, for notebooks and papers: `found.plot`."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from ..analysis.prediction import decisive_horizon
from ..errors import InputError
from ..identification.physical import physical_quantities
from ..identification.results import Identification
from .identification_page import GAINS, HIGHEST
from .style import BOUND_DASHES, FAINT, INK, log_axis, styles

_RATES, _INERTIAS = ("p", "q", "r"), ["Ix", "Iy", "Iz"]


class Plots(NamedTuple):
    """Figures of an identification. Each method draws on `ax`, by default on a new one, and returns it.

    **Raises:** `InputError` if the result does not hold what a figure shows.
    """

    found: Identification

    def rates(self, rate: str = "p", *, horizon: float | None = None, ax: Axes | None = None) -> Axes:
        """A measured body rate, and what was predicted at the nearest `horizon` [s] before, by default 0.25 s.

        Data that were not fitted. `rate`: `"p"`, `"q"` or `"r"`.
        """
        if (ahead := self.found.predictions) is None:
            raise InputError(
                "the result has no predictions of data that were not fitted; give `holdout` or `validate`."
            )
        column = _place("rate", rate, _RATES)
        known = np.isfinite(ahead.measured).any(axis=(0, 2))
        far = None if horizon is None else np.abs(ahead.horizons - horizon)
        nearest = decisive_horizon(ahead.horizons, known) if far is None else int(far.argmin())
        time = ahead.start * self.found.provenance.sample_time + ahead.horizons[nearest]
        columns = np.stack([time, ahead.measured[:, nearest, column], ahead.predicted[:, nearest, column]])
        steps = np.diff(ahead.start)
        gaps = np.flatnonzero(steps > 1.5 * np.median(steps)) + 1 if steps.size else []
        time, measured, predicted = np.insert(columns, gaps, np.nan, axis=1)  # lines break between stretches
        ax = _axes(ax)
        ax.plot(time, measured, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[1], label="measured")
        label = f"predicted {ahead.horizons[nearest]:.3g} s ahead"
        ax.plot(time, predicted, color=self._color, linewidth=1.2, label=label)
        ax.set(xlabel="time [s]", ylabel=f"{rate} [rad/s]")
        ax.legend()
        return ax

    def inertias(self, *, ax: Axes | None = None) -> Axes:
        """The moments of inertia with 95 % intervals, and those of the airframe's file (crosses)."""
        rows = [row for row in physical_quantities(self.found) if row.name in _INERTIAS]
        if not rows:
            raise InputError("the result has no moments of inertia.")
        ax, given = _axes(ax), dict(zip(_INERTIAS, np.asarray(self.found.airframe.inertia), strict=True))
        for place, row in enumerate(rows):
            ax.plot([place, place], row.ci95, color=self._color if row.trusted else FAINT)
            ax.plot(place, row.value, "o", color=self._color if row.trusted else FAINT)
            ax.plot(place, given[row.name], "x", color=INK)
        ax.set_xticks(range(len(rows)), [row.name for row in rows])
        ax.set(ylabel="kg m²", xlim=(-0.5, len(rows) - 0.5))
        return ax

    def response(self, axis: str = "roll", *, ax: Axes | None = None) -> Axes:
        """The gain of the measured over the modelled angular acceleration, with its 95 % band where it is clear.

        `axis`: `"roll"`, `"pitch"` or `"yaw"`. Dashed: the model.
        """
        if (response := self.found.response) is None:
            raise InputError("the result has no frequency response: it is of an OS4, has no answer, or is older.")
        one = response[_place("axis", axis, response._fields)]
        gain, factor = np.where(one.clear, one.gain, np.nan), np.exp(np.where(one.clear, one.half_width, np.nan))
        ax = _axes(ax)
        ax.plot(one.frequency, one.gain, color=FAINT, linewidth=0.8)
        ax.plot(one.frequency, gain, color=self._color)
        ax.fill_between(one.frequency, gain / factor, gain * factor, color=self._color, alpha=0.25, linewidth=0)
        ax.axhline(1.0, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[2])
        ax.set(xlabel="frequency [Hz]", ylabel=f"gain, {axis}", xlim=(1.0, HIGHEST), ylim=GAINS)
        for which in ("x", "y"):
            log_axis(ax, which)
        return ax

    @property
    def _color(self) -> str:
        return styles([self.found.estimator])[self.found.estimator].color


def _place(argument: str, value: str, names: tuple[str, ...]) -> int:
    if value not in names:
        raise InputError(f"`{argument}`: must be one of {', '.join(names)}, got {value!r}.")
    return names.index(value)


def _axes(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    from matplotlib import pyplot  # chooses how figures are shown

    return pyplot.subplots()[1]
