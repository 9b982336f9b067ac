"""The figures of an identification's page."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..airframe import INERTIAS, MOTIONS, Airframe
from ..analysis.diagnostics import Correlations
from ..analysis.frequency_response import HIGHEST, AxisResponse, FrequencyResponse
from ..analysis.inertia import CenterOfMass
from ..analysis.traces import Traces
from ..flight import STATE_NAMES
from ..identification.results import Constant, Identification, SampleTime
from ..models.state import CASCADE_ORDER
from ..results import NINETY_FIVE
from .panels import (
    BOUND_DASHES,
    EVERYWHERE,
    FAINT,
    GRID,
    INK,
    Band,
    Figure,
    Line,
    Mark,
    Panel,
    Scale,
    Style,
    Words,
    across,
    spread,
    style,
)

_FAR = (2, 10, 100, 1000, 10000, 100000)  # ticks of brackets that were left far behind, in half-widths
_ALL = "95 % interval"


def priors(found: Identification, look: Style) -> Figure | None:
    """Each parameter within its bracket: grey the bracket, coloured the 95 % interval of the estimate."""
    rows = {
        name.replace("_", " "): (row.bracket, row.estimate, row.ci95 if row.ci95 else (row.estimate, row.estimate))
        for name, row in found.parameters.items()
        if row.bracket and row.estimate is not None and row.bracket[0] < row.bracket[1]
    }
    if not rows:
        return None
    low, high = np.array([bracket for bracket, _, _ in rows.values()]).T
    ends = np.array([(interval[0], value, interval[1]) for _, value, interval in rows.values()])
    ends = ((ends.T - (low + high) / 2) / ((high - low) / 2)).T
    reach, places = 1.1 * max(2.0, float(np.abs(ends).max())), np.arange(len(rows))
    is_far = reach > 5.5  # one parameter far away would shrink all others to dots
    ticks = [-x for x in _FAR[::-1]] + [-1, 0, 1, *_FAR] if is_far else range(-5, 6)
    marks = [Band((-1, 1), 2 * [k - 0.35], 2 * [k + 0.35], name="bracket") for k in places.tolist()]
    lines = across(places, ends[:, 0], ends[:, 2], color=look.color, width=3.0)
    points = Line(ends[:, 1], places, look.color, width=0, marker=look.marker, size=6)
    names = Line([], [], look.color, 3.0, marker=look.marker, name=_ALL)
    label = "from the bracket's centre, in half-widths"
    x = Scale("symlog" if is_far else "linear", (-reach, reach), {at: f"{at:g}" for at in ticks}, label)
    y = Scale(ends=(len(rows) - 0.4, -0.6), ticks=dict(enumerate(rows)), lines=False)
    return Figure("priors", [Panel("", [*marks, lines, points, names], x, y, 340, 60 + 20 * len(rows))])


def residual_figure(found: Correlations) -> Figure:
    """The correlations of the residuals of each channel with themselves and with the torques; bands: 95 % by chance."""
    panels, lags, count = [], found.with_torque.shape[2] // 2, found.own.shape[1]
    x = Scale(label="lag [samples]")
    for i, name in enumerate(STATE_NAMES[column] for column in CASCADE_ORDER[: len(found.own)]):
        own = [spread(np.arange(1, count + 1), np.zeros(count), found.own[i], color=style(0).color)]
        torques = [
            Line(np.arange(-lags, lags + 1), values, style(k).color, 1.4, BOUND_DASHES[dash], name=f"{motion} torque")
            for k, (values, motion, dash) in enumerate(zip(found.with_torque[i], MOTIONS, (0, 2, 1), strict=True))
        ]
        for title, bound, marks, values in (
            ("with itself", float(found.bound[i]), own, found.own[i]),
            ("with the torques", float(np.max(found.torque_bound[i])), torques, found.with_torque[i]),
        ):
            reach = 1.15 * min(max(float(np.abs(values).max(initial=0.0)), bound, 0.05), 1.0)
            chance = Band(EVERYWHERE, 2 * [-bound], 2 * [bound], name="95 % by chance")
            axis = Line(EVERYWHERE, (0, 0), width=0.9)
            y = Scale(ends=(-reach, reach))
            panels.append(Panel(f"{name}: {title}", [chance, axis, *marks], x, y, 430, 150))
    return Figure("residuals", panels, columns=2)


def path(traces: Traces, look: Style) -> Figure:
    """The measured path from above and from two sides, and an OS4's prediction."""
    paths, panels = [traces.position], []
    if traces.predicted.shape[1] == len(CASCADE_ORDER):
        paths.append(traces.predicted[:, [6, 8, 10]])
    for title, i, j in (("from above", 0, 1), ("from the side", 0, 2), ("from the front", 1, 2)):
        marks = [Line(*paths[0].T[[i, j]], width=1.2, dash=BOUND_DASHES[1], name="measured, from the dot on")]
        marks += [Line(*each.T[[i, j]], color=look.color, name="predicted") for each in paths[1:]]
        marks += [Line(*paths[0][:1].T[[i, j]], width=0, marker="o", size=6)]
        x, y = Scale(label=f"{'xyz'[i]} [m]"), Scale()
        panels.append(Panel(f"{title}: {'xyz'[j]} [m]", marks, x, y, height=300, equal=True))
    return Figure("path", panels)


def correlations(found: Identification) -> Float[np.ndarray, "parameters parameters"]:
    """The correlations of the estimates."""
    covariance = np.array(found.covariance, dtype=float).reshape(2 * [len(found.parameters)])
    std = np.sqrt(np.maximum(np.diagonal(covariance), 1e-300))
    matrix = np.clip(covariance / std / std[:, None], -1, 1)
    np.fill_diagonal(matrix, 1.0)
    return matrix


def correlation_matrix(found: Identification, look: Style) -> Figure:
    """The correlations of the parameters: a square for each pair, hollow if negative.

    A name stands at the right end of its row, where its column begins. Correlations below 0.05 are left out.
    """
    names, matrix = [name.replace("_", " ") for name in found.parameters], correlations(found)
    count, cell = len(names), 16
    marks: list[Mark] = [Words(k + 0.4, k, name) for k, name in enumerate(names)]
    for k in range(count):
        marks += [Line((-0.6, k), (k, k), GRID, 1.0), Line((k, k), (k, count - 0.4), GRID, 1.0)]
    for row, column in zip(*(each.tolist() for each in np.nonzero(np.tril(np.abs(matrix) >= 0.05))), strict=True):
        value = float(matrix[row, column])
        color, name = (look.color, "positive") if value > 0 else (INK, "negative")
        size, tip = 0.75 * cell * abs(value) ** 0.5, f"{names[row]}, {names[column]}: {value:.2f}"
        marks.append(Line([column], [row], color, 0, (0, ()), "s", size, value < 0, name, tip=tip))
    room = 8 * max(map(len, names))
    x, y = Scale(ends=(-0.6, count - 0.4 + room / cell)), Scale(ends=(count - 0.4, -0.6))
    size = (24 + room + cell * count, 24 + cell * count)
    return Figure("matrix", [Panel("", marks, x, y, *size, bare=True)])


def strongest(found: Identification) -> list[tuple[str, str, float]]:
    """The five pairs of parameters that are correlated most, and by more than 0.9."""
    matrix, names = correlations(found), list(found.parameters)
    rows, columns = np.tril_indices(len(names), -1)
    pairs = [(names[j], names[i], float(matrix[i, j])) for i, j in zip(rows, columns, strict=True)]
    return sorted((pair for pair in pairs if abs(pair[2]) > 0.9), key=lambda pair: -abs(pair[2]))[:5]


def vehicle(airframe: Airframe, constants: dict[str, Constant], center: Sequence[CenterOfMass], look: Style) -> Figure:
    """The vehicle as it was identified: left from above, front up, right its moments of inertia with 95 % intervals."""
    positions = 1e3 * np.asarray(airframe.rotor_positions, dtype=float)
    distances = np.linalg.norm(positions[:, None] - positions, axis=2)
    radius, turn = 0.42 * distances[distances > 0].min(), np.linspace(0, 2 * np.pi, 41)
    circle = radius * np.stack([np.cos(turn), np.sin(turn)])
    marks: list[Mark] = []
    for i, ((x, y), spin) in enumerate(zip(positions, np.asarray(airframe.rotor_spins), strict=True)):
        end = 1 - radius / max(math.hypot(x, y), radius)  # of the arm, at the rotor's disk
        at, turned = np.array([[-y], [x]]), np.radians(np.linspace(200, 200 + 280 * spin, 60))
        arc = 0.72 * radius * np.stack([np.cos(turned), np.sin(turned)]) + at
        back = math.atan2(*(arc[:, -4] - arc[:, -1])[::-1])
        tips = [arc[:, -1] + 0.25 * radius * np.array([math.cos(back + a), math.sin(back + a)]) for a in (-0.5, 0.5)]
        marks += [Line((0, -end * y), (0, end * x), FAINT, 4.0), Line(*(circle + at), width=1.4)]
        head = np.stack([tips[0], arc[:, -1], tips[1]], axis=1)
        marks += [Line(x, y, look.color, 1.6) for x, y in (arc, head)]
        marks += [Words(-y, x, f"{i + 1}", "middle")]
    place = {each.axis: (1e3 * each.value, 1e3 * NINETY_FIVE * each.std) for each in center}
    (cx, ex), (cy, ey) = (place.get(axis, (0.0, 0.0)) for axis in "xy")
    marks += [Line((-cy - ey, -cy + ey), (cx, cx), width=1.4), Line((-cy, -cy), (cx - ex, cx + ex), width=1.4)]
    marks += [Line([-cy], [cx], width=0, marker="P", size=11)]
    bars: list[Mark] = []
    for row, (name, given) in enumerate(zip(INERTIAS, np.asarray(airframe.inertia, dtype=float), strict=True)):
        if name in constants:
            value, (low, high) = constants[name].estimate, constants[name].ci95
            bars += [Band((0, value), 2 * [row - 0.25], 2 * [row + 0.25], look.color, 0.35)]
            bars += [across([row], [low], [high], color=look.color, width=2.2, name=_ALL)]
            bars += [Line([value], [row], look.color, 0, marker=look.marker)]
        else:
            bars += [Words(0, row, "not identified")]
        bars += [Line(2 * [given], (row - 0.36, row + 0.36), dash=BOUND_DASHES[2], name="airframe's file")]
    top = max(float(np.nanmax(each.x)) for each in bars if isinstance(each, Line))
    x, y = Scale(ends=(0.0, 1.08 * top)), Scale(ends=(2.6, -0.6), ticks=dict(enumerate(INERTIAS)), lines=False)
    above = Panel("from above [mm], front up", marks, width=430, height=320, equal=True)
    return Figure("vehicle", [above, Panel("moments of inertia [kg m²]", bars, x, y, 430, 320)], columns=2)


GAINS = (0.5, 2.0)
"""The gains that a figure of the response shows at least: verdicts are about some percent."""
_WIDEST = (0.2, 5.0)  # and at most: what reaches further is unknown


def gain(name: str, one: AxisResponse, look: Style) -> Panel:
    """The gain of an axis with its 95 % band where it is clear, and its mean, about which the verdict is."""
    factor, mean, ends = np.exp(np.minimum(one.half_width, 50.0)), one.agreement(), GAINS  # 50: beyond every figure
    marks = _response(one, one.gain, np.array([one.gain / factor, one.gain * factor]), 1.0, look)
    if np.isfinite(mean.interval).all():
        low, high = mean.interval
        marks += [Band((mean.low, mean.high), 2 * [low], 2 * [high], INK, 0.18)]
        marks += [Line((mean.low, mean.high), 2 * [mean.ratio], width=2.2, name="mean gain with its 95 % interval")]
        ends = min(ends[0], max(0.8 * low, _WIDEST[0])), max(ends[1], min(1.25 * high, _WIDEST[1]))
    ticks = {x: f"{x:g}" for x in (0.1, 0.2, 0.5, 0.7, 1, 1.4, 2, 5, 10)}
    return Panel(f"{name}: gain", marks, y=Scale("log", ends, ticks))


def _response(
    one: AxisResponse,
    values: Float[np.ndarray, " frequencies"],
    band: Float[np.ndarray, "2 frequencies"],
    model: float,
    look: Style,
) -> list[Mark]:
    """Gain or phase with its band; faintly at frequencies without a clear response; dashed: the model."""
    return [
        Line(one.frequency, values, FAINT, 1.1, name="not clear"),
        Band(
            one.frequency, np.where(one.clear, band[0], np.nan), np.where(one.clear, band[1], np.nan), look.color, 0.25
        ),
        Line(one.frequency, np.where(one.clear, values, np.nan), look.color, name="measured / modelled"),
        Line(EVERYWHERE, 2 * [model], width=1.2, dash=BOUND_DASHES[2], name="model"),
    ]


def frequency_responses(found: FrequencyResponse, look: Style) -> Figure:
    """Gain, phase and coherence of each axis with 95 % bands, faint where they are not clear; dashed: the model."""
    top = min(HIGHEST, max(float(axis.frequency[-1]) if axis.frequency.size else 2.0 for axis in found))
    top = max(top, 2.0)  # [Hz]; an axis has two ends
    x, panels = Scale("log", (1.0, top), {at: f"{at}" for at in (1, 2, 5, 10, 20, 40)}, "frequency [Hz]"), []
    turns = Scale(ends=(-180, 180), ticks={at: f"{at}" for at in range(-180, 181, 90)})
    for name, axis in zip(MOTIONS, found, strict=True):
        degrees, half = np.degrees(axis.phase), np.degrees(np.minimum(axis.half_width, math.pi))
        phase = _response(axis, degrees, np.array([degrees - half, degrees + half]), 0.0, look)
        panels += [
            gain(name, axis, look),
            Panel(f"{name}: phase [degrees]", phase, y=turns),
            Panel(f"{name}: coherence", [Line(axis.frequency, axis.coherence, look.color)], y=Scale(ends=(0, 1.03))),
        ]
    return Figure("response", [panel._replace(x=x) for panel in panels])


def inertias_by_sample_time(answers: Sequence[SampleTime], chosen: float, look: Style) -> Figure:
    """Ix, Iy, Iz at each sample time with 95 % intervals. Lines: the `chosen` one [s], and its moments of inertia."""
    panels, times = [], [1e3 * each.sample_time for each in answers]
    x = Scale("log", (0.8 * times[0], 1.25 * times[-1]), {time: f"{time:.3g}" for time in times}, "sample time [ms]")
    for name in INERTIAS:
        rows = {1e3 * each.sample_time: each.constants[name] for each in answers if name in each.constants}
        at, values = list(rows), [row.estimate for row in rows.values()]
        low, high = zip(*(row.ci95 for row in rows.values()), strict=True) if rows else ((), ())
        kept = [row.estimate for time, row in rows.items() if math.isclose(time, 1e3 * chosen)]
        marks = [Line(EVERYWHERE, 2 * [each], FAINT, 1.2, BOUND_DASHES[2]) for each in kept]
        marks += [Line(at, values, look.color, dash=look.dash, marker=look.marker, name="estimate, 95 %")]
        marks += [spread(at, low, high, color=look.color)]
        marks += [Line(2 * [1e3 * chosen], EVERYWHERE, width=1.2, dash=BOUND_DASHES[1], name="chosen")]
        title, y = (f"{name} [kg m²]", Scale()) if rows else (f"{name}: not identified", Scale(ticks={}))
        panels.append(Panel(title, marks, x, y))
    return Figure("sample-times", panels)
