"""The figures of an identification's page."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch
from matplotlib.ticker import MaxNLocator, MultipleLocator

from ..airframe import INERTIAS, MOTIONS, Airframe
from ..analysis.diagnostics import Correlations
from ..analysis.frequency_response import HIGHEST, AxisResponse, FrequencyResponse
from ..analysis.inertia import CenterOfMass
from ..analysis.traces import Traces
from ..flight import STATE_NAMES
from ..identification.results import Constant, Identification, SampleTime
from ..models.state import CASCADE_ORDER
from ..results import NINETY_FIVE
from .style import BOUND_DASHES, FAINT, INK, PAPER, Style, grid, label, style, ticks_at

_FAR = (2, 10, 100, 1000, 10000, 100000)  # ticks of brackets that were left far behind, in half-widths


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
    reach = 2.0
    for place, (bracket, value, interval) in enumerate(rows.values()):
        center, half = np.mean(bracket), (bracket[1] - bracket[0]) / 2
        low, at, high = (np.array([interval[0], value, interval[1]]) - center) / half
        reach = max(reach, abs(low), abs(high))
        panel.barh(place, 2, left=-1, height=0.7, color=FAINT, alpha=0.3, linewidth=0)
        panel.plot([low, high], [place, place], color=look.color, linewidth=2.2)
        panel.plot(at, place, look.marker, color=look.color, markersize=3.5)
    panel.set_yticks(range(len(rows)), [name.replace("_", " ") for name in rows])
    panel.set_ylim(len(rows) - 0.4, -0.6)
    if reach > 5:  # one parameter far away would shrink all others to dots
        panel.set_xscale("symlog", linthresh=2.0, linscale=2.0)
        ticks_at(panel.xaxis, [-x for x in _FAR if x < reach] + [-1, 0, 1] + [x for x in _FAR if x < reach])
    panel.set_xlim(-1.1 * reach, 1.1 * reach)
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
            values, look = found.with_torque[i, place], {"color": style(place).color, "linestyle": BOUND_DASHES[dash]}
            crossed.plot(range(-lags, lags + 1), values, label=f"{MOTIONS[place]} torque", linewidth=1.1, **look)
        if i == 0:  # in the panels, because a page shows each panel by itself
            own.legend([Patch(color=FAINT, alpha=0.3)], ["95 % by chance"], fontsize=7, loc="upper right")
            crossed.legend(fontsize=7, loc="upper right", ncols=3, handlelength=2.4)
        crossed.set_title(f"{name}: with the torques")
        for panel, values, bound in ((own, found.own[i], found.bound[i]), (crossed, found.with_torque[i], most)):
            # The first panels have room for their legends.
            reach = (1.6 if i == 0 else 1.15) * max(float(np.abs(values).max(initial=0.0)), bound, 0.05)
            reach = min(reach, 1.6 if i == 0 else 1.15)
            panel.set_ylim(-reach, reach)
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
    """The correlations of the parameters as an SVG: a square for each pair, hollow if negative; rows and columns named.

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
        x = room + cell * (row + 1) + 3  # beside the diagonal, where the column of this parameter begins
        marks.append(f'<text x="{x}" y="{y + 4}">{escape(name.replace("_", " "))}</text>')
    width, height = 2 * room + cell * len(names), cell * len(names)
    shape = f'viewBox="0 0 {width} {height}" style="max-width: {1.5 * width:.0f}px"'
    return Markup(f'<svg class="matrix" {shape}>{"".join(marks)}</svg>')  # noqa: S704  # names are escaped


def strongest(found: Identification, *, least: float = 0.9, most: int = 5) -> list[tuple[str, str, float]]:
    """The pairs of parameters that are correlated most."""
    matrix, names = correlations(found), list(found.parameters)
    rows, columns = np.tril_indices(len(names), -1)
    pairs = [(names[j], names[i], float(matrix[i, j])) for i, j in zip(rows, columns, strict=True)]
    return sorted((pair for pair in pairs if abs(pair[2]) > least), key=lambda pair: -abs(pair[2]))[:most]


GAINS = (0.5, 2.0)
"""The gains that a figure of the response shows at least: verdicts are about some percent."""
_WIDEST = (0.2, 5.0)  # and at most: what reaches further is unknown


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


def vehicle(airframe: Airframe, constants: dict[str, Constant], center: Sequence[CenterOfMass], look: Style) -> Figure:
    """The vehicle as it was identified: left from above, front up, right its moments of inertia with 95 % intervals."""
    figure, (above, bars) = grid(2, columns=2, height=3.4)
    positions = 1e3 * np.asarray(airframe.rotor_positions, dtype=float)
    (x, y), distances = positions.T, np.linalg.norm(positions[:, None] - positions, axis=2)
    radius = 0.42 * distances[distances > 0].min()
    for i, spin in enumerate(np.asarray(airframe.rotor_spins)):
        end = 1 - 0.25 * radius / max(math.hypot(x[i], y[i]), radius)  # leaves room for the number
        above.plot([0, -end * y[i]], [0, end * x[i]], color=FAINT, linewidth=3, zorder=1)
        above.add_patch(Circle((-y[i], x[i]), radius, facecolor=PAPER, edgecolor=INK, linewidth=1.1))
        turn = np.radians(np.linspace(200, 200 + 280 * spin, 60))
        arc = 0.72 * radius * np.stack([np.cos(turn), np.sin(turn)], axis=1) + [-y[i], x[i]]
        above.plot(*arc.T, color=look.color, linewidth=1.2)
        above.annotate("", arc[-1], arc[-6], arrowprops={"arrowstyle": "-|>", "color": look.color, "shrinkA": 0})
        above.text(-y[i], x[i], f"{i + 1}", ha="center", va="center", fontsize=10, fontweight="bold")
    place = {each.axis: (1e3 * each.value, 1e3 * NINETY_FIVE * each.std) for each in center}
    (cx, ex), (cy, ey) = (place.get(axis, (0.0, 0.0)) for axis in "xy")
    above.errorbar(-cy, cx, xerr=ey or None, yerr=ex or None, color=INK, marker="P", markersize=6, capsize=2, zorder=4)
    above.margins(0.08)
    above.set_aspect("equal", adjustable="datalim")
    above.set_title("from above [mm], front up")
    for row, (name, given) in enumerate(zip(INERTIAS, np.asarray(airframe.inertia, dtype=float), strict=True)):
        bars.plot([given, given], [row - 0.36, row + 0.36], color=INK, linewidth=1.4, linestyle=BOUND_DASHES[2])
        if name not in constants:
            bars.text(0, row, "  not identified", va="center")
            continue
        value, half = constants[name].estimate, NINETY_FIVE * constants[name].std
        bars.barh(row, value, height=0.5, color=look.color, alpha=0.35)
        bars.errorbar(value, row, xerr=half, color=look.color, capsize=4, marker=look.marker)
    bars.set_yticks(range(3), INERTIAS)
    bars.tick_params(axis="y", length=0, pad=8)
    bars.set_ylim(2.6, -0.6)
    bars.set_xlim(left=0)
    bars.grid(axis="y", visible=False)
    bars.set_title("moments of inertia [kg m²], 95 %")
    return figure


def frequency_responses(found: FrequencyResponse, look: Style) -> Figure:
    """Gain, phase and coherence of each axis with 95 % bands, faint where they are not clear; dashed: the model."""
    figure, panels = grid(9, columns=3, height=1.9)
    top = min(HIGHEST, max(float(axis.frequency[-1]) if axis.frequency.size else 1.0 for axis in found))
    for row, (name, axis) in enumerate(found._asdict().items()):
        gain, phase, coherence = panels[3 * row : 3 * row + 3]
        degrees, spread = np.degrees(axis.phase), np.degrees(np.minimum(axis.half_width, math.pi))
        draw_response(gain, axis, axis.gain, gain_band(axis), 1.0, look.color)
        draw_response(phase, axis, degrees, np.array([degrees - spread, degrees + spread]), 0.0, look.color)
        coherence.plot(axis.frequency, axis.coherence, color=look.color)
        mean, ends = axis.agreement(), GAINS
        if np.isfinite(mean.interval).all():
            low, high = mean.interval
            gain.fill_between([mean.low, mean.high], low, high, color=INK, alpha=0.18, linewidth=0)
            gain.plot([mean.low, mean.high], [mean.ratio] * 2, color=INK, linewidth=1.6)
            ends = min(ends[0], max(0.8 * low, _WIDEST[0])), max(ends[1], min(1.25 * high, _WIDEST[1]))
        gain.set_yscale("log")
        gain.set_ylim(ends)
        ticks_at(gain.yaxis, (0.1, 0.2, 0.5, 0.7, 1, 1.4, 2, 5, 10))
        phase.set_ylim(-180, 180)
        phase.yaxis.set_major_locator(MultipleLocator(90))
        coherence.set_ylim(0, 1.03)
        for panel, title in ((gain, "gain"), (phase, "phase [degrees]"), (coherence, "coherence")):
            panel.set_title(f"{name}: {title}")
            panel.set_xscale("log")
            panel.set_xlim(1.0, top)
            ticks_at(panel.xaxis, (1, 2, 5, 10, 20, 40))
    label(figure, x="frequency [Hz]")
    return figure


def inertias_by_sample_time(answers: Sequence[SampleTime], chosen: float, look: Style) -> Figure:
    """Ix, Iy, Iz at each sample time with 95 % intervals. Lines: the `chosen` one [s], and its moments of inertia."""
    figure, panels = grid(3, columns=3, height=2.4)
    ticks = [1e3 * each.sample_time for each in answers]
    for panel, name in zip(panels, INERTIAS, strict=True):
        rows = {each.sample_time: each.constants[name] for each in answers if name in each.constants}
        for sample_time, row in rows.items():
            if math.isclose(sample_time, chosen):
                panel.axhline(row.estimate, color=FAINT, linewidth=0.9, linestyle=BOUND_DASHES[2])
        times, values = [1e3 * sample_time for sample_time in rows], [row.estimate for row in rows.values()]
        errors = [NINETY_FIVE * row.std for row in rows.values()]
        panel.errorbar(times, values, yerr=errors, markersize=4, capsize=3, **look.line)
        panel.axvline(1e3 * chosen, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[1])
        panel.set_title(f"{name} [kg m²]" if rows else f"{name}: not identified")
        panel.set_xscale("log")
        panel.set_xlim(0.8 * ticks[0], 1.25 * ticks[-1])
        ticks_at(panel.xaxis, ticks)
    label(figure, x="sample time [ms]")
    return figure
