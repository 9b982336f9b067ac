"""Samples at any times, brought to other times: integrals, means, interpolation. Gaps stay unmeasured (NaN)."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..errors import counted

UNIFORM = 0.01  # of a step: rows this close to a grid keep their values
REACH = 1.5  # times the step: measured samples further apart have a gap between them
_ROUNDING = 1e-6  # of a step: a smaller difference from a grid is a rounding error
_FASTER = 0.9  # of the rows' step: a sensor with shorter steps is averaged

Times = Float[np.ndarray, " samples"]
Columns = Float[np.ndarray, "samples columns"]
Speeds = Float[np.ndarray, "samples 4"]
Rows = Float[np.ndarray, " rows"]
"""The times of rows [s]."""
Resampled = tuple[Rows, Float[np.ndarray, "rows 4"], Float[np.ndarray, "rows columns"]]
PARTS = 4
"""The quarters of an averaged sample in which its rotor speeds are kept. Two of them are half of a sample."""


class Series(NamedTuple):
    """Samples of one sensor: times [s], increasing, and one column for each quantity. NaN means not measured."""

    t: Times
    values: Columns


def integral(series: Series, *, linear: bool = False) -> Callable[[Times], Columns]:
    """The integral of each column from the first sample, as a function of the time; 0 before the first sample.

    A value lasts until the next one, and the last one for ever. If `linear`, values are interpolated instead.
    """
    t, values = series
    mean = (values[:-1] + values[1:]) / 2 if linear else values[:-1]
    total = np.zeros_like(values, dtype=float)
    np.cumsum(mean * np.diff(t)[:, None], axis=0, out=total[1:])

    def until(at: Times) -> Columns:
        left = np.maximum(np.searchsorted(t, at, side="right") - 1, 0)
        after = np.maximum(at - t[left], 0)[:, None]
        value = values[left]
        if linear:
            right = np.minimum(left + 1, t.size - 1)
            width = np.where(right > left, t[right] - t[left], 1.0)[:, None]
            value = value + (values[right] - value) / width * after / 2
        return total[left] + value * after

    return until


def root_mean_square(series: Series, *, linear: bool = False) -> Callable[[Rows], Columns]:
    """Root mean square of each rotor's speed or command from each row to the next, so that its impulse is conserved.

    Thrust and torque are proportional to the square. Speeds are held until the next sample; if `linear`, their squares
    are interpolated. The last row has the speed at that time. The rows are times; none lies before the first sample.
    """
    squares = Series(series.t, np.square(series.values))
    impulse = integral(squares, linear=linear)

    def at(rows: Rows) -> Columns:
        last = np.searchsorted(series.t, rows[-1], side="right") - 1
        out = np.empty((rows.size, squares.values.shape[1]))
        out[:-1] = np.diff(impulse(rows), axis=0) / np.diff(rows)[:, None]
        out[-1] = squares.values[last]
        if linear:
            out[-1] = [np.interp(rows[-1], series.t, column) for column in squares.values.T]
        return np.sqrt(np.maximum(out, 0.0))

    return at


def speeds_within(t: Times, omega: Speeds, *, held: bool) -> Callable[[Rows, float], Float[np.ndarray, "rows parts 4"]]:
    """A function of rows and step [s]: the root mean square of each rotor's speed in the parts of samples around rows.

    Arguments as in `averages`. Before the first time, rotors have the speeds of the first row.
    """
    times, values = np.append(2 * t[0] - t[-1], t), np.concatenate([omega[:1], omega])
    speeds = root_mean_square(Series(times, values), linear=not held)

    def at(rows: Rows, dt: float) -> Float[np.ndarray, "rows parts 4"]:
        edges = rows[0] - dt / 2 + dt / PARTS * np.arange(PARTS * rows.size + 1)
        return speeds(edges)[:-1].reshape(rows.size, PARTS, -1)

    return at


def averages(t: Times, omega: Speeds, columns: Columns, *, held: bool) -> Callable[[float], Resampled]:
    """A function that averages uniformly sampled rows to samples of a given length [s], from the first time on.

    Each measurement becomes the mean over a sample around its time, or NaN if less than about half of it was measured.
    The first sample begins half of a row before the first row, so that samples of whole rows share none. Each rotor
    speed becomes the root mean square over the sample that follows. `omega`: [rad/s], `held` from row to row or not.
    """
    own = (t[-1] - t[0]) / (t.size - 1)
    measured = np.isfinite(columns)
    some, gaps = measured.any(axis=0), ~measured.all(axis=0)
    total = integral(Series(t - own / 2, np.where(measured, columns, 0.0)[:, some]))
    share = integral(Series(t - own / 2, measured[:, some & gaps].astype(float)))
    speeds = root_mean_square(Series(t, omega), linear=not held)

    def average(dt: float) -> Resampled:
        samples = max(math.floor((t[-1] - t[0] + own) / dt + UNIFORM), 1)
        edges = np.minimum(t[0] - own / 2 + dt * np.arange(samples + 1), t[-1] + own / 2)
        grid = t[0] - own / 2 + dt * (np.arange(samples) + 0.5)
        covered = np.repeat(np.diff(np.maximum(edges, t[0] - own / 2))[:, None], columns.shape[1], axis=1)
        covered[:, some & gaps] = np.diff(share(edges), axis=0)
        means = np.full((grid.size, columns.shape[1]), np.nan)
        means[:, some] = np.diff(total(edges), axis=0)
        # Below one half, because the samples at the ends have half of their rows.
        means /= np.where(covered > 0.45 * dt, covered, np.nan)
        return grid, speeds(grid), means

    return average


def at_rows(rows: Rows, series: Series, *, step: float | None = None) -> Float[np.ndarray, "rows columns"]:
    """Bring each sample of a sensor to the row nearest to it. The other rows are NaN.

    Values are interpolated linearly, but not across a gap: between neighbours more than 1.5 steps of the sensor apart.
    A sensor that is faster than the rows is averaged over a step around the row. Angles must be unwrapped.

    `step`: of a uniform grid [s]: all rows between neighbours within 1.5 steps get a value, and nothing is averaged.
    """
    own = step or median_step(rows)
    out = np.full((rows.size, series.values.shape[1]), np.nan)
    for column, values in enumerate(series.values.T):
        measured = np.isfinite(values)
        t, values = series.t[measured], values[measured]
        if step is None and t.size > 1 and median_step(t) < _FASTER * own:
            out[:, column] = _means(rows, own, Series(t, values[:, None]))[:, 0]
        elif t.size:
            row, near = _around(rows, t)[2], np.zeros(rows.size, dtype=bool)
            near[row[np.abs(rows[row] - t) <= (own / 2 if step else own)]] = True
            left, right, nearest = _around(t, rows)
            apart, between = t[right] - t[left], (t[left] <= rows) & (rows <= t[right])
            joined = near & (apart <= REACH * max(median_step(t), own)) | ((apart <= REACH * own) if step else False)
            exact = near & ~(between & joined) & (np.abs(t[nearest] - rows) <= UNIFORM * own)
            out[:, column] = np.where(between & joined, np.interp(rows, t, values), np.nan)
            out[exact, column] = values[nearest[exact]]
    return out


def at_most(series: Series, step: float) -> Series:
    """The series, averaged to one sample every `step` [s] if it is faster. Gaps stay gaps."""
    kept = np.isfinite(series.values).all(axis=1)
    if series.t.size < 2 or median_step(series.t) >= _FASTER * step or np.count_nonzero(kept) < 2:
        return series
    grid = series.t[0] + step * (np.unique(np.floor((series.t - series.t[0]) / step)) + 0.5)
    means = _means(grid, step, Series(series.t[kept], series.values[kept]))
    measured = np.isfinite(means).all(axis=1)
    return Series(grid[measured], means[measured]) if np.count_nonzero(measured) > 1 else series


def grid_size(t: Times, dt: float) -> float:
    """The number of samples of a grid of step `dt` over the times `t` [s]. It may be too large for memory."""
    return math.floor((t[-1] - t[0]) / dt + UNIFORM) + 1.0


def resample(t: Times, omega: Speeds, columns: Columns, dt: float, *, held: bool) -> tuple[Resampled, str]:
    """Bring rows at uneven times [s] to the grid t_0, t_0 + dt, ..., with a note if that changes any.

    `omega` is `held` until the next row, or interpolated (`root_mean_square`); `columns` are interpolated (`at_rows`).
    A gap is NaN, except within 1 % of dt of a sample. Rows within 1 % of a step of a uniform grid keep their values.
    """
    own, grid = (t[-1] - t[0]) / (t.size - 1), np.linspace(t[0], t[-1], t.size)
    off = np.abs(t - grid).max()
    if off <= UNIFORM * own:
        return (t if off <= max(_ROUNDING * own, 4 * np.spacing(np.abs(t).max())) else grid, omega, columns), ""
    grid, step = t[0] + dt * np.arange(int(grid_size(t, dt))), np.diff(t)
    gap = step > REACH * dt
    jitter = np.std(step[~gap])
    note = (
        f"t is not uniform (jitter {1e3 * jitter * (jitter > _ROUNDING * dt):.3g} ms, standard deviation): {t.size} "
        f"rows were resampled to {grid.size} samples, one every {1e3 * dt:.6g} ms"
    )
    if gap.any():
        ends = [
            np.searchsorted(grid, t[np.flatnonzero(gap) + k] + sign * UNIFORM * dt) for k, sign in ((0, 1), (1, -1))
        ]
        note += (
            f"; {counted(int(gap.sum()), 'gap')} of up to {1e3 * step.max():.4g} ms: the "
            f"{int((ends[1] - ends[0]).sum())} samples in gaps {'hold' if held else 'interpolate'} the rotor speeds "
            "and count as not measured"
        )
    speeds = root_mean_square(Series(t, omega), linear=not held)(grid)
    return (grid, speeds, at_rows(grid, Series(t, columns), step=dt)), note


def unwrap(angle: Float[np.ndarray, " rows"]) -> tuple[Float[np.ndarray, " rows"], int]:
    """Remove the jumps of 2 pi from an angle [rad], and count them. Values before the first jump do not change."""
    measured, unwrapped = np.isfinite(angle), angle.copy()
    without_turns = np.unwrap(angle[measured])
    unwrapped[measured] = np.where(without_turns == angle[measured], angle[measured], without_turns)  # keeps -0.0
    return unwrapped, int(np.count_nonzero(np.abs(np.diff(angle[measured])) > math.pi))


DISORDER = 0.01  # the share of late samples that can be ignored


def in_order(t: Times) -> Bool[np.ndarray, " samples"] | None:
    """Whether each sample is later than all before it.

    `None` if a time is not finite, or if more than one sample, and more than the share `DISORDER`, is late.
    """
    if not np.isfinite(t).all():
        return None
    later = np.ones(t.size, dtype=bool)
    later[1:] = t[1:] > np.maximum.accumulate(t)[:-1]
    return later if np.count_nonzero(~later) <= max(DISORDER * t.size, 1) else None


PAUSE = 0.9  # s; a longer step is a pause between sessions


def logged_rate(t: Times) -> float:
    """The rate [Hz] of samples at the times `t` [s]: for half of the time, they come at least this often."""
    steps = np.diff(t)
    steps = np.sort(steps[(steps > 0) & (steps <= PAUSE)] if (steps <= PAUSE).any() else steps)
    total = np.cumsum(steps)
    if total.size == 0 or total[-1] <= 0:
        return 0.0
    return 1.0 / float(steps[np.searchsorted(total, total[-1] / 2)])


MIN_STEPS = 20  # fewer show no rate
REGULAR = 0.6  # of the median step; the steps of a fixed rate differ by less


def held_regularly(t: Times) -> bool:
    """Whether values that change at the times `t` [s] were written at a fixed rate: many steps, nearly equal."""
    steps = np.diff(t)
    if steps.size < MIN_STEPS:
        return False
    low, middle, high = np.quantile(steps, [0.1, 0.5, 0.9])
    return bool(high - low <= REGULAR * middle)


def runs(where: Bool[np.ndarray, " samples"]) -> list[tuple[int, int]]:
    """Begin and end (exclusive) of each run of `True`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int8)))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]


def median_step(t: Times) -> float:
    """The median time between samples [s]; 0 for one sample."""
    return float(np.median(np.diff(t))) if t.size > 1 else 0.0


def _means(rows: np.ndarray, width: float, series: Series) -> np.ndarray:
    """Means over `width` around each row, of values interpolated linearly. NaN at the ends and across a gap."""
    t, (begin, end) = series.t, (rows - width / 2, rows + width / 2)
    steps = np.diff(t)
    gaps = np.append(0, np.cumsum(steps > REACH * np.median(steps)))
    first, last = (np.clip(np.searchsorted(t, edge, side="right") - 1, 0, t.size - 2) for edge in (begin, end))
    whole = (begin >= t[0]) & (end <= t[-1]) & (gaps[last + 1] == gaps[first])
    total = integral(series, linear=True)
    mean = (total(end) - total(begin)) / width
    return np.where(whole[:, None], mean, np.nan)


def _around(grid: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The indices of the times in `grid` on both sides of each time `t`, and of the nearest of the two."""
    right = np.clip(np.searchsorted(grid, t), min(1, grid.size - 1), grid.size - 1)
    left = np.maximum(right - 1, 0)
    return left, right, np.where(t - grid[left] <= grid[right] - t, left, right)
