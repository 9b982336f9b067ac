"""The motion of a vehicle: how much each axis is excited, and whether it follows the rotors as the airframe says.

The signs of that response also show where the rotors of an X are, and how they turn.
"""

import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from jaxtyping import Float

from ..airframe import Airframe
from ..excitation import AXES
from ..flight import STATE_NAMES, Flight
from ..logs.sampling import averages
from .pieces import Recording, as_recording

RATE_COLUMNS = tuple(STATE_NAMES.index(name) for name in ("p", "q", "r"))
WEAK = 0.1  # [rad/s], standard deviation of a body rate; less is not excited
_GOOD = 0.3  # [rad/s]
OVER_NOISE = 5.0  # a rate below this many times the gyro's noise is not excited
_ANGLE_COLUMNS = tuple(STATE_NAMES.index(name) for name in ("phi", "theta", "psi"))
_STEP = 0.008  # [s]
_SMOOTH, _SLOW = 3, 63  # samples: differences of these means are the motion between about 2 and 20 Hz
# Motors against gyro [s]: lag and delay of rotors; and the same with clocks that may be shifted either way.
_CAUSAL, _SHIFTED, _WIDE = (0.0, 0.048), (-0.04, 0.06), (-0.08, 0.08)
# Motors are late or early beyond these delays [s]; rotors that were measured act at once.
_LATE, _EARLY, _SEEN = -0.005, 0.02, 0.6
_LEAST_SECONDS = 3.0
_OPPOSITE, _CLEAR = 0.4, 1.5  # correlation, and by how much it exceeds that of another sign or pair of rotors
# The same before a sign of the airframe is called wrong, by axis. A controller turns the sign at negative shifts.
_WRONG = {"roll": (0.7, 1.2), "pitch": (0.7, 1.2), "yaw": (0.5, 1.5)}
_LEAST_TORQUE = 0.005  # of all the torque of the rotors in hover
# Two rotors against the other two: the three ways are roll, pitch and yaw of an X, in an order that depends on the log.
_PAIRS = np.array([[1.0, 1.0, -1.0, -1.0], [1.0, -1.0, 1.0, -1.0], [1.0, -1.0, -1.0, 1.0]])

Signs = tuple[float, ...]


class Excitation(msgspec.Struct, frozen=True):
    """How much a flight excites one axis. `None`: not known.

    - `torque`: standard deviation of the rotors' torque [N m]; it needs an airframe.
    - `rate`: standard deviation of the body rate [rad/s].
    - `noise`: standard deviation of the gyro's white noise [rad/s], see `white_noise`.
    - `verdict`: "good", "weak", "none" or "not measured".
    """

    torque: float | None
    rate: float | None
    noise: float | None
    verdict: str


def excitation(flight: Flight | Recording, airframe: Airframe | None = None) -> dict[str, Excitation]:
    """The excitation of roll, pitch and yaw over the whole flight. Without a rate, it is the slope of the angle."""
    recording, found = as_recording(flight), {}
    torque = np.full(3, math.nan)
    if airframe is not None:
        mixer = np.asarray(airframe.mixer, dtype=float)[:3]
        torque = (recording.omega[:-1] ** 2 @ mixer.T).std(axis=0)
    for i, axis in enumerate(AXES):
        rate, angle = recording.states[:, RATE_COLUMNS[i]], recording.states[:, _ANGLE_COLUMNS[i]]
        noise = white_noise(rate, 2)
        if np.count_nonzero(np.isfinite(rate)) < 3:
            seen = np.isfinite(angle)
            measured = np.count_nonzero(seen) > 2
            rate = np.gradient(angle[seen], recording.time[seen]) if measured else np.full(1, math.nan)
        size = float(np.nanstd(rate)) if np.isfinite(rate).any() else math.nan
        verdict = "good" if size >= _GOOD else "weak"
        if math.isnan(size):
            verdict = "not measured"
        elif size < WEAK or size < OVER_NOISE * noise:
            verdict = "none"
        known = [x if math.isfinite(x) else None for x in (float(torque[i]), size, noise)]
        found[axis] = Excitation(known[0], known[1], known[2], verdict)
    return found


def white_noise(values: Float[np.ndarray, " samples"], order: int) -> float:
    """The standard deviation of white noise, from the median size of differences of this order; NaN without any.

    Motion is smooth from sample to sample, noise is not. A higher order tolerates faster motion. Jumps between
    stretches, and of angles by a turn, do not count.
    """
    size = np.diff(values, order)
    size = np.abs(size[np.isfinite(size)])
    return float(np.median(size)) / 0.6745 / math.sqrt(math.comb(2 * order, order)) if size.size else math.nan


def opposite_axes(pieces: Sequence[Recording], airframe: Airframe) -> dict[str, float]:
    """The axes about which the vehicle turns against the torque that the airframe gives to its rotors.

    For each, the correlation of torque and angular acceleration with the opposite sign. Axes without clear motion and
    torque are not judged. The clocks of motors and gyro may be shifted.

    **Arguments:** usable stretches of flights, each of one vehicle.
    """
    _, found = _torque_correlations(pieces, airframe, _SHIFTED)
    ends = zip(_WRONG.items(), -found.min(axis=0), found.max(axis=0), strict=True)
    return {axis: float(wrong) for (axis, (least, times)), wrong, right in ends if wrong > max(least, times * right)}


def refused_note(axes: Mapping[str, float]) -> str:
    """The fault and the remedy, if the vehicle rolls or pitches against the torque; else empty."""
    named = [axis for axis in axes if axis != "yaw"]
    if not named:
        return ""
    verb = "answers" if len(named) == 1 else "answer"
    return (
        f"{' and '.join(named)} {verb} the rotors with the opposite sign: the rotors of the log are in another order "
        "than `rotor_positions` and `rotor_spins` of the airframe, or the gyro has other axes than x forward, y left, "
        "z up (with z down, q and r have the opposite sign); correct one of them"
    )


def yaw_doubt(axes: Mapping[str, float]) -> tuple[str, str, str] | None:
    """Cause, size and remedy, if the vehicle seems to yaw against the torque."""
    if "yaw" not in axes:
        return None
    return (
        "yaw answers the rotors with the opposite sign",
        f"torque and angular acceleration correlate by {-axes['yaw']:.2f}",
        "the rotors may turn the other way than `rotor_spins` of the airframe say (props in or out): change "
        "all four signs",
    )


def rotor_signs(pieces: Sequence[Recording]) -> tuple[Signs, Signs, Signs | None] | None:
    """The places and spins of four rotors in an X, by how the vehicle turns after each pair of rotors speeds up.

    **Arguments:** usable stretches of flights, each of one vehicle, with motors and gyro logged fast.

    **Returns:** the signs of the rotors' x (forward) and y (left), and their spins (+1: counter-clockwise seen from
    above; `None`: the vehicle hardly yawed). `None`: the flight does not show it, or the rotors are no X.
    """
    _, found = _correlations(pieces, _PAIRS, _CAUSAL)
    roll, pitch = (_pair(found[:, :, axis]) for axis in (0, 1))
    if roll is None or pitch is None or roll == pitch:
        return None
    (yaw,) = {0, 1, 2} - {roll, pitch}
    left = _clear_sign(found[:, roll, 0]) * _PAIRS[roll]
    forward = -_clear_sign(found[:, pitch, 1]) * _PAIRS[pitch]
    turn = _clear_sign(found[:, yaw, 2])
    spins = tuple((-turn * _PAIRS[yaw]).tolist()) if turn else None
    return tuple(forward.tolist()), tuple(left.tolist()), spins


def motor_clock_note(pieces: Sequence[Recording], airframe: Airframe) -> str:
    """By how much motors are recorded late or early against the gyro, if roll and pitch show it clearly; else empty.

    Commands precede the motion by an unknown lag of the rotors: they are never called early, and late by at least the
    answer.
    """
    delays, found = _torque_correlations(pieces, airframe, _WIDE)
    peaks = []
    for row in found[:, :2].T:
        best = int(np.argmax(row)) if np.isfinite(row).all() else 0
        if 0 < best < row.size - 1 and row[best] > _SEEN and row[best] > -row.min():
            before, at, after = row[best - 1 : best + 2]
            between = 0.5 * (before - after) / (before - 2 * at + after)
            # Accelerations are those of the end of a sample, torques those of its middle.
            peaks.append(delays[best] + (between + 0.5) * (delays[1] - delays[0]))
    if not peaks:
        return ""
    if max(peaks) < _LATE:
        least = "at least " if pieces[0].commanded else "about "
        return f"motors are recorded {least}{-1e3 * np.mean(peaks):.0f} ms late, or the gyro early (term `delay`)"
    if min(peaks) > _EARLY and not pieces[0].commanded:
        return f"motors are recorded about {1e3 * np.mean(peaks):.0f} ms early, or the gyro late (term `delay`)"
    return ""


def _torque_correlations(
    pieces: Sequence[Recording], airframe: Airframe, between: tuple[float, float]
) -> tuple[Float[np.ndarray, " delays"], Float[np.ndarray, "delays 3"]]:
    """How the torque about each axis correlates with its angular acceleration, by delay [s]. NaN: too little torque."""
    mixer = np.asarray(airframe.mixer, dtype=float)[:3]
    delays, found = _correlations(pieces, mixer, between)
    hover = float(airframe.hover_speed) ** 2 * np.abs(mixer).sum(axis=1)
    torques = [(piece.omega[:-1] ** 2 @ mixer.T).std(axis=0) for piece in pieces]
    weak = np.max(torques, axis=0, initial=0.0) < _LEAST_TORQUE * hover
    return delays, np.where(weak, np.nan, np.diagonal(found, axis1=1, axis2=2))


def _correlations(
    pieces: Sequence[Recording], mixer: Float[np.ndarray, "rows 4"], between: tuple[float, float]
) -> tuple[Float[np.ndarray, " delays"], Float[np.ndarray, "delays rows 3"]]:
    """How sums of squared rotor speeds correlate with the angular accelerations that follow them, at 2 to 20 Hz.

    A controller that answers gusts does not change the sign. One number for each delay, each row of `mixer` (the weight
    of each rotor), and roll, pitch and yaw. NaN: the axis has no clear motion. Also the delays [s].

    **Arguments:** `between`: the first and the last delay of the gyro after the motors [s].
    """
    step = max([_STEP, *(piece.dt for piece in pieces)])
    pieces = [piece for piece in pieces if np.ptp(piece.time) > 2 * _SLOW * step]
    pairs = [_response(piece, mixer, step) for piece in pieces]
    shifts = range(round(between[0] / step), round(between[1] / step) + 1)
    found = np.full((len(shifts), mixer.shape[0], len(AXES)), np.nan)
    for place, shift in enumerate(shifts if pairs else ()):
        early, late = max(-shift, 0), max(shift, 0)
        torque = np.concatenate([a[early : max(a.shape[0] - late, 0)] for a, _ in pairs])
        acceleration = np.concatenate([b[late : max(b.shape[0] - early, 0)] for _, b in pairs])
        for i, along in enumerate(acceleration.T):
            measured = np.isfinite(torque).all(axis=1) & np.isfinite(along)
            if np.count_nonzero(measured) * step < _LEAST_SECONDS:
                continue
            x, y = torque[measured] - torque[measured].mean(axis=0), along[measured] - along[measured].mean()
            spreads = x.std(axis=0) * y.std()
            found[place, :, i] = np.where(spreads > 0, y @ x / y.size, np.nan) / np.where(spreads > 0, spreads, 1.0)
    return step * np.array(shifts), found


def _clear_sign(found: Float[np.ndarray, " delays"]) -> float:
    """The sign of correlations at several delays, if it is clear; 0 if not."""
    for sign in (1.0, -1.0):
        if (sign * found).max() > max(_OPPOSITE, _CLEAR * (-sign * found).max()):
            return sign
    return 0.0


def _pair(found: np.ndarray) -> int | None:
    """The row of `_PAIRS` that turns the vehicle about an axis, if one of them does clearly."""
    sizes = np.abs(found).max(axis=0)
    best = int(np.argmax(sizes))
    alone = sizes[best] > _CLEAR * np.delete(sizes, best).max()  # False for NaN
    return best if alone and _clear_sign(found[:, best]) else None


def _response(piece: Recording, mixer: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Torques and angular accelerations [rad/s^2], one sample every `step` [s], between about 2 and 20 Hz."""
    _, omega, rates = averages(piece.time, piece.omega, piece.states[:, RATE_COLUMNS], held=piece.held)(step)
    acceleration = np.diff(rates, axis=0) / step
    for i, axis in enumerate(excitation(piece).values()):
        if axis.verdict not in ("good", "weak"):
            acceleration[:, i] = np.nan
    return _between((omega**2 @ mixer.T)[:-1]), _between(acceleration)


def _between(columns: Float[np.ndarray, "samples columns"]) -> Float[np.ndarray, "shorter columns"]:
    """The part of each signal between about 2 and 20 Hz."""
    edge = (_SLOW - _SMOOTH) // 2
    fast, slow = (
        np.column_stack([np.convolve(x, np.full(samples, 1 / samples), "valid") for x in columns.T])
        for samples in (_SMOOTH, _SLOW)
    )
    return fast[edge : fast.shape[0] - edge] - slow
