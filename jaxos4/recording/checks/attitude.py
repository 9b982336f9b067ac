"""The attitude against the integrated gyro: how much, about which axes and how late it turns."""

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Float

from ...flight import ANGLES, RATES
from ..pieces import Recording
from .finding import Measured

# The turns within `_SPAN` are compared, one each `_STEP`; gaps in the angles up to `_GAP` are interpolated [s].
_STEP, _SPAN, _GAP = 0.01, 0.1, 0.15
_SHIFTS = np.arange(-50, 51)  # of the attitude after the gyro, in steps
_BLOCKS, _FEWEST_BLOCKS, _BLOCK = 12, 4, 1.0  # of the jackknife: how many, how few, and how short [s]


class Turns(msgspec.Struct, frozen=True):
    """The turns of the attitude: `matrix` times the turns of the gyro, `delay` later.

    - `matrix`: the identity if both agree. Rows are roll, pitch and yaw of the attitude; columns those of the gyro.
    - `delay`: [s].
    - `explained`: by axis of the attitude, the share of its turns that the gyro explains.
    """

    matrix: Measured
    delay: Measured
    explained: Float[np.ndarray, "3"]


def attitude_turns(pieces: Sequence[Recording]) -> Turns | None:
    """Compare attitude and gyro in pieces of a flight. `None`: one of them was not measured, or the flight is short."""
    pairs = _every(pieces)
    samples = sum(len(angle) for angle, _ in pairs)
    length = max(samples // _BLOCKS, round(_BLOCK / _STEP))
    sums = [block for angle, gyro in pairs for block in _sums(angle, gyro, length)]
    if len(sums) < _FEWEST_BLOCKS:
        return None
    blocks = np.array(sums)
    matrix, delay, explained = _fit(blocks.sum(axis=0))
    every = [_fit(blocks.sum(axis=0) - block)[:2] for block in blocks]
    matrices, delays = (np.array(each) for each in zip(*every, strict=True))
    return Turns(Measured.of(matrix, matrices), Measured.of(np.asarray(delay), delays), explained)


def scaled_angles(pieces: Sequence[Recording], turns: Turns) -> float:
    """Whether the angles are too large, and not the rates too small, by how rotations about several axes add up.

    The rates of a tilted vehicle follow from its angles by a formula that holds for the true angles only.

    **Returns:** how much better the gyro agrees with the scaled angles than with the scaled rates, in standard errors;
    negative: worse. 0: unknown.
    """
    scale = np.diagonal(turns.matrix.value)
    if (scale <= 0).any():
        return 0.0
    better, shift = [], round(float(turns.delay.value) / _STEP)
    for (as_logged, gyro), (scaled, _) in zip(_every(pieces), _every(pieces, scale), strict=True):
        first, last = max(shift, 0), len(gyro) + min(shift, 0)
        gyro = gyro[first - shift : last - shift]
        errors = [np.square(x[first:last] - gyro).sum(axis=1) for x in (as_logged / scale, scaled)]
        gain = errors[0] - errors[1]
        gain = gain[np.isfinite(gain)]
        better += [block.sum() for block in np.array_split(gain, max(gain.size * _STEP // (2 * _BLOCK), 1))]
    if len(better) < _FEWEST_BLOCKS or not np.std(better):
        return 0.0
    return float(np.mean(better) / np.std(better, ddof=1) * np.sqrt(len(better)))


def _every(pieces: Sequence[Recording], scale: np.ndarray | None = None) -> list[tuple[np.ndarray, np.ndarray]]:
    """The turns of attitude and gyro in each piece that is long enough; angles are divided by `scale` before."""
    divided = np.ones(3) if scale is None else scale
    return [pair for piece in pieces if (pair := _turned(piece, divided)) is not None]


def _turned(piece: Recording, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """How far attitude and gyro turn about the axes of the body within `_SPAN` [rad]; NaN in gaps."""
    angles, rates = piece.states[:, ANGLES], piece.states[:, RATES]
    late, fewest = round(_SPAN / _STEP), min(np.isfinite(x).sum(axis=0).min() for x in (angles, rates))
    if fewest < 2 or piece.dt > _SPAN or np.ptp(piece.time) < 4 * _SPAN:
        return None
    grid = np.arange(piece.time[0], piece.time[-1], _STEP)
    angles = np.column_stack([interpolated(grid, piece.time, column, turns=True) for column in angles.T]) / scale
    total = np.column_stack([interpolated(grid, *_integral(piece.time, column)) for column in rates.T])
    (roll, pitch, _), (d_roll, d_pitch, d_yaw) = angles[late // 2 : -late // 2].T, (angles[late:] - angles[:-late]).T
    sin, cos = np.sin(roll), np.cos(roll)
    about = (
        d_roll - d_yaw * np.sin(pitch),
        d_pitch * cos + d_yaw * np.cos(pitch) * sin,
        d_yaw * np.cos(pitch) * cos - d_pitch * sin,
    )
    return np.column_stack(about), total[late:] - total[:-late]


def _integral(time: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    known = np.isfinite(rate)
    time, rate = time[known], rate[known]
    return time, np.append(0.0, np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(time)))


def interpolated(
    at: np.ndarray, time: np.ndarray, values: np.ndarray, *, gap: float = _GAP, turns: bool = False
) -> np.ndarray:
    """`values` at other times; NaN where nothing was measured for longer than `gap` [s].

    `turns`: values are angles, and jumps of a whole turn are removed.
    """
    known = np.isfinite(values)
    time, values = time[known], values[known]
    if turns:
        values = np.unwrap(values)
    right = np.clip(np.searchsorted(time, at), 1, time.size - 1)
    inside = (at >= time[0]) & (at <= time[-1]) & (time[right] - time[right - 1] <= gap)
    return np.where(inside, np.interp(at, time, values), np.nan)


def _sums(angle: np.ndarray, gyro: np.ndarray, length: int) -> list[np.ndarray]:
    """Products of the turns in each block of so many samples, for each shift: (shifts, gyro and angle, gyro and angle).

    Constant errors of the gyro are subtracted.
    """
    known = [np.asarray(np.isfinite(each).all(axis=1)) for each in (gyro, angle)]
    if min(each.sum() for each in known) < length:
        return []
    gyro, angle = (np.where(k[:, None], x - x[k].mean(axis=0), 0.0) for k, x in zip(known, (gyro, angle), strict=True))
    edge, blocks = int(_SHIFTS[-1]), len(angle) // length
    gyro, gyro_known = np.pad(gyro, ((edge, edge), (0, 0))), np.pad(known[0], edge)
    out = np.empty((blocks, _SHIFTS.size, 6, 6))
    for place, shift in enumerate(_SHIFTS):
        rows = slice(edge - shift, edge - shift + blocks * length)
        both = np.hstack([gyro[rows] * known[1][: blocks * length, None], angle[: blocks * length]])
        both = (both * gyro_known[rows, None]).reshape(blocks, length, 6)
        out[:, place] = np.swapaxes(both, 1, 2) @ both
    return list(out)


def _fit(products: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Matrix, delay [s] and explained shares by least squares, at the shift that explains most."""
    gyro, cross, angle = products[:, :3, :3], products[:, :3, 3:], products[:, 3:, 3:]
    size = np.trace(gyro, axis1=1, axis2=2)[:, None, None]
    matrices = np.linalg.solve(gyro + (1e-9 * size + 1e-300) * np.eye(3), cross)
    explained, total = np.einsum("sij,sij->sj", matrices, cross), np.einsum("sii->si", angle)
    share = explained.sum(axis=1) / np.maximum(total.sum(axis=1), 1e-300)
    best = int(np.clip(np.argmax(share), 1, share.size - 2))
    return (
        matrices[best].T,
        (_SHIFTS[best] + peak(share, best)) * _STEP,
        explained[best] / np.maximum(total[best], 1e-300),
    )


def peak(values: np.ndarray, best: int) -> float:
    """How far the maximum lies after the largest value, in steps: the vertex of the parabola through three values."""
    before, at, after = values[best - 1 : best + 2]
    bend = before - 2 * at + after
    return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend < 0 else 0.0
