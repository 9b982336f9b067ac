"""The place of the centre of mass, from a fit with the term `center_of_mass`."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from ..airframe import Airframe

# The coordinate [m] is the slope of torque over thrust, divided by an alpha and the mass, with this sign.
_COORDINATES = (("x", "pitch_thrust", "alpha6", 1.0), ("y", "roll_thrust", "alpha3", -1.0))


class CenterOfMass(NamedTuple):
    """A coordinate of the centre of mass in the frame of the rotor positions: x forward, y left [m].

    `std`: its standard deviation [m].
    """

    axis: str
    value: float
    std: float


def center_of_mass(
    names: Sequence[str], parameters: Float[ArrayLike, " n"], covariance: Float[ArrayLike, "n n"], airframe: Airframe
) -> tuple[CenterOfMass, ...]:
    """The coordinates of the centre of mass whose parameters were estimated; none without the term `center_of_mass`.

    Rotors of unequal thrust cause the same torque: 5 % more thrust of the two left rotors is the same as a centre of
    mass that lies 2.5 % of their y to the right.

    **Arguments:** the names, values and covariance of the estimated parameters, and the airframe (its mass).
    """
    places, values, spread = list(names), np.asarray(parameters, dtype=float), np.asarray(covariance, dtype=float)
    found = []
    for axis, slope, inverse_inertia, sign in _COORDINATES:
        if not {slope, inverse_inertia} <= set(places):
            continue
        top, bottom = values[places.index(slope)], values[places.index(inverse_inertia)]
        value = sign * top / (bottom * float(airframe.mass))
        gradient = np.zeros(values.size)
        gradient[places.index(slope)] = sign / (bottom * float(airframe.mass))
        gradient[places.index(inverse_inertia)] = -value / bottom
        found.append(CenterOfMass(axis, float(value), float(np.sqrt(gradient @ spread @ gradient))))
    return tuple(found)
