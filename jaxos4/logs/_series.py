"""Sensors and motors that were logged at rates of their own, on the rows of the gyro."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

_REACH = 1.5  # times a sensor's own step: its samples further apart have a gap between them
_EXACT = 0.01  # of the rows' step: a sample no further from a row stands there
_DISORDER = 0.01  # share of samples that may be late or repeated in a log that is not broken


class Series(NamedTuple):
    """Samples of one sensor: times [s], increasing, and a column for each of what it measures; NaN: not measured."""

    t: Float[np.ndarray, " samples"]
    values: Float[np.ndarray, "samples columns"]


def in_order(t: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"] | None:
    """Which samples come later than all before them; None where so many do not that the log must be broken."""
    if not np.isfinite(t).all():
        return None
    later = np.ones(t.size, dtype=bool)
    later[1:] = t[1:] > np.maximum.accumulate(t)[:-1]
    return later if np.count_nonzero(~later) <= max(_DISORDER * t.size, 1) else None


def placed(rows: Float[np.ndarray, " rows"], series: Series) -> Float[np.ndarray, "rows columns"]:
    """A sensor's samples at the rows nearest to them, NaN at the other rows.

    Each is interpolated between its neighbours to the row's time, second order in the sensor's step, so that nothing
    is early or late; across a gap of the sensor there is nothing. Angles must be unwrapped.
    """
    out = np.full((rows.size, series.values.shape[1]), np.nan)
    step = float(np.median(np.diff(rows))) if rows.size > 1 else 0.0
    for column, values in enumerate(series.values.T):
        measured = np.isfinite(values)
        t, values = series.t[measured], values[measured]
        if t.size == 0:
            continue
        near = _nearest(rows, t)
        at = np.unique(near[np.abs(rows[near] - t) <= step])
        time = rows[at]
        right = np.clip(np.searchsorted(t, time), 1, max(t.size - 1, 1))
        left = right - 1
        right = np.minimum(right, t.size - 1)
        own = max(float(np.median(np.diff(t))) if t.size > 1 else 0.0, step)
        joined = (t[left] <= time) & (time <= t[right]) & (t[right] - t[left] <= _REACH * own)
        out[at[joined], column] = np.interp(time, t, values)[joined]
        close = _nearest(t, time)
        stands = ~joined & (np.abs(t[close] - time) <= _EXACT * step)
        out[at[stands], column] = values[close[stands]]
    return out


def driving(rows: Float[np.ndarray, " rows"], series: Series, *, measured: bool) -> Float[np.ndarray, "rows columns"]:
    """What drove a rotor from each row to the next: the root mean square of its speed or command over that time.

    **Arguments:**

    - `rows`: [s], none of them before the first sample of `series`.
    - `series`: rotor speeds or commands, all finite.
    - `measured`: speeds are joined linearly in their squares; commands are held until the next one.

    Thrust and torque go with the square, so that each rotor's impulse is conserved.
    """
    squares = np.square(series.values)
    mean = (squares[:-1] + squares[1:]) / 2 if measured else squares[:-1]
    steps = np.diff(series.t)[:, None]
    total = np.vstack([np.zeros(squares.shape[1]), np.cumsum(mean * steps, axis=0)])
    held = np.minimum(np.searchsorted(series.t, rows, side="right") - 1, series.t.size - 1)
    after = (rows - series.t[held])[:, None]
    next_ = np.minimum(held + 1, series.t.size - 1)
    slope = np.zeros_like(total[held])
    if measured:
        width = np.maximum(series.t[next_] - series.t[held], 1e-12)[:, None]
        slope = (squares[next_] - squares[held]) / width * (next_ > held)[:, None]
    impulse = total[held] + (squares[held] + slope * after / 2) * after
    out = np.sqrt(np.maximum(squares[held] + slope * after, 0.0))
    out[:-1] = np.sqrt(np.maximum(np.diff(impulse, axis=0) / np.diff(rows)[:, None], 0.0))
    return out


def covered(rows: Float[np.ndarray, " rows"], t: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " rows"]:
    """Rows from the first sample at `t` to a step after the last."""
    step = float(np.median(np.diff(t))) if t.size > 1 else 0.0
    return (rows >= t[0]) & (rows <= t[-1] + _REACH * step)


def _nearest(grid: np.ndarray, t: np.ndarray) -> np.ndarray:
    right = np.clip(np.searchsorted(grid, t), 1, max(grid.size - 1, 1))
    left = right - 1
    right = np.minimum(right, grid.size - 1)
    return np.where(t - grid[left] <= grid[right] - t, left, right)
