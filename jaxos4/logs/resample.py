"""Resampling of rows at uneven times to a uniform grid. Gaps stay unmeasured."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

UNIFORM = 0.01  # of dt: rows this close to a grid keep their values
REACH = 1.5  # times dt: measured samples further apart have a gap between them
ROUNDING = 1e-6  # of dt: a smaller difference from a grid is a rounding error


class Gap(NamedTuple):
    """The widest gap: its `length` [s], the index `row` before it, and the `samples` of a grid over all rows."""

    samples: float
    row: int
    length: float


def uniform_grid(t: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"] | None:
    """The uniform grid from the first to the last time [s], or None if a row is more than 1 % of a step away from it.

    If the times differ from the grid by rounding errors only, the times themselves are returned.
    """
    grid = np.linspace(t[0], t[-1], t.size)
    dt = (t[-1] - t[0]) / (t.size - 1)
    off = np.abs(t - grid).max()
    if off > UNIFORM * dt:
        return None
    return t if off <= max(ROUNDING * dt, 4 * np.spacing(np.abs(t).max())) else grid


def widest_gap(t: Float[np.ndarray, " rows"], dt: float) -> Gap:
    """The widest gap between rows at `t` [s], and the number of samples on a grid of step `dt` [s]."""
    step = np.diff(t)
    row = int(np.argmax(step))
    return Gap(math.floor((t[-1] - t[0]) / dt + UNIFORM) + 1.0, row, float(step[row]))


def resample(
    t: Float[np.ndarray, " rows"], omega: Float[np.ndarray, "rows 4"], channels: Float[np.ndarray, "rows n"], dt: float
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, "samples 4"], Float[np.ndarray, "samples n"], str]:
    """Resample rows at uneven times to the grid t_0, t_0 + dt, ...

    **Arguments:** times [s], rotor speeds [rad/s], each held until the next row, measurements with unwrapped angles
    (NaN means not measured), and the step of the grid [s].

    **Returns:** time, rotor speeds, channels, and a note with the figures of the resampling.

    Rotor speeds: the root mean square of the held speed over each interval of the grid. Thrust and torque are
    proportional to the square, so each rotor's impulse is conserved. The last value is the speed held at that time.

    Measurements: linear interpolation between measured samples at most 1.5 dt apart, with an error of second order in
    dt. A slower sensor gives one value for each of its samples, at the nearest time of the grid. Neighbours further
    apart than 1.5 steps of the sensor have a gap between them. A gap is NaN, except for samples within 1 % of dt of a
    time of the grid.
    """
    samples = int(widest_gap(t, dt).samples)
    grid = t[0] + dt * np.arange(samples)
    even = np.column_stack([_interpolate(t, channel, grid, dt) for channel in channels.T])
    return grid, root_mean_square(t, omega, grid, dt), even, _figures(t, grid, dt)


def unwrap(angle: Float[np.ndarray, " rows"]) -> tuple[Float[np.ndarray, " rows"], int]:
    """Remove the jumps of 2 pi from an angle [rad], and count them. Values before the first jump do not change."""
    measured = np.flatnonzero(np.isfinite(angle))
    step = np.diff(angle[measured])
    turns = np.where(np.abs(step) > math.pi, np.rint(step / (2 * math.pi)), 0.0)
    if not turns.any():
        return angle, 0
    angle = angle.copy()
    angle[measured[1:]] -= 2 * math.pi * np.cumsum(turns)
    return angle, int(np.count_nonzero(turns))


def _interpolate(t: np.ndarray, y: np.ndarray, grid: np.ndarray, dt: float) -> np.ndarray:
    out = np.full(grid.shape, np.nan)
    measured = np.isfinite(y)
    t, y = t[measured], y[measured]
    if t.size > 1:
        left = np.clip(np.searchsorted(t, grid, side="right") - 1, 0, t.size - 2)
        after, before, step = grid - t[left], t[left + 1] - grid, np.diff(t)
        own_reach = REACH * max(dt, float(np.median(step)))
        step = step[left]
        near = np.minimum(after, before) <= dt / 2
        joined = (after >= 0) & (before >= 0) & ((step <= REACH * dt) | (near & (step <= own_reach)))
        out[joined] = (y[left] + after / step * (y[left + 1] - y[left]))[joined]
    nearest = np.rint((t - grid[0]) / dt).astype(int)
    inside = nearest < grid.size
    nearest, t, y = nearest[inside], t[inside], y[inside]
    exact = (np.abs(t - grid[nearest]) <= UNIFORM * dt) & np.isnan(out[nearest])
    out[nearest[exact]] = y[exact]
    return out


def root_mean_square(t: np.ndarray, omega: np.ndarray, grid: np.ndarray, dt: float) -> np.ndarray:
    """Root mean square of held rotor speeds over each interval of a uniform grid. The last value is the held speed."""
    held = np.minimum(np.searchsorted(t, grid, side="right") - 1, t.size - 1)
    speeds = omega[held]
    until = np.append(t, max(t[-1], grid[-1]) + dt)  # the last row is held to the end of the grid
    squares = np.vstack([np.zeros(4), np.cumsum(omega**2 * np.diff(until)[:, None], axis=0)])
    for rotor in range(4):
        impulse = np.diff(np.interp(grid, until, squares[:, rotor]))
        speeds[:-1, rotor] = np.sqrt(np.maximum(impulse, 0) / dt)
    return speeds


def _figures(t: np.ndarray, grid: np.ndarray, dt: float) -> str:
    step = np.diff(t)
    gap = step > REACH * dt
    jitter = np.std(step[~gap])
    jitter = jitter if jitter > ROUNDING * dt else 0.0
    text = (
        f"t is not uniform (jitter {1e3 * jitter:.3g} ms, standard deviation): {t.size} rows were resampled to "
        f"{grid.size} samples, one every {1e3 * dt:.6g} ms"
    )
    if not gap.any():
        return text
    starts = np.flatnonzero(gap)
    inside = np.searchsorted(grid, t[starts + 1] - UNIFORM * dt) - np.searchsorted(grid, t[starts] + UNIFORM * dt)
    gaps = "1 gap" if starts.size == 1 else f"{starts.size} gaps"
    return (
        f"{text}; {gaps} of up to {1e3 * step.max():.4g} ms: the {int(inside.sum())} samples in gaps hold the rotor "
        "speeds and count as not measured"
    )
