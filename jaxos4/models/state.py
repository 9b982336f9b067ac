"""The state of a quadrotor as a cascade: rotor speeds -> torque -> rates -> attitude -> translation.

The parameters enter only the rate equations; attitude follows from the rates, translation from the attitude, and
neither feeds back. A `State` may therefore stop at any floor of the cascade: what is `None` is neither simulated nor
needed. States are held as separate scalars, because a batch of scalars vectorises and a batch of 12-vectors does not.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Scalar


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
    """The state down to some floor of the cascade."""

    rates: Rates
    attitude: Attitude | None = None
    translation: Translation | None = None


class Forcing(NamedTuple):
    """What the rotors do: torques [N m], specific thrust U_c/m [m/s^2], residual rotor speed Omega_r [rad/s].

    Of a `FlightModel`, and nothing of others:

    - `spin_up`: Omega_r' [rad/s^2].
    - `specific_thrust`: U_c / m at the sample itself [m/s^2], as an accelerometer there feels it.
    - `recording`: for each recording, 1 where the sample belongs to it and 0 where not.
    - `velocity`: along the body's axes [m/s], where that is an input.
    - `lateral`: the measured specific force along x and y [m/s^2], where that is an input.
    """

    roll: Float[Array, "*samples"]
    pitch: Float[Array, "*samples"]
    yaw: Float[Array, "*samples"]
    thrust: Float[Array, "*samples"]
    residual_speed: Float[Array, "*samples"]
    spin_up: Float[Array, "*samples"] | None = None
    specific_thrust: Float[Array, "*samples"] | None = None
    recording: tuple[Float[Array, "*samples"], ...] = ()
    velocity: tuple[Float[Array, "*samples"], ...] | None = None
    lateral: tuple[Float[Array, "*samples"], ...] | None = None


# Where the leaves of a `State` stand in the paper's order, Eq. (14).
CASCADE_ORDER = np.array([7, 9, 11, 6, 8, 10, 0, 1, 2, 3, 4, 5])


# How many of them each choice of channels needs.
CHANNELS = {"rates": 3, "attitude": 6, "all": 12}


def unstack(values: Float[Array, " states"]) -> State:
    """A `State` from its first 3, 6 or 12 leaves in cascade order."""
    v = tuple(values)
    return State(
        Rates(*v[:3]), Attitude(*v[3:6]) if len(v) > 3 else None, Translation(*v[6:12]) if len(v) > 6 else None
    )


def stack(state: State) -> Float[Array, "*batch states"]:
    """The leaves of a `State` as one array, in cascade order along the last axis."""
    return jnp.stack(jax.tree.leaves(state), axis=-1)
