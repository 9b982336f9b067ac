"""Comparisons of quantities that a log measures twice: attitude against gyro, velocity and force against the tilt."""

from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from jaxtyping import Float, Inexact

from ...airframe import GRAVITY
from ...flight import ANGLES, RATES, VELOCITY
from ...logs import Recording
from ...logs.sampling import averages
from ...rotations import rotations_to_body

BATCHES = 12
"""The number of batches of the jackknife."""
# Turns over `_SPAN` [s] are compared every `_STEP` [s]; the attitude may be later than the gyro by `_SHIFTS` steps.
_STEP, _SPAN, _SHIFTS = 0.01, 0.1, np.arange(-50, 51)

Pair = tuple[np.ndarray, np.ndarray]

Measured = Float[np.ndarray, "2 ..."]
"""Numbers that follow from the log, and then their standard errors."""


def jackknife(sums: Inexact[np.ndarray, "batches ..."], fit: Callable[[np.ndarray], np.ndarray]) -> Measured:
    """Fits the sum of all batches. Standard errors follow from fits that leave out one batch at a time."""
    whole = sums.sum(axis=0)
    without = np.array([fit(whole - batch) for batch in sums])
    share = (len(sums) - 1) / len(sums)
    return np.stack([fit(whole), np.sqrt(share * np.square(without - without.mean(axis=0)).sum(axis=0))])


def batched(products: Float[np.ndarray, "samples ..."]) -> Float[np.ndarray, "batches ..."]:
    """The sums of batches of equal size."""
    return np.array([batch.sum(axis=0) for batch in np.array_split(products, BATCHES)])


class Turns(msgspec.Struct, frozen=True):
    """The turns of the attitude: `matrix` times the turns of the gyro, `delay` later.

    - `matrix`: the identity if both agree. Rows are the axes of the attitude, columns the axes of the gyro.
    - `delay`: the delay of the attitude behind the gyro [s]. Both are `Measured`: values, and standard errors.
    - `explained`: by axis of the attitude, the share of its turns that the gyro explains.
    """

    matrix: Float[np.ndarray, "2 3 3"]
    delay: Float[np.ndarray, "2"]
    explained: Float[np.ndarray, "3"]


MIN_BATCHES = 4  # fewest batches of a flight
MIN_BATCH = 0.5  # s; the shortest batch
TILTS = 2.0  # s; the length of a batch in which rotations about several axes are compared


def attitude_turns(stretches: Sequence[Recording]) -> Turns | None:
    """Compare attitude and gyro in stretches of a flight. `None`: one was not measured, or the flight is short."""
    pairs = _turned(stretches)
    samples = sum(len(angle) for angle, _ in pairs)
    length = max(samples // BATCHES, round(MIN_BATCH / _STEP))
    sums = np.array([batch for angle, gyro in pairs for batch in _sums(angle, gyro, length)])
    if len(sums) < MIN_BATCHES:
        return None

    def fit(products: np.ndarray) -> np.ndarray:
        matrix, delay, _ = _fit(products)
        return np.append(matrix, delay)

    found, (_, _, explained) = jackknife(sums, fit), _fit(sums.sum(axis=0))
    return Turns(found[:, :9].reshape(2, 3, 3), found[:, 9], explained)


def scaled_angles(stretches: Sequence[Recording], turns: Turns) -> float:
    """Whether the angles have a wrong scale, and not the rates, from rotations about several axes.

    The rates of a tilted vehicle follow from its angles by a formula that holds for the true angles only.

    **Returns:** how much better the gyro agrees with the scaled angles than with the scaled rates, in standard errors;
    negative if worse, 0 if unknown.
    """
    (matrix, _), (delay, _) = turns.matrix, turns.delay
    scale = np.diagonal(matrix)
    if (scale <= 0).any():
        return 0.0
    better, shift = [], round(float(delay) / _STEP)
    for (as_logged, gyro), (scaled, _) in zip(_turned(stretches), _turned(stretches, scale), strict=True):
        first, last = max(shift, 0), len(gyro) + min(shift, 0)
        gyro = gyro[first - shift : last - shift]
        errors = [np.square(x[first:last] - gyro).sum(axis=1) for x in (as_logged / scale, scaled)]
        gain = errors[0] - errors[1]
        gain = gain[np.isfinite(gain)]
        better += [batch.sum() for batch in np.array_split(gain, max(gain.size * _STEP // TILTS, 1))]
    if len(better) < MIN_BATCHES or not np.std(better):
        return 0.0
    return float(np.mean(better) / np.std(better, ddof=1) * np.sqrt(len(better)))


def _turned(stretches: Sequence[Recording], scale: Float[np.ndarray, "3"] | None = None) -> list[Pair]:
    """The angles by which attitude and gyro turn about the body's axes within `_SPAN` [rad], in each stretch.

    Angles are first divided by `scale`. Gaps are NaN.
    """
    every, late = [], round(_SPAN / _STEP)
    for flown in stretches:
        angles, rates = flown.states[:, ANGLES], flown.states[:, RATES]
        fewest = min(np.isfinite(x).sum(axis=0).min() for x in (angles, rates))
        if fewest < 2 or flown.dt > _SPAN or np.ptp(flown.time) < 4 * _SPAN:
            continue
        grid = np.arange(flown.time[0], flown.time[-1], _STEP)
        angles = np.column_stack([interpolated(grid, flown.time, column, turns=True) for column in angles.T])
        angles = angles if scale is None else angles / scale
        total = np.column_stack([interpolated(grid, *_integral(flown.time, column)) for column in rates.T])
        roll, pitch, _ = angles[late // 2 : -late // 2].T
        d_roll, d_pitch, d_yaw = (angles[late:] - angles[:-late]).T
        sin, cos = np.sin(roll), np.cos(roll)
        about = (
            d_roll - d_yaw * np.sin(pitch),
            d_pitch * cos + d_yaw * np.cos(pitch) * sin,
            d_yaw * np.cos(pitch) * cos - d_pitch * sin,
        )
        every.append((np.column_stack(about), total[late:] - total[:-late]))
    return every


def _integral(time: np.ndarray, rate: np.ndarray) -> Pair:
    known = np.isfinite(rate)
    time, rate = time[known], rate[known]
    return time, np.append(0.0, np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(time)))


def interpolated(
    at: np.ndarray, time: np.ndarray, values: np.ndarray, *, gap: float = 0.15, turns: bool = False
) -> np.ndarray:
    """`values` at other times; NaN where nothing was measured for longer than `gap` [s].

    `turns`: values are angles, and jumps of a whole turn are removed.
    """
    known = np.isfinite(values)
    time, values = time[known], values[known]
    if time.size < 2:
        return np.full(at.shape, np.nan)
    if turns:
        values = np.unwrap(values)
    right = np.clip(np.searchsorted(time, at), 1, time.size - 1)
    inside = (at >= time[0]) & (at <= time[-1]) & (time[right] - time[right - 1] <= gap)
    return np.where(inside, np.interp(at, time, values), np.nan)


def _sums(angle: np.ndarray, gyro: np.ndarray, length: int) -> list[np.ndarray]:
    """Products of the turns in each batch of `length` samples, by shift: (shifts, gyro and angle, gyro and angle).

    Constant errors of the gyro are subtracted.
    """
    known = [np.asarray(np.isfinite(each).all(axis=1)) for each in (gyro, angle)]
    if min(each.sum() for each in known) < length:
        return []
    gyro, angle = (np.where(k[:, None], x - x[k].mean(axis=0), 0.0) for k, x in zip(known, (gyro, angle), strict=True))
    edge, batches = int(_SHIFTS[-1]), len(angle) // length
    gyro, gyro_known = np.pad(gyro, ((edge, edge), (0, 0))), np.pad(known[0], edge)
    out = np.empty((batches, _SHIFTS.size, 6, 6))
    for place, shift in enumerate(_SHIFTS):
        rows = slice(edge - shift, edge - shift + batches * length)
        both = np.hstack([gyro[rows] * known[1][: batches * length, None], angle[: batches * length]])
        both = (both * gyro_known[rows, None]).reshape(batches, length, 6)
        out[:, place] = np.swapaxes(both, 1, 2) @ both
    return list(out)


def _fit(products: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Matrix, delay [s] and explained shares by least squares, at the shift that explains most."""
    gyro, cross, angle = products[:, :3, :3], products[:, :3, 3:], products[:, 3:, 3:]
    size = np.trace(gyro, axis1=1, axis2=2)[:, None, None]
    matrices = np.linalg.solve(gyro + (1e-9 * size + 1e-300) * np.eye(3), cross)
    explained, total = np.einsum("sij,sij->sj", matrices, cross), np.einsum("sii->si", angle)
    best, after = peak(explained.sum(axis=1) / np.maximum(total.sum(axis=1), 1e-300))
    return matrices[best].T, (_SHIFTS[best] + after) * _STEP, explained[best] / np.maximum(total[best], 1e-300)


def peak(values: Float[np.ndarray, " steps"]) -> tuple[int, float]:
    """The index of the largest value, and the offset to the vertex of a parabola through its neighbours, in steps."""
    best = int(np.clip(np.argmax(values), 1, values.size - 2))
    before, at, after = values[best - 1 : best + 2]
    bend = before - 2 * at + after
    return best, float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0 else 0.0


def velocity_slopes(stretches: Sequence[Recording]) -> Measured | None:
    """The horizontal acceleration relative to that from force and attitude, along and across it, or `None`."""

    def vectors(angles: np.ndarray, force: np.ndarray, velocity: np.ndarray, step: float) -> Pair:
        felt = np.einsum("tji,tj->ti", rotations_to_body(angles), force) - [0.0, 0.0, GRAVITY]
        return (felt[1:, :2] + felt[:-1, :2]) / 2, np.diff(velocity[:, :2], axis=0) / step

    return _slopes(stretches, vectors, step=0.2)  # velocities are noisy


def tilt_slopes(stretches: Sequence[Recording]) -> Measured | None:
    """The horizontal force relative to that of a tilted thrust in the earth's axes, along and across it, or `None`.

    If the force is given along the body's axes, the slope is 0 or less.
    """

    def vectors(angles: np.ndarray, force: np.ndarray, velocity: np.ndarray, step: float) -> Pair:
        roll, pitch, yaw = angles.T
        tilt = (
            np.cos(yaw) * np.tan(pitch) + np.sin(yaw) * np.tan(roll) / np.cos(pitch),
            np.sin(yaw) * np.tan(pitch) - np.cos(yaw) * np.tan(roll) / np.cos(pitch),
        )
        return force[:, 2:] * np.column_stack(tilt), force[:, :2]

    return _slopes(stretches, vectors, step=0.1, moving=False)


def _slopes(
    stretches: Sequence[Recording], vectors: Callable[..., Pair], *, step: float, moving: bool = True
) -> Measured | None:
    """Slopes of horizontal vectors along and across reference vectors, from means over `step` [s].

    `vectors`: the reference and the compared vectors, as a function of the means of angles, specific force and velocity
    and of their step [s]. `moving`: whether the velocity is needed.
    """
    every = []
    for flown in stretches:
        states = flown.states[:, [*ANGLES, *VELOCITY]]
        if flown.specific_force is None or not np.isfinite(states[:, : 6 if moving else 3]).any(axis=0).all():
            continue
        own = max(step, flown.dt)
        columns = np.hstack([states[:, :3], flown.specific_force, states[:, 3:]])
        _, _, means = averages(flown.time, flown.omega, columns, held=flown.held)(own)
        given, found = vectors(*np.split(means, 3, axis=1), own)
        known = np.isfinite(given).all(axis=1) & np.isfinite(found).all(axis=1)
        if known.any():
            (x, y), (u, v) = (each[known].T - each[known].mean(axis=0)[:, None] for each in (given, found))
            every.append(np.column_stack([x * u + y * v, x * v - y * u, x * x + y * y]))
    products = np.concatenate([np.empty((0, 3)), *every])
    if len(products) < 4 * BATCHES or products[:, 2].sum() <= 0:
        return None
    return jackknife(batched(products), lambda sums: sums[:2] / sums[2])
