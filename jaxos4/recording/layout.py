"""Where the rotors of an X are, and how they turn, as far as a flight shows it: the signs."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..flight import Flight
from .signs import clear_sign, correlations

# Two rotors against the other two: the three ways are roll, pitch and yaw of an X, in an order that depends on the log.
_PAIRS = np.array([[1.0, 1.0, -1.0, -1.0], [1.0, -1.0, 1.0, -1.0], [1.0, -1.0, -1.0, 1.0]])
_CLEAR = 1.5  # the correlation with the best pair exceeds that with the others by this factor

Signs = tuple[float, ...]


class RotorSigns(NamedTuple):
    """The signs of the rotors' x (forward) and y (left), and their spins (+1: counter-clockwise seen from above).

    `spins`: `None` if the vehicle hardly yawed.
    """

    forward: Signs
    left: Signs
    spins: Signs | None


def rotor_signs(flights: Sequence[Flight]) -> RotorSigns | None:
    """The places and spins of four rotors in an X, by how the vehicle turns after each pair of rotors speeds up.

    `None`: the flight does not show it, or the rotors are no X.

    **Arguments:** usable stretches of flights, each of one vehicle, with motors and gyro logged fast.
    """
    found = correlations(flights, _PAIRS)
    roll, pitch = (_pair(found[:, :, axis]) for axis in (0, 1))
    if roll is None or pitch is None or roll == pitch:
        return None
    (yaw,) = {0, 1, 2} - {roll, pitch}
    left = clear_sign(found[:, roll, 0]) * _PAIRS[roll]
    forward = -clear_sign(found[:, pitch, 1]) * _PAIRS[pitch]
    turn = clear_sign(found[:, yaw, 2])
    return RotorSigns(
        tuple(forward.tolist()), tuple(left.tolist()), tuple((-turn * _PAIRS[yaw]).tolist()) if turn else None
    )


def _pair(found: np.ndarray) -> int | None:
    """The row of `_PAIRS` that turns the vehicle about an axis, if one of them does clearly."""
    sizes = np.abs(found).max(axis=0)
    if np.isnan(sizes).any():
        return None
    best = int(np.argmax(sizes))
    alone = sizes[best] > _CLEAR * np.delete(sizes, best).max()
    return best if alone and clear_sign(found[:, best]) else None
