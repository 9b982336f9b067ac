"""Figures of what stands behind an estimate, for its page; and of the estimate, for notebooks: `found.plot`."""

import itertools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..analysis.diagnostics import Correlations
from ..analysis.frequency_response import HIGHEST, AxisResponse
from ..analysis.prediction import decisive_horizon
from ..analysis.traces import Traces
from ..errors import InputError
from ..flight import STATE_NAMES
from ..identification.physical import physical_quantities
from ..identification.results import Identification
from ..models.state import CASCADE_ORDER
from .style import BOUND_DASHES, FAINT, INK, Style, grid, label, log_axis, style, styles


def priors(found: Identification, look: Style) -> Figure | None:
    """Each parameter within its bracket: grey the bracket, coloured the 95 % interval of the estimate."""
    rows = {
        name: (row.bracket, row.estimate, row.ci95 if row.ci95 else (row.estimate, row.estimate))
        for name, row in found.parameters.items()
        if row.bracket and row.estimate is not None and row.bracket[0] < row.bracket[1]
    }
    if not rows:
        return None
    figure, (panel,) = grid(1, columns=1, width=3.3, height=0.5 + 0.19 * len(rows))
    for place, (bracket, value, interval) in enumerate(rows.values()):
        center, half = np.mean(bracket), (bracket[1] - bracket[0]) / 2
        low, high = np.clip((np.array(interval) - center) / half, -2, 2)
        panel.barh(place, 2, left=-1, height=0.7, color=FAINT, alpha=0.3, linewidth=0)
        panel.plot([low, high], [place, place], color=look.color, linewidth=2.2)
        panel.plot(np.clip((value - center) / half, -2, 2), place, look.marker, color=look.color, markersize=3.5)
    panel.set_yticks(range(len(rows)), [name.replace("_", " ") for name in rows])
    panel.set_ylim(len(rows) - 0.4, -0.6)
    panel.set_xlim(-2, 2)
    panel.grid(axis="y", visible=False)
    label(figure, x="from the centre of the bracket, in half-widths")
    return figure


def residual_figure(found: Correlations) -> Figure:
    """The correlations of the residuals of each channel with themselves and with the torques; bands: 95 % by chance."""
    names = [STATE_NAMES[column] for column in CASCADE_ORDER[: len(found.own)]]
    figure, panels = grid(2 * len(names), columns=2, height=1.55)
    lags = found.with_torque.shape[2] // 2
    for i, name in enumerate(names):
        own, crossed = panels[2 * i : 2 * i + 2]
        count = found.own.shape[1]
        own.axhspan(-found.bound[i], found.bound[i], color=FAINT, alpha=0.3, linewidth=0)
        stems = np.stack(
            [np.zeros(count), found.own[i], np.full(count, np.nan)], axis=1
        )  # one line: a third of the bytes
        own.plot(np.repeat(np.arange(1, count + 1), 3), stems.ravel(), color=style(0).color, linewidth=1.6)
        own.set_title(f"{name}: with itself")
        most = float(np.max(found.torque_bound[i]))
        crossed.axhspan(-most, most, color=FAINT, alpha=0.3, linewidth=0)
        for place, dash in enumerate((0, 2, 1)):
            values = found.with_torque[i, place]
            crossed.plot(
                range(-lags, lags + 1), values, color=style(place).color, linestyle=BOUND_DASHES[dash], linewidth=1.1
            )
        crossed.set_title(f"{name}: with the torques")
        for panel, values, bound in ((own, found.own[i], found.bound[i]), (crossed, found.with_torque[i], most)):
            reach = 1.15 * max(float(np.abs(values).max(initial=0.0)), bound, 0.05)
            panel.set_ylim(-min(reach, 1.15), min(reach, 1.15))
            panel.axhline(0, color=INK, linewidth=0.7)
            panel.grid(visible=False)
            panel.yaxis.set_major_locator(MaxNLocator(2, steps=[1, 2, 5, 10]))
            panel.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    label(figure, x="lag [samples]")
    return figure


def path_in_space(traces: Traces, look: Style, *, turn: float = -60.0, height: float = 28.0) -> Figure:
    """The measured path in its box, with its shadow; an OS4's prediction. `turn`, `height`: of the view [degrees]."""
    turned, up = np.radians([turn, height])
    right = np.array([-np.sin(turned), np.cos(turned), 0.0])
    above = np.array([-np.cos(turned) * np.sin(up), -np.sin(turned) * np.sin(up), np.cos(up)])
    paths = [traces.position]
    if traces.predicted.shape[1] == len(CASCADE_ORDER):
        paths.append(traces.predicted[:, [6, 8, 10]])
    every = np.concatenate(paths)
    low, high = np.nanmin(every, axis=0), np.nanmax(every, axis=0)
    room = np.maximum(0.05 * np.max(high - low) - (high - low) / 2, 0.0) + 1e-3
    low, high = low - room, high + room
    corners = np.where(list(np.ndindex(2, 2, 2)), high, low)
    figure, (panel,) = grid(1, columns=1, width=4.4, height=3.6)

    def draw(points: Float[np.ndarray, "_points 3"], **how: Any) -> None:
        panel.plot(points @ right, points @ above, **how)

    for i, j in itertools.combinations(range(8), 2):
        if np.count_nonzero(corners[i] != corners[j]) == 1:
            draw(corners[[i, j]], color=FAINT, linewidth=0.6)
    draw(np.column_stack([paths[0][:, :2], np.full(len(paths[0]), low[2])]), color=FAINT, linewidth=0.8)
    draw(paths[0], color=INK, linewidth=1.0, linestyle=BOUND_DASHES[1])
    for path in paths[1:]:
        draw(path, color=look.color, linewidth=1.4)
    draw(paths[0][:1], color=INK, marker="o", markersize=4)
    for axis, ends in enumerate(([0, 4], [4, 6], [0, 1])):  # the edges in front, and the left one
        middle = corners[ends].mean(axis=0)
        text, align = f"{'xyz'[axis]} {low[axis]:.3g} to {high[axis]:.3g} m", ("right", "left", "right")[axis]
        panel.text(
            middle @ right, middle @ above, f" {text} ", ha=align, va="center" if axis == 2 else "top", fontsize=8
        )
    panel.set_aspect("equal")
    panel.set_axis_off()
    return figure


def correlations(found: Identification) -> Float[np.ndarray, "parameters parameters"]:
    """The correlations of the estimates."""
    covariance = np.array(found.covariance, dtype=float).reshape(2 * [len(found.parameters)])
    std = np.sqrt(np.maximum(np.diagonal(covariance), 1e-300))
    matrix = np.clip(covariance / std / std[:, None], -1, 1)
    np.fill_diagonal(matrix, 1.0)
    return matrix


def correlation_matrix(found: Identification, *, least: float = 0.05, most: int = 400) -> Markup:
    """The correlations of the parameters as an SVG: a square for each pair, hollow if negative.

    Those below `least` are left out; if there are more than `most`, the smallest too.
    """
    names, cell, matrix = list(found.parameters), 18, correlations(found)
    room = 10 + 7 * max(map(len, names))
    sizes = np.sort(np.abs(matrix[np.tril_indices(len(names))]))[::-1]
    least = max(least, float(sizes[most])) if sizes.size > most else least
    marks = []
    for row, name in enumerate(names):
        y = cell * row + cell // 2
        marks.append(f'<text x="{room - 6}" y="{y + 4}" text-anchor="end">{escape(name.replace("_", " "))}</text>')
        for column in np.flatnonzero(np.abs(matrix[row, : row + 1]) >= least).tolist():
            value = float(matrix[row, column])
            half, x = 0.44 * cell * abs(value) ** 0.5, room + cell * column + cell // 2
            tip = escape(f"{name}, {names[column]}: {value:.2f}")
            box = f'x="{x - half:.1f}" y="{y - half:.1f}" width="{2 * half:.1f}" height="{2 * half:.1f}"'
            marks.append(f'<rect class="{"plus" if value > 0 else "minus"}" {box}><title>{tip}</title></rect>')
    width, height = room + cell * len(names), cell * len(names)
    shape = f'viewBox="0 0 {width} {height}" style="max-width: {1.5 * width:.0f}px"'
    return Markup(f'<svg class="matrix" {shape}>{"".join(marks)}</svg>')  # noqa: S704  # names are escaped


def strongest(found: Identification, *, least: float = 0.9, most: int = 5) -> list[tuple[str, str, float]]:
    """The pairs of parameters that are correlated most."""
    matrix, names = correlations(found), list(found.parameters)
    rows, columns = np.tril_indices(len(names), -1)
    pairs = [(names[j], names[i], float(matrix[i, j])) for i, j in zip(rows, columns, strict=True)]
    return sorted((pair for pair in pairs if abs(pair[2]) > least), key=lambda pair: -abs(pair[2]))[:most]


GAINS = (0.2, 5.0)
"""The gains that a figure of the response shows."""

INERTIAS: tuple[str, ...] = ("Ix", "Iy", "Iz")
_RATES = ("p", "q", "r")


def gaps(start: Int[np.ndarray, " starts"]) -> tuple[Int[np.ndarray, " gaps"], float]:
    """The places before which a line breaks, because another stretch begins; and the usual step between starts."""
    usual = float(np.median(np.diff(start))) if start.size > 1 else 1.0
    return np.flatnonzero(np.diff(start) > 1.5 * usual) + 1, usual


def gain_band(one: AxisResponse) -> Float[np.ndarray, "2 frequencies"]:
    """The ends of the 95 % interval of the gain, finite."""
    factor = np.exp(np.minimum(one.half_width, 50.0))  # beyond every figure
    return np.array([one.gain / factor, one.gain * factor])


def draw_response(
    panel: Axes,
    one: AxisResponse,
    values: Float[np.ndarray, " frequencies"],
    band: Float[np.ndarray, "2 frequencies"],
    model: float,
    color: str,
) -> None:
    """Draws gain or phase with its band; faintly at frequencies without a clear response; dashed: the model."""
    panel.plot(one.frequency, values, color=FAINT, linewidth=0.8)
    low, high = np.where(one.clear, band, np.nan)
    panel.fill_between(one.frequency, low, high, color=color, alpha=0.25, linewidth=0)
    panel.plot(one.frequency, np.where(one.clear, values, np.nan), color=color)
    panel.axhline(model, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[2])


class Plots(NamedTuple):
    """Figures of an identification. Each method draws on `ax`, or a new one, and returns it, or raises `InputError`."""

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
        time, measured, predicted = np.insert(columns, gaps(ahead.start)[0], np.nan, axis=1)
        ax = _axes(ax)
        ax.plot(time, measured, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[1], label="measured")
        label = f"predicted {ahead.horizons[nearest]:.3g} s ahead"
        ax.plot(time, predicted, color=self._color, linewidth=1.2, label=label)
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
        one, ax = response[_place("axis", axis, response._fields)], _axes(ax)
        draw_response(ax, one, one.gain, gain_band(one), 1.0, self._color)
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
