"""The state of a quadrotor as a cascade, and the forcing: rotors -> torque -> rates -> attitude -> translation.

The parameters enter only the forcing and the rate equations, and no level feeds back. So a `State` may stop at any
level: a level that is `None` is not simulated. States are separate scalars because a batch of scalars vectorises and a
batch of 12-vectors does not.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Scalar

# One value, or one for each sample.
Samples = Float[Array, "*samples"]
Vector = tuple[Samples, Samples, Samples]


class Rates(NamedTuple):
    """Body rates [rad/s]."""

    p: Scalar
    q: Scalar
    r: Scalar


class Attitude(NamedTuple):
    """Euler angles, yaw-pitch-roll [rad]."""

    phi: Scalar
    theta: Scalar
    psi: Scalar


class Translation(NamedTuple):
    """Position [m] and velocity [m/s] in the earth frame, z up."""

    x: Scalar
    vx: Scalar
    y: Scalar
    vy: Scalar
    z: Scalar
    vz: Scalar


class State(NamedTuple):
    """The state down to some level of the cascade."""

    rates: Rates
    attitude: Attitude | None = None
    translation: Translation | None = None


class Forcing(NamedTuple):
    """The action of the rotors: torques [N m], specific thrust U_c/m [m/s^2], residual rotor speed Omega_r [rad/s].

    Only a `FlightModel` has the other fields:

    - `spin_up`: Omega_r' [rad/s^2].
    - `specific_thrust`: U_c/m around the time of the sample [m/s^2], as an accelerometer measures it.
    - `recording`: for each recording, 1 if the sample belongs to it and 0 if not.
    - `velocity`: along the body's axes, measured or by dead reckoning [m/s].
    """

    roll: Samples
    pitch: Samples
    yaw: Samples
    thrust: Samples
    residual_speed: Samples
    spin_up: Samples | None = None
    specific_thrust: Samples | None = None
    recording: tuple[Samples, ...] = ()
    velocity: Vector | None = None


# The positions of the leaves of a `State` in the paper's order, Eq. (14).
CASCADE_ORDER = np.array([7, 9, 11, 6, 8, 10, 0, 1, 2, 3, 4, 5])

# The number of leaves that each choice of channels needs.
CHANNELS = {"rates": 3, "attitude": 6, "all": 12}


def unstack(values: Float[Array, "states *batch"]) -> State:
    """A `State` from its first 3, 6 or 12 leaves in cascade order."""
    v = tuple(values)
    attitude, translation = Attitude(*v[3:6]) if len(v) > 3 else None, Translation(*v[6:]) if len(v) > 6 else None
    return State(Rates(*v[:3]), attitude, translation)


def stack(state: State) -> Float[Array, "*batch states"]:
    """The leaves of a `State` as one array, in cascade order along the last axis."""
    return jnp.stack(jax.tree.leaves(state), axis=-1)
