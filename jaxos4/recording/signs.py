"""Whether a vehicle turns the way that its airframe says: a check of the rotors' order, positions and spins."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..airframe import Airframe
from ..flight import Flight
from .averaging import average
from .excited import RATE_COLUMNS, excitation

_STEP = 0.008  # [s]
_SMOOTH, _SLOW = 3, 63  # samples: differences of these means are the motion between about 2 and 20 Hz
_DELAYS = 7  # samples, up to 48 ms: lag and delay of rotors
_LEAST_SECONDS = 3.0
_OPPOSITE, _CLEAR = 0.4, 1.5  # correlation, and by how much it exceeds that of the right sign
_AXES = ("roll", "pitch", "yaw")


def opposite_axes(flights: Sequence[Flight], airframe: Airframe) -> list[str]:
    """The axes about which the vehicle turns against the torque that the airframe gives to its rotors.

    Axes without clear motion are not judged.

    **Arguments:** usable stretches of flights, each of one vehicle.
    """
    found = correlations(flights, np.asarray(airframe.mixer, dtype=float)[:3])
    return [axis for i, axis in enumerate(_AXES) if clear_sign(found[:, i, i]) < 0]


def opposite_note(axes: Sequence[str]) -> str:
    """What is wrong if the vehicle turns against the torque about these axes, and what to do."""
    if not axes:
        return ""
    if list(axes) == ["yaw"]:
        return (
            "yaw answers the rotors with the opposite sign: the rotors turn the other way than `rotor_spins` of the "
            "airframe say (props in or out); change all four signs"
        )
    verb = "answers" if len(axes) == 1 else "answer"
    return (
        f"{' and '.join(axes)} {verb} the rotors with the opposite sign: the rotors of the log are in another order "
        "than `rotor_positions` and `rotor_spins` of the airframe, or the gyro has other axes than x forward, y left, "
        "z up (with z down, q and r have the opposite sign); correct one of them"
    )


def correlations(flights: Sequence[Flight], mixer: Float[np.ndarray, "rows 4"]) -> Float[np.ndarray, "delays rows 3"]:
    """How sums of squared rotor speeds correlate with the angular accelerations that follow them, at 2 to 20 Hz.

    A controller that answers gusts does not change the sign. One number for each delay of up to 48 ms, each row of
    `mixer` (the weight of each rotor), and roll, pitch and yaw. NaN: the axis has no clear motion.

    **Arguments:** usable stretches of flights, each of one vehicle.
    """
    judged = [flight for flight in flights if np.ptp(np.asarray(flight.time)) > _SLOW * _STEP * 2]
    pairs = [_response(flight, mixer) for flight in judged]
    found = np.full((_DELAYS, mixer.shape[0], len(_AXES)), np.nan)
    for delay in range(_DELAYS if pairs else 0):
        torque = np.concatenate([a[: a.shape[0] - delay] for a, _ in pairs])
        acceleration = np.concatenate([b[delay:] for _, b in pairs])
        for i, along in enumerate(acceleration.T):
            measured = np.isfinite(torque).all(axis=1) & np.isfinite(along)
            if np.count_nonzero(measured) * _STEP < _LEAST_SECONDS:
                continue
            x, y = torque[measured] - torque[measured].mean(axis=0), along[measured] - along[measured].mean()
            spreads = x.std(axis=0) * y.std()
            found[delay, :, i] = np.where(spreads > 0, y @ x / y.size, np.nan) / np.where(spreads > 0, spreads, 1.0)
    return found


def clear_sign(found: Float[np.ndarray, " delays"]) -> float:
    """The sign of correlations at several delays, if it is clear; 0 if not."""
    if np.isnan(found).any():
        return 0.0
    for sign in (1.0, -1.0):
        if max(sign * found) > _OPPOSITE and max(sign * found) > _CLEAR * max(-sign * found):
            return sign
    return 0.0


def _response(flight: Flight, mixer: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Torques and angular accelerations [rad/s^2], one sample every 8 ms, between about 2 and 20 Hz."""
    time, omega, states = (np.asarray(x, dtype=float) for x in (flight.time, flight.omega, flight.states))
    step = max(_STEP, float(flight.dt))
    _, omega, rates = average(time, omega, states[:, RATE_COLUMNS], step)
    acceleration = np.diff(rates, axis=0) / step
    for i, axis in enumerate(excitation(flight)):
        if axis.verdict not in ("good", "weak"):
            acceleration[:, i] = np.nan
    return _between((omega**2 @ mixer.T)[:-1]), _between(acceleration)


def _between(columns: Float[np.ndarray, "samples columns"]) -> Float[np.ndarray, "shorter columns"]:
    """The part of each signal between about 2 and 20 Hz."""
    edge = (_SLOW - _SMOOTH) // 2
    return np.column_stack([_mean(x, _SMOOTH)[edge : x.size - _SMOOTH + 1 - edge] - _mean(x, _SLOW) for x in columns.T])


def _mean(column: np.ndarray, samples: int) -> np.ndarray:
    return np.convolve(column, np.full(samples, 1 / samples), "valid")
