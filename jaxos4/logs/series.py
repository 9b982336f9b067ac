"""Samples of sensors and motors that were logged at different rates, brought to the rows of the gyro."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .resample import REACH, UNIFORM, unwrap
from .table import MAX_ROWS, Path, refuse

_FASTER = 0.9  # of the rows' step: a sensor with shorter steps is averaged
_FASTEST_ROWS = 0.001  # [s]; a faster gyro is averaged to this step, because no vehicle's motion needs more
_DISORDER = 0.01  # share of samples that may be late or repeated in an intact log


class Series(NamedTuple):
    """Samples of one sensor: times [s], increasing, and one column for each quantity. NaN means not measured."""

    t: Float[np.ndarray, " samples"]
    values: Float[np.ndarray, "samples columns"]


def in_order(t: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"] | None:
    """Which samples are later than all samples before them. None if more than 1 % are not: the log is corrupt."""
    if not np.isfinite(t).all():
        return None
    later = np.ones(t.size, dtype=bool)
    later[1:] = t[1:] > np.maximum.accumulate(t)[:-1]
    return later if np.count_nonzero(~later) <= max(_DISORDER * t.size, 1) else None


def gyro_rows(
    path: Path, rates: Series, rotors: Series, *, measured: bool
) -> tuple[Float[np.ndarray, " rows"], dict[str, np.ndarray]]:
    """Use the gyro's samples as rows, and bring the rotors to them: `measured` speeds [rad/s], or commands [0..1].

    A gyro that is faster than 1 kHz is averaged to 1 kHz.

    **Returns:** the times of the rows [s], and the columns `t` (from 0), `p, q, r`, and `omega1..4` or `command1..4`.

    **Raises:** `InputError` if rates and rotors do not overlap in time, or there are more than `MAX_ROWS` rows.
    """
    rates = _at_most(_FASTEST_ROWS, rates)
    inside = covered(rates.t, rotors.t)
    if np.count_nonzero(inside) < 2:
        refuse(path, "rates and motors were not logged at the same time; record both in one flight")
    rows = rates.t[inside]
    if rows.size > MAX_ROWS:
        refuse(path, f"has more than {MAX_ROWS:,} samples of the gyro; cut the log into flights")
    prefix = "omega" if measured else "command"
    columns = {"t": rows - rows[0], **dict(zip("pqr", rates.values[inside].T, strict=True))}
    columns.update((f"{prefix}{i + 1}", c) for i, c in enumerate(rotor_rms(rows, rotors, measured=measured).T))
    return rows, columns


def at_rows(rows: Float[np.ndarray, " rows"], series: Series) -> Float[np.ndarray, "rows columns"]:
    """Bring each sample of a sensor to the row nearest to it. The other rows are NaN.

    Values are interpolated linearly to the time of the row, but not across a gap. A sensor that is faster than the rows
    is averaged over the time from half a step before the row to half a step after it. Angles must be unwrapped.
    """
    out = np.full((rows.size, series.values.shape[1]), np.nan)
    step = float(np.median(np.diff(rows))) if rows.size > 1 else 0.0
    for column, values in enumerate(series.values.T):
        measured = np.isfinite(values)
        t, values = series.t[measured], values[measured]
        if t.size == 0:
            continue
        if t.size > 1 and np.median(np.diff(t)) < _FASTER * step:
            out[:, column] = _means(rows, step, t, values)
            continue
        near = _nearest(rows, t)
        at = np.unique(near[np.abs(rows[near] - t) <= step])
        time = rows[at]
        right = np.clip(np.searchsorted(t, time), 1, max(t.size - 1, 1))
        left = right - 1
        right = np.minimum(right, t.size - 1)
        own_step = max(float(np.median(np.diff(t))) if t.size > 1 else 0.0, step)
        joined = (t[left] <= time) & (time <= t[right]) & (t[right] - t[left] <= REACH * own_step)
        out[at[joined], column] = np.interp(time, t, values)[joined]
        close = _nearest(t, time)
        exact = ~joined & (np.abs(t[close] - time) <= UNIFORM * step)
        out[at[exact], column] = values[close[exact]]
    return out


def rotor_rms(rows: Float[np.ndarray, " rows"], series: Series, *, measured: bool) -> Float[np.ndarray, "rows columns"]:
    """Root mean square of each rotor's speed or command from each row to the next, so that its impulse is conserved.

    Measured speeds are interpolated linearly in their squares; commands are held until the next one. No row lies before
    the first sample of `series`.
    """
    squares = np.square(series.values)
    mean = (squares[:-1] + squares[1:]) / 2 if measured else squares[:-1]
    steps = np.diff(series.t)[:, None]
    total = np.vstack([np.zeros(squares.shape[1]), np.cumsum(mean * steps, axis=0)])
    held = np.minimum(np.searchsorted(series.t, rows, side="right") - 1, series.t.size - 1)
    after = (rows - series.t[held])[:, None]
    following = np.minimum(held + 1, series.t.size - 1)
    slope = np.zeros_like(total[held])
    if measured:
        width = np.maximum(series.t[following] - series.t[held], 1e-12)[:, None]
        slope = (squares[following] - squares[held]) / width * (following > held)[:, None]
    impulse = total[held] + (squares[held] + slope * after / 2) * after
    out = np.sqrt(np.maximum(squares[held] + slope * after, 0.0))
    out[:-1] = np.sqrt(np.maximum(np.diff(impulse, axis=0) / np.diff(rows)[:, None], 0.0))
    return out


def covered(rows: Float[np.ndarray, " rows"], t: Float[np.ndarray, " samples"]) -> Bool[np.ndarray, " rows"]:
    """Which rows lie between the first sample at `t` and one step after the last."""
    step = float(np.median(np.diff(t))) if t.size > 1 else 0.0
    return (rows >= t[0]) & (rows <= t[-1] + REACH * step)


def euler_angles(quaternion: Float[np.ndarray, "samples 4"]) -> Float[np.ndarray, "samples 3"]:
    """Roll, pitch, yaw [rad] of quaternions (w, x, y, z), which need not be normalised. NaN if one is zero."""
    with np.errstate(all="ignore"):
        w, x, y, z = (quaternion / np.sqrt((quaternion**2).sum(axis=1, keepdims=True))).T
    phi = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    theta = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return np.column_stack([phi, theta, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))])


def unwrapped(t: Float[np.ndarray, " samples"], angles: Float[np.ndarray, "samples 3"]) -> Series:
    """Roll, pitch, yaw [rad] as a series, with the jumps of 2 pi removed from roll and yaw."""
    return Series(t, np.column_stack([unwrap(angles[:, 0])[0], angles[:, 1], unwrap(angles[:, 2])[0]]))


def _at_most(step: float, series: Series) -> Series:
    """The series, averaged to one sample each `step` [s] if it is faster. Gaps stay gaps."""
    if series.t.size < 2 or np.median(np.diff(series.t)) >= _FASTER * step:
        return series
    grid = series.t[0] + step * (np.unique(np.floor((series.t - series.t[0]) / step)) + 0.5)
    kept = np.isfinite(series.values).all(axis=1)
    if np.count_nonzero(kept) < 2:
        return series
    means = np.column_stack([_means(grid, step, series.t[kept], values[kept]) for values in series.values.T])
    measured = np.isfinite(means).all(axis=1)
    return Series(grid[measured], means[measured]) if np.count_nonzero(measured) > 1 else series


def _means(rows: np.ndarray, width: float, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Means over `width` around each row, of values interpolated linearly. NaN at the ends and across a gap."""
    steps = np.diff(t)
    total = np.append(0.0, np.cumsum((values[:-1] + values[1:]) / 2 * steps))
    gaps = np.append(0, np.cumsum(steps > REACH * np.median(steps)))
    integral, before = [], []
    for edge in (rows - width / 2, rows + width / 2):
        left = np.clip(np.searchsorted(t, edge, side="right") - 1, 0, t.size - 2)
        after = edge - t[left]
        slope = (values[left + 1] - values[left]) / steps[left]
        integral.append(total[left] + (values[left] + slope * after / 2) * after)
        before.append(left)
    whole = (rows - width / 2 >= t[0]) & (rows + width / 2 <= t[-1]) & (gaps[before[1] + 1] == gaps[before[0]])
    return np.where(whole, (integral[1] - integral[0]) / width, np.nan)


def _nearest(grid: np.ndarray, t: np.ndarray) -> np.ndarray:
    right = np.clip(np.searchsorted(grid, t), 1, max(grid.size - 1, 1))
    left = right - 1
    right = np.minimum(right, grid.size - 1)
    return np.where(t - grid[left] <= grid[right] - t, left, right)
