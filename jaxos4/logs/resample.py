"""Rows recorded at uneven times to a uniform grid, inventing nothing across gaps."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

UNIFORM = 0.01  # of dt: rows no further from a grid stand as they were recorded
REACH = 1.5  # times dt: measured samples further apart have a gap between them
ROUNDING = 1e-6  # of dt: times no further from a grid are the grid, rounded


class Gap(NamedTuple):
    """What filling the grid across a gap would cost: `samples` in all, most of them after row index `row`."""

    samples: float
    row: int
    length: float


def uniform_grid(t: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"] | None:
    """The grid on which rows at `t` [s] may stand as recorded: within 1 % of a step from it; None where they may not.

    The grid joins the end points. Where the times are its equals but for rounding, they are returned untouched.
    """
    grid = np.linspace(t[0], t[-1], t.size)
    dt = (t[-1] - t[0]) / (t.size - 1)
    off = np.abs(t - grid).max()
    if off > UNIFORM * dt:
        return None
    return t if off <= max(ROUNDING * dt, 4 * np.spacing(np.abs(t).max())) else grid


def widest_gap(t: Float[np.ndarray, " rows"], dt: float) -> Gap:
    """The number of samples a grid of `dt` needs, and the widest gap it has to bridge."""
    step = np.diff(t)
    row = int(np.argmax(step))
    return Gap(math.floor((t[-1] - t[0]) / dt + UNIFORM) + 1.0, row, float(step[row]))


def resample(
    t: Float[np.ndarray, " rows"],
    omega: Float[np.ndarray, "rows 4"],
    channels: Float[np.ndarray, "rows channels"],
    dt: float,
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, "samples 4"], Float[np.ndarray, "samples channels"], str]:
    """Rows at uneven times on the grid t_0, t_0 + dt, ...

    **Arguments:**

    - `t`: [s], increasing.
    - `omega`: rotor speeds [rad/s], each held to the next row.
    - `channels`: measurements; NaN where not measured. Angles must be unwrapped.
    - `dt`: [s].

    **Returns:** time, rotor speeds, channels, and a line of figures for the user.

    A rotor speed becomes the root mean square of the held speed over the sample's interval: thrust and torque go with
    its square, so that each rotor's impulse is conserved, however the rows lie. The last one is the speed held there.

    A measurement is interpolated linearly between neighbouring measured samples no further apart than 1.5 dt: second
    order in dt. A sensor slower than the rows (its own median step is longer) yields one grid sample for each of its
    own, the nearest, interpolated toward the next one. Where the neighbours are further apart than 1.5 of either step
    there is a gap, and NaN in it, save that a sample within 1 % of dt from a grid time stands there.
    """
    samples = int(widest_gap(t, dt).samples)
    grid = t[0] + dt * np.arange(samples)
    even = np.column_stack([_interpolate(t, channel, grid, dt) for channel in channels.T])
    return grid, root_mean_square(t, omega, grid, dt), even, _figures(t, grid, dt)


def unwrap(angle: Float[np.ndarray, " rows"]) -> tuple[Float[np.ndarray, " rows"], int]:
    """An angle [rad] without its jumps of a turn, and their number; NaN stay, and so does what follows no jump."""
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
        own = REACH * max(dt, float(np.median(step)))
        step = step[left]
        near = np.minimum(after, before) <= dt / 2
        joined = (after >= 0) & (before >= 0) & ((step <= REACH * dt) | (near & (step <= own)))
        out[joined] = (y[left] + after / step * (y[left + 1] - y[left]))[joined]
    nearest = np.rint((t - grid[0]) / dt).astype(int)
    inside = nearest < grid.size
    nearest, t, y = nearest[inside], t[inside], y[inside]
    stands = (np.abs(t - grid[nearest]) <= UNIFORM * dt) & np.isnan(out[nearest])
    out[nearest[stands]] = y[stands]
    return out


def root_mean_square(t: np.ndarray, omega: np.ndarray, grid: np.ndarray, dt: float) -> np.ndarray:
    """Rotor speeds on a grid, each the root mean square over the sample that follows."""
    held = np.minimum(np.searchsorted(t, grid, side="right") - 1, t.size - 1)
    speeds = omega[held]
    squares = np.vstack([np.zeros(4), np.cumsum(omega[:-1] ** 2 * np.diff(t)[:, None], axis=0)])
    for rotor in range(4):
        impulse = np.diff(np.interp(grid, t, squares[:, rotor]))
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
        f"{text}; {gaps} of up to {1e3 * step.max():.4g} ms: rotor speeds are held over {int(inside.sum())} samples "
        "there, and nothing counts as measured"
    )
