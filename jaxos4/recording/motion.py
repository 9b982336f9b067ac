"""The motion of a vehicle: how much each axis is excited, whether and how it follows the rotors, its velocity."""

import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from jaxtyping import Float, Int

from ..airframe import GRAVITY, MOTIONS, Airframe
from ..flight import ANGLES, RATES, VELOCITY, Flight, filled
from ..logs import Recording, as_recording
from ..logs.sampling import averages
from ..rotations import rotations_to_body
from .sensor_errors import Ups, white_noise

# Two rotors against the other two: the three ways are roll, pitch and yaw of an X, in an order that depends on the log.
PAIRS = np.array([[1.0, 1.0, -1.0, -1.0], [1.0, -1.0, 1.0, -1.0], [1.0, -1.0, -1.0, 1.0]])

Signs = tuple[float, ...]
Vectors = Float[np.ndarray, "samples 3"]

# An axis is excited weakly or well from these standard deviations of its rate on [rad/s], and weakly only if they
# exceed this many times the gyro's noise.
WEAK, GOOD, OVER_NOISE = 0.1, 0.3, 5.0
# Delays of the gyro after the motors [s] in which the response is looked for. In motion of one frequency, half a period
# more would turn the sign.
COMMANDED = 0.0, 0.048  # lag and delay of rotors
MEASURED = 0.0, 0.016  # the same for measured speeds, which have no lag
SHIFTED = -0.04, 0.06  # the same as `COMMANDED` with clocks that may be shifted either way
TOGETHER = 0.016  # s; the difference of the delays of roll, pitch and yaw, which are measured by one clock
OPPOSITE = 0.4  # the least correlation that shows a sign or a pair of rotors
CLEAR = 1.5  # times the correlation of another sign or pair
# The same before a sign of the airframe is called wrong, by axis. A controller turns the sign at negative shifts.
WRONG = (0.7, 1.2), (0.7, 1.2), (0.5, 1.5)
MIN_TORQUE = 0.005  # share of all the torque of the rotors in hover
STEP = 0.008  # s; of the samples
SMOOTH, SLOW = 3, 63  # samples; differences of means over them are the motion between about 2 and 20 Hz
MIN_SECONDS = 3.0  # of flight


class Excitation(msgspec.Struct, frozen=True):
    """The excitation of one axis by a flight. `None`: not known.

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
    for i, axis in enumerate(MOTIONS):
        rate, angle = recording.states[:, RATES[i]], recording.states[:, ANGLES[i]]
        noise = white_noise(rate, 2)
        if np.count_nonzero(np.isfinite(rate)) < 3:
            seen = np.isfinite(angle)
            measured = np.count_nonzero(seen) > 2
            rate = np.gradient(angle[seen], recording.time[seen]) if measured else np.full(1, math.nan)
        size = float(np.nanstd(rate)) if np.isfinite(rate).any() else math.nan
        verdict = "good" if size >= GOOD else "weak"
        if math.isnan(size):
            verdict = "not measured"
        elif size < max(WEAK, OVER_NOISE * noise):
            verdict = "none"
        known = [x if math.isfinite(x) else None for x in (float(torque[i]), size, noise)]
        found[axis] = Excitation(known[0], known[1], known[2], verdict)
    return found


def opposite_axes(flown: Sequence[Recording], airframe: Airframe) -> dict[str, float]:
    """The axes about which vehicles turn against the torque that the airframe gives to the rotors, in usable stretches.

    For each, the correlation of torque and angular acceleration with the opposite sign. Axes without clear motion and
    torque are not judged. The clocks of motors and gyro may be shifted.
    """
    mixer = np.asarray(airframe.mixer, dtype=float)[:3]
    found = np.diagonal(_correlations(flown, mixer, SHIFTED), axis1=1, axis2=2).copy()
    right = np.nan_to_num(found[:, :2]).max(axis=1)
    if right.max() > WRONG[0][0]:
        delays = np.linspace(*SHIFTED, len(found))
        found[np.abs(delays - delays[np.argmax(right)]) > 1.01 * TOGETHER, 2] = np.nan
    hover = float(airframe.hover_speed) ** 2 * np.abs(mixer).sum(axis=1)
    torques = [(each.omega[:-1] ** 2 @ mixer.T).std(axis=0) for each in flown]
    found = np.where(np.max(torques, axis=0, initial=0.0) < MIN_TORQUE * hover, np.nan, found)
    least = np.where(np.isnan(found), np.inf, found).min(axis=0, initial=np.inf)
    most = np.where(np.isnan(found), -np.inf, found).max(axis=0, initial=-np.inf)
    ends = zip(MOTIONS, WRONG, -least, most, strict=True)
    return {axis: float(wrong) for axis, (least, times), wrong, right in ends if wrong > max(least, times * right)}


def refused_note(axes: Mapping[str, float]) -> str:
    """The fault and the remedy, if the vehicle rolls or pitches against the torque; else empty."""
    named = [axis for axis in axes if axis != "yaw"]
    if not named:
        return ""
    return (
        f"{' and '.join(named)} {'answers' if len(named) == 1 else 'answer'} the rotors with the opposite sign: the "
        "rotors of the log are in another order than `rotor_positions` and `rotor_spins` of the airframe, or the gyro "
        "has other axes than x forward, y left, z up (with z down, q and r have the opposite sign); correct one of them"
    )


def rotor_signs(flown: Sequence[Recording]) -> tuple[Signs, Signs, Signs | None] | None:
    """The places and spins of four rotors in an X, by how the vehicle turns after each pair of rotors speeds up.

    **Returns:** the signs of the rotors' x (forward) and y (left), and their spins (+1: counter-clockwise seen from
    above; `None`: the vehicle hardly yawed). `None`: the flight does not show it, or the rotors are no X.
    """
    commanded = any(each.commanded for each in flown)
    found = _correlations(flown, PAIRS, COMMANDED if commanded else MEASURED)
    roll, pitch = (_pair(found[:, :, axis]) for axis in (0, 1))
    if roll is None or pitch is None or roll == pitch:
        return None
    (yaw,) = {0, 1, 2} - {roll, pitch}
    left = _clear_sign(found[:, roll, 0]) * PAIRS[roll]
    forward = -_clear_sign(found[:, pitch, 1]) * PAIRS[pitch]
    turn = _clear_sign(found[:, yaw, 2])
    spins = tuple((-turn * PAIRS[yaw]).tolist()) if turn else None
    return tuple(forward.tolist()), tuple(left.tolist()), spins


def _correlations(
    flown: Sequence[Recording], mixer: Float[np.ndarray, "rows 4"], between: tuple[float, float]
) -> Float[np.ndarray, "delays rows 3"]:
    """Correlations of sums of squared rotor speeds with the angular accelerations after them, at 2 to 20 Hz.

    By delay of the gyro, `between` two [s], by row of `mixer`, and by axis; NaN: no clear motion. A controller that
    answers gusts does not change the sign.
    """
    step = max([STEP, *(each.dt for each in flown)])
    pairs = [_response(each, mixer, step) for each in flown if np.ptp(each.time) > 2 * SLOW * step]
    shifts = range(round(between[0] / step), round(between[1] / step) + 1)
    found = np.full((len(shifts), mixer.shape[0], len(MOTIONS)), np.nan)
    for place, shift in enumerate(shifts if pairs else ()):
        early, late = max(-shift, 0), max(shift, 0)
        torque = np.concatenate([a[early : max(a.shape[0] - late, 0)] for a, _ in pairs])
        acceleration = np.concatenate([b[late : max(b.shape[0] - early, 0)] for _, b in pairs])
        for i, along in enumerate(acceleration.T):
            measured = np.isfinite(torque).all(axis=1) & np.isfinite(along)
            if np.count_nonzero(measured) * step < MIN_SECONDS:
                continue
            x, y = torque[measured] - torque[measured].mean(axis=0), along[measured] - along[measured].mean()
            spreads = x.std(axis=0) * y.std()
            found[place, :, i] = np.where(spreads > 0, y @ x / y.size, np.nan) / np.where(spreads > 0, spreads, 1.0)
    return found


def _clear_sign(found: Float[np.ndarray, " delays"]) -> float:
    """The sign of correlations at several delays, if it is clear; 0 if not."""
    for sign in (1.0, -1.0):
        if (sign * found).max() > max(OPPOSITE, CLEAR * (-sign * found).max()):
            return sign
    return 0.0


def _pair(found: Float[np.ndarray, "delays pairs"]) -> int | None:
    """The row of `PAIRS` that turns the vehicle about an axis, if one of them does clearly."""
    sizes = np.abs(found).max(axis=0)
    best = int(np.argmax(sizes))
    alone = sizes[best] > CLEAR * np.delete(sizes, best).max()  # False for NaN
    return best if alone and _clear_sign(found[:, best]) else None


def _response(flown: Recording, mixer: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Torques and angular accelerations [rad/s^2], one sample every `step` [s], between about 2 and 20 Hz."""
    _, omega, rates = averages(flown.time, flown.omega, flown.states[:, RATES], held=flown.held)(step)
    acceleration = np.diff(rates, axis=0) / step
    for i, axis in enumerate(excitation(flown).values()):
        if axis.verdict not in ("good", "weak"):
            acceleration[:, i] = np.nan

    def between(columns: np.ndarray) -> np.ndarray:
        edge = (SLOW - SMOOTH) // 2
        fast, slow = (
            np.column_stack([np.convolve(x, np.full(samples, 1 / samples), "valid") for x in columns.T])
            for samples in (SMOOTH, SLOW)
        )
        return fast[edge : fast.shape[0] - edge] - slow

    return between((omega**2 @ mixer.T)[:-1]), between(acceleration)


# s; time constants with which the upright direction is drawn to the specific force. The first forgets errors of the
# gyro sooner, the second holds in longer turns.
LEVELS = 2.0, 8.0
# s; dead reckoning forgets its velocity with these time constants. Where motion along z has a period of a few seconds,
# what is forgotten in 2 s looks like thrust: z_drag is 17 % too large. Without attitude, 20 s sum up too many errors.
FORGETS, FORGETS_WITHOUT_ATTITUDE = 20.0, 2.0


def velocity_of(recording: Recording, *, forgets: float | None = None) -> tuple[Vectors, Ups] | None:
    """The motion of a vehicle through still air; `None` if the log does not say enough.

    A velocity that was not measured follows from gyro and accelerometer: v' = force - g up - rates x v. Slow errors of
    this sum, and slow changes of the velocity, are forgotten; torque and thrust answer faster ones.

    **Arguments:**

    - `recording`: of one stretch.
    - `forgets`: the time constant with which dead reckoning forgets its velocity [s]. By default 20 s, or 2 s without
      attitude.

    **Returns:** the velocity along the body's axes [m/s], and the upright direction in these axes by each time
    constant. Both are the same if the attitude was measured.
    """
    angles, velocity = (_gapless(recording, columns) for columns in (ANGLES, VELOCITY))
    to_body = None if angles is None else rotations_to_body(angles)
    if to_body is not None and velocity is not None:
        return np.einsum("tij,tj->ti", to_body, velocity), (to_body[:, :, 2], to_body[:, :, 2])
    rates, force = _gapless(recording, RATES), recording.specific_force
    if rates is None or force is None or np.isnan(force).all(axis=0).any():
        return None
    force = filled(force)
    if to_body is None:
        up, slow = (_upright(rates, force, recording.dt, level) for level in LEVELS)
    else:
        up = slow = to_body[:, :, 2]
    forgets = forgets or (FORGETS_WITHOUT_ATTITUDE if to_body is None else FORGETS)
    return _dead_reckoned(rates, force, up, recording.dt, forgets), (up, slow)


def measures_velocity(recording: Recording) -> bool:
    """Whether a recording has a velocity, and the attitude that turns it into the body's axes."""
    return _gapless(recording, np.append(ANGLES, VELOCITY)) is not None


def _gapless(recording: Recording, columns: Int[np.ndarray, " columns"]) -> Float[np.ndarray, "samples columns"] | None:
    """Some states, each gap filled with the value before it; `None` if one was not measured."""
    values = recording.states[:, columns]
    return None if np.isnan(values).all(axis=0).any() else filled(values)


def in_body_axes(recording: Recording, airframe: Airframe | None) -> Recording:
    """The recording with rates and specific force along the body's axes, for sensors that are mounted at an angle."""
    if airframe is None or not np.any(airframe.sensor_rotation):
        return recording
    axes = np.asarray(airframe.sensor_axes)
    axes = np.where(np.abs(axes) < 1e-12, 0.0, axes)  # of right angles

    def turned(measured: Vectors) -> Vectors:
        # A channel that was not measured is missing along the axes to which it contributes, and not along others.
        return np.column_stack([measured[:, row != 0] @ row[row != 0] for row in axes])

    states, force = recording.states.copy(), recording.specific_force
    states[:, RATES] = turned(states[:, RATES])
    return recording._replace(states=states, specific_force=None if force is None else turned(force))


def _dead_reckoned(rates: Vectors, force: Vectors, up: Vectors, dt: float, forgets: float) -> Vectors:
    """The velocity by measurements until each sample. Plain numbers in a loop are ten times faster than arrays."""
    push = force - GRAVITY * up
    push -= (push * up).sum(axis=1).mean() * up  # a flight does not climb for ever
    kept, (vx, vy, vz), velocities = math.exp(-dt / forgets), (0.0, 0.0, 0.0), []
    for (p, q, r), (ax, ay, az) in zip(rates.tolist(), push.tolist(), strict=True):
        velocities.append((vx, vy, vz))
        vx, vy, vz = (
            kept * (vx + dt * (ax - q * vz + r * vy)),
            kept * (vy + dt * (ay - r * vx + p * vz)),
            kept * (vz + dt * (az - p * vy + q * vx)),
        )
    return np.array(velocities)


def _upright(rates: Vectors, force: Vectors, dt: float, level: float) -> Vectors:
    """The upright direction: fixed in the earth, and drawn to the specific force with the time constant `level` [s]."""
    x, y, z, turn, directions = 0.0, 0.0, 1.0, dt / level, []
    drawn = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-3)
    for (p, q, r), (ax, ay, az) in zip(rates.tolist(), drawn.tolist(), strict=True):
        directions.append((x, y, z))
        x, y, z = (
            x + dt * (y * r - z * q) + turn * (ax - x),
            y + dt * (z * p - x * r) + turn * (ay - y),
            z + dt * (x * q - y * p) + turn * (az - z),
        )
        length = math.sqrt(x * x + y * y + z * z) or 1.0
        x, y, z = x / length, y / length, z / length
    return np.array(directions)
