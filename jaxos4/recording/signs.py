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

    The torque is compared with the angular acceleration that follows it, at 2 to 20 Hz. A controller that answers gusts
    does not change the sign. Axes without clear motion are not judged.

    **Arguments:** usable stretches of flights, each of one vehicle.
    """
    judged = [flight for flight in flights if np.ptp(np.asarray(flight.time)) > _SLOW * _STEP * 2]
    pairs: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in _AXES]
    for flight in judged:
        torque, acceleration = _response(flight, airframe)
        for i, axis in enumerate(excitation(flight)):
            if axis.verdict in ("good", "weak"):
                pairs[i].append((torque[:, i], acceleration[:, i]))
    return [axis for axis, found in zip(_AXES, pairs, strict=True) if found and _is_opposite(found)]


def opposite_note(axes: Sequence[str]) -> str:
    """What is wrong if the vehicle turns against the torque about these axes, and what to do."""
    if not axes:
        return ""
    if list(axes) == ["yaw"]:
        return (
            "yaw answers the rotors with the opposite sign: the rotors turn the other way than `rotor_spins` of the "
            "airframe say (props in or out); change all four signs"
        )
    return (
        f"{' and '.join(axes)} answer the rotors with the opposite sign: `rotor_positions` and `rotor_spins` of the "
        "airframe are not in the order of the log; correct them"
    )


def _response(flight: Flight, airframe: Airframe) -> tuple[np.ndarray, np.ndarray]:
    """Torque [N m] and angular acceleration [rad/s^2] about the three axes, one sample every 8 ms."""
    time, omega, states = (np.asarray(x, dtype=float) for x in (flight.time, flight.omega, flight.states))
    step = max(_STEP, float(flight.dt))
    _, omega, rates = average(time, omega, states[:, RATE_COLUMNS], step)
    torque = (omega**2 @ np.asarray(airframe.mixer, dtype=float).T)[:-1, :3]
    return torque, np.diff(rates, axis=0) / step


def _is_opposite(pairs: list[tuple[np.ndarray, np.ndarray]]) -> bool:
    found = []
    for delay in range(_DELAYS):
        torque, acceleration = (
            np.concatenate([_between(x) for x in each])
            for each in zip(*((a[: a.size - delay], b[delay:]) for a, b in pairs), strict=True)
        )
        measured = np.isfinite(torque) & np.isfinite(acceleration)
        if np.count_nonzero(measured) * _STEP < _LEAST_SECONDS:
            return False
        spreads = torque[measured].std() * acceleration[measured].std()
        if spreads <= 0:
            return False
        centred = torque[measured] - torque[measured].mean()
        found.append(float((centred * acceleration[measured]).mean() / spreads))
    return min(found) < -_OPPOSITE and -min(found) > _CLEAR * max(found)


def _between(column: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " shorter"]:
    """The part of a signal between about 2 and 20 Hz."""
    edge = (_SLOW - _SMOOTH) // 2
    smooth, slow = (np.convolve(column, np.full(n, 1 / n), "valid") for n in (_SMOOTH, _SLOW))
    return smooth[edge : smooth.size - edge] - slow
