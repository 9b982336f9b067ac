"""Signals on one time axis without gaps, which `timeline.js` draws on a page and zooms together."""

import base64
import json
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from .panels import Style

_LEVELS = 65_000  # of a packed number, which takes two bytes


class TimeAxis(NamedTuple):
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
    ) -> "TimeAxis":
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
        self, time: Float[np.ndarray, " moments"], log: Int[np.ndarray, " moments"]
    ) -> Float[np.ndarray, " moments"]:
        """The places of moments of logs on the axis; NaN in a gap. A moment within 50 ms of a piece is at its end."""
        placed, near = np.full(time.shape, np.nan), 0.05
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
    ends = np.empty((begin.size, 2, values.shape[1]))
    for i, column in enumerate(values.T):  # one at a time, for the memory
        cut = np.pad(column, (0, -column.size % block), constant_values=np.nan).reshape(begin.size, block)
        cut[~np.isfinite(cut)] = np.nan
        ends[:, 0, i], ends[:, 1, i] = np.fmin.reduce(cut, axis=1), np.fmax.reduce(cut, axis=1)
    places = np.minimum(begin[:, None] + [0, block // 2], time.size - 1)
    return time[places].ravel(), ends.reshape(2 * begin.size, -1), block


def line(label: str, values: Float[np.ndarray, " samples"], look: Style | None = None) -> dict[str, Any]:
    """A signal: its name, a value for each time of its view (NaN: none), and its look; `None`: as measured ones."""
    color, dash = (None, [3.0, 3.0]) if look is None else (look.color, [1.6 * length for length in look.dash[1]])
    return {"label": label, "values": values, "color": color, "dash": dash}


def panel(
    title: str, lines: Sequence[dict[str, Any]], *, half: float = 0.0, residual: bool = False, reach: float = 0.0
) -> dict[str, Any]:
    """Signals on one axis.

    - `title`: with the unit.
    - `half`: half the width of a band around the last line, in the same unit; 0: no band.
    - `residual`: whether a panel below shows the first line minus the last.
    - `reach`: where the axis ends, up and down; 0: at the largest value.
    """
    return {"title": title, "lines": lines, "half": half, "residual": residual, "reach": reach}


def view(
    name: str,
    time: Float[np.ndarray, " samples"],
    panels: Sequence[dict[str, Any]],
    start: Int[np.ndarray, " samples"] | None = None,
) -> dict[str, Any]:
    """Panels of the same samples, packed.

    - `time`: the place of each sample on the axis [s], see `TimeAxis.place`.
    - `start`: for predictions from many starts, the number of each sample's start. One start is drawn at a time.
    """
    kept = np.isfinite(time)
    order = np.flatnonzero(kept)[np.argsort(time[kept], kind="stable")]
    return {
        "name": name,
        "time": _in_text(time[order].astype("<f4")),
        "start": None if start is None else _in_text(start[order].astype("<i2")),
        "panels": [
            one | {"lines": [each | {"values": _packed(each["values"][order])} for each in one["lines"]]}
            for one in panels
        ],
    }


def signals(
    axis: TimeAxis,
    common: Sequence[dict[str, Any]],
    views: Sequence[dict[str, Any]] = (),
    *,
    before: dict[str, Any] | None = None,
    shown: int = 0,
    shaded: Sequence[tuple[float, float]] = (),
    names: Sequence[str] = (),
) -> str:
    """The data that `timeline.js` draws, as JSON.

    - `common`: views below the chosen one of `views`. `shown`: the number of the first that is chosen.
    - `before`: earlier samples of the first lines of all `views`.
    - `shaded`: from when to when the background is grey, on the axis. `names`: of the logs, if there are several.
    """
    several = np.ptp(axis.log) > 0
    pieces = [[*(float(x) for x in row[:3]), names[int(row[3])] if several else ""] for row in zip(*axis, strict=True)]
    grey = [[round(x, 4) for x in each] for each in shaded]
    drawn = {"pieces": pieces, "shaded": grey, "before": before, "views": views, "common": common, "shown": shown}
    return json.dumps(drawn)


def _in_text(numbers: np.ndarray) -> str:
    return base64.b64encode(numbers.tobytes()).decode()


def _packed(values: Float[np.ndarray, " samples"]) -> list[Any]:
    """The lowest value, the size of a level, and the level of each value as text; -1 - 2^15: not finite."""
    finite = np.isfinite(values)
    low, high = (float(f(values[finite])) for f in (np.min, np.max)) if finite.any() else (0.0, 0.0)
    step = (high - low) / _LEVELS or 1.0
    levels = np.where(finite, np.rint((np.where(finite, values, low) - low) / step) - _LEVELS // 2, -(1 << 15))
    return [low + step * (_LEVELS // 2), step, _in_text(levels.astype("<i2"))]
