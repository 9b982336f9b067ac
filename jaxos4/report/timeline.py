"""Signals on one time axis without gaps, which `timeline.js` draws on a page and zooms together; those of a result."""

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..analysis.prediction import Predictions, decisive_horizon
from ..analysis.traces import Traces
from ..errors import printable
from ..flight import STATE_NAMES, STATE_UNITS
from ..identification.results import Identification
from ..models.state import CASCADE_ORDER
from .identification_figures import gaps
from .style import BOUND_DASHES, Style, style

_LEVELS = 65_000  # of a packed number, which takes two bytes


class Line(NamedTuple):
    """A signal: its name, a value for each time of its view (NaN: none), and its look; `None`: as measured ones."""

    label: str
    values: Float[np.ndarray, " samples"]
    look: Style | None = None


class Panel(NamedTuple):
    """Signals on one axis.

    - `title`: with the unit.
    - `half`: half the width of a band around the last line, in the same unit; 0: no band.
    - `residual`: whether a panel below shows the first line minus the last.
    """

    title: str
    lines: Sequence[Line]
    half: float = 0.0
    residual: bool = False


class View(NamedTuple):
    """Panels of the same samples. `time`: of each sample on the axis [s], see `Axis.place`."""

    name: str
    time: Float[np.ndarray, " samples"]
    panels: Sequence[Panel]


class Axis(NamedTuple):
    """A time axis without gaps, from 0. It is made of pieces, each an uninterrupted part of a log.

    - `at`: where a piece begins on the axis; `begin`, `end`: its own time [s]; `log`: the number of its log.
    """

    at: Float[np.ndarray, " pieces"]
    begin: Float[np.ndarray, " pieces"]
    end: Float[np.ndarray, " pieces"]
    log: Int[np.ndarray, " pieces"]

    @classmethod
    def of(
        cls, time: Float[np.ndarray, " samples"], log: Int[np.ndarray, " samples"], *, longest: float = 1.0
    ) -> "Axis":
        """The axis of samples in their order. `longest`: the longest time without a sample that stays [s]."""
        steps = np.diff(time)
        usual = float(np.median(steps)) if steps.size else 1.0
        edges = np.flatnonzero((np.diff(log) != 0) | (steps > max(longest, 5 * usual)) | (steps < 0)) + 1
        first, last = np.concatenate([[0], edges]), np.concatenate([edges, [time.size]]) - 1
        lengths = time[last] - time[first]
        between = 0.01 * lengths.sum() if len(first) < 20 else 0.0
        at = np.concatenate([[0.0], np.cumsum(lengths + between)[:-1]])
        return cls(at, time[first], time[last], log[first])

    def place(
        self, time: Float[np.ndarray, " moments"], log: Int[np.ndarray, " moments"], *, near: float = 0.05
    ) -> Float[np.ndarray, " moments"]:
        """The places of moments of logs on the axis; NaN in a gap. So `near` to a piece [s] is at its end."""
        placed = np.full(time.shape, np.nan)
        for at, begin, end, number in zip(*self, strict=True):
            inside = (log == number) & (time >= begin - near) & (time <= end + near)
            placed[inside] = at + np.clip(time[inside], begin, end) - begin
        return placed


def spans(time: Float[np.ndarray, " samples"], marked: Bool[np.ndarray, " samples"]) -> list[tuple[float, float]]:
    """From when to when samples are marked. Samples on both sides of a long gap are of two spans."""
    steps = np.diff(time)
    usual = float(np.median(steps)) if steps.size else 0.0
    edges = np.flatnonzero(np.diff(marked.astype(int)) | (steps > 5 * usual)) + 1
    parts = np.split(np.arange(time.size), edges)
    return [(float(time[part[0]] - usual / 2), float(time[part[-1]] + usual / 2)) for part in parts if marked[part[0]]]


def thinned(
    time: Float[np.ndarray, " samples"], values: Float[np.ndarray, "samples channels"], most: int
) -> tuple[Float[np.ndarray, " fewer"], Float[np.ndarray, "fewer channels"], int]:
    """At most `most` samples that draw the same lines: the least and the largest value of each block, in turn.

    **Returns:** their times and values, and the number of samples in a block; 1: all samples, as they were given.
    """
    block = -(-time.size // (most // 2))
    if block <= 2:
        return time, values, 1
    begin = np.arange(0, time.size, block)
    padded = np.pad(values, ((0, -len(values) % block), (0, 0)), constant_values=np.nan)
    cut = padded.reshape(begin.size, block, values.shape[1])
    known = np.isfinite(cut)
    ends = np.where(known, cut, np.inf).min(axis=1), np.where(known, cut, -np.inf).max(axis=1)
    both = np.where(np.asarray(known.any(axis=1))[:, None], np.stack(ends, axis=1), np.nan)
    places = np.minimum(begin[:, None] + [0, block // 2], time.size - 1)
    return time[places].ravel(), both.reshape(2 * begin.size, -1), block


def signals(
    axis: Axis,
    common: Sequence[View],
    views: Sequence[View] = (),
    *,
    shown: int = 0,
    shaded: Sequence[tuple[float, float]] = (),
    names: Sequence[str] = (),
) -> str:
    """The data that `timeline.js` draws, as JSON.

    - `common`: views below the chosen one of `views`. `shown`: the number of the first that is chosen.
    - `shaded`: from when to when the background is grey, on the axis. `names`: of the logs, if there are several.
    """
    several = np.ptp(axis.log) > 0
    pieces = [[*(float(x) for x in row[:3]), names[int(row[3])] if several else ""] for row in zip(*axis, strict=True)]
    return json.dumps(
        {
            "pieces": pieces,
            "shaded": [[round(x, 4) for x in each] for each in shaded],
            "views": [_view(each) for each in views],
            "common": [_view(each) for each in common],
            "shown": shown,
        }
    )


def _view(view: View) -> dict[str, Any]:
    kept = np.isfinite(view.time)
    order = np.flatnonzero(kept)[np.argsort(view.time[kept], kind="stable")]
    return {
        "name": view.name,
        "time": base64.b64encode(view.time[order].astype("<f4").tobytes()).decode(),
        "panels": [
            {
                "title": panel.title,
                "half": panel.half,
                "residual": panel.residual,
                "lines": [
                    {
                        "label": line.label,
                        "values": _packed(line.values[order]),
                        "color": None if line.look is None else line.look.color,
                        "dash": [3.0, 3.0] if line.look is None else [1.6 * x for x in line.look.dash[1]],
                    }
                    for line in panel.lines
                ],
            }
            for panel in view.panels
        ],
    }


def _packed(values: Float[np.ndarray, " samples"]) -> list[Any]:
    """The lowest value, the size of a level, and the level of each value as text; -1 - 2^15: not finite."""
    finite = np.isfinite(values)
    low, high = (float(f(values[finite])) for f in (np.min, np.max)) if finite.any() else (0.0, 0.0)
    step = (high - low) / _LEVELS or 1.0
    levels = np.where(finite, np.rint((np.where(finite, values, low) - low) / step) - _LEVELS // 2, -(1 << 15))
    return [low + step * (_LEVELS // 2), step, base64.b64encode(levels.astype("<i2").tobytes()).decode()]


BAND = 0.95
"""The share of the errors that the band of the predictions holds."""
# Channels of an OS4 that are shown together, in cascade order.
_GROUPS = {"rates": (0, 1, 2), "attitude": (3, 4, 5), "position": (6, 8, 10), "velocity": (7, 9, 11)}

Times = Float[np.ndarray, " samples"]


def identified_signals(found: Identification, look: Style) -> str:
    """The signals of a result's page, as JSON; empty if the result has none.

    A vehicle has a view for each horizon of its predictions, an OS4 one for each group of channels.
    """
    traces, ahead, look = found.traces, found.predictions, look._replace(dash=BOUND_DASHES[0])
    if traces is None:
        return ""
    validate, shown, shaded = found.provenance.validate or "", 0, []
    axis = _axis(traces, ahead)
    time, known = axis.place(traces.time, traces.log), np.asarray(np.isfinite(traces.measured).any(axis=1))
    if traces.predicted.shape[1]:
        views = [
            View(name, time, [_panel(i, traces.measured[:, i], traces.predicted[:, i], look) for i in group])
            for name, group in _GROUPS.items()
            if group[0] < traces.predicted.shape[1]
        ]
    elif ahead is not None:
        views = [_horizon(traces, ahead, i, axis, known, look) for i in range(ahead.horizons.size)]
        shown = decisive_horizon(ahead.horizons, np.isfinite(ahead.measured).any(axis=(0, 2)))
        shaded = spans(time, known)
    else:
        views = [View("rates", time, [_panel(i, traces.measured[:, i], None, look) for i in range(3)])]
    names = [printable(Path(name).name) for name in (*found.logs, validate)]
    common = View("", time, _common(traces))
    return signals(axis, [common] * bool(common.panels), views, shown=shown, shaded=shaded, names=names)


def _axis(traces: Traces, ahead: Predictions | None) -> Axis:
    """The axis of all logs, with the moments that are predicted."""
    starts, longest = traces.start_time, 0.0 if ahead is None else float(ahead.horizons.max())
    time = np.concatenate([traces.time, starts, starts + longest])
    log = np.concatenate([traces.log, traces.start_log, traces.start_log])
    order = np.lexsort([time, log])
    return Axis.of(time[order], log[order])


def _panel(channel: int, measured: Times, predicted: Times | None, look: Style, half: float = 0.0) -> Panel:
    """Measured and predicted values of a channel, counted in cascade order, and the residual below."""
    column = CASCADE_ORDER[channel]
    lines = [Line("measured", measured)] + ([] if predicted is None else [Line("predicted", predicted, look)])
    return Panel(f"{STATE_NAMES[column]} [{STATE_UNITS[column]}]", lines, half, residual=predicted is not None)


def _common(traces: Traces) -> list[Panel]:
    """The inputs, and the disturbances of a vehicle."""
    panels = []
    if np.isfinite(traces.rotors).any():
        rotors = [Line(f"rotor {i + 1}", column, style(i)) for i, column in enumerate(traces.rotors.T)]
        panels.append(Panel("inputs [rad/s]", rotors))
    gusts = [
        Line(name, each, style(i)) for i, (name, each) in enumerate(zip("pqr", traces.disturbance.T, strict=False))
    ]
    return [*panels, Panel("gusts [rad/s²]", gusts)] if gusts else panels


def _horizon(
    traces: Traces, ahead: Predictions, place: int, axis: Axis, fitted: Bool[np.ndarray, " samples"], look: Style
) -> View:
    """The predictions so far ahead, between the measurements that were fitted."""
    horizon, half = float(ahead.horizons[place]), prediction_band(ahead)[place]
    # A line breaks where measurements are held out, of which the first one is kept as missing, and between predictions
    # that are not of one stretch.
    kept, breaks = fitted | np.diff(fitted, prepend=False), gaps(ahead.start)[0]
    start = axis.place(traces.start_time + horizon, traces.start_log)
    start = np.insert(start, breaks, (start[breaks - 1] + start[breaks]) / 2)
    both = (np.insert(each[:, place], breaks, np.nan, axis=0) for each in (ahead.measured, ahead.predicted))
    nothing = np.full((np.count_nonzero(kept), 3), np.nan)
    before = np.where(fitted[kept, None], traces.measured[kept, :3], np.nan), nothing
    time = np.concatenate([axis.place(traces.time[kept], traces.log[kept]), start])
    measured, predicted = (np.concatenate(each) for each in zip(before, both, strict=True))
    panels = [_panel(i, measured[:, i], predicted[:, i], look, float(half[i])) for i in range(3)]
    return View(f"{horizon:.3g} s ahead", time, panels)


def prediction_band(ahead: Predictions) -> Float[np.ndarray, "horizons 3"]:
    """Half the width of the band that holds 95 % of the errors, by horizon and rate [rad/s]."""
    errors = np.abs(ahead.predicted - ahead.measured)
    return np.nanquantile(np.where(np.isnan(errors).all(axis=0), 0.0, errors), BAND, axis=0)
