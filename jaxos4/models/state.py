"""The state of a quadrotor as a cascade, and the forcing: rotors -> torque -> rates -> attitude -> translation.

In the OS4, parameters enter the forcing and the rates alone, and no level feeds back. So a `State` may stop at any
level; a level that is `None` is not simulated. (Terms of a vehicle may act on the translation, and use its velocity:
`shooting.scans.panels_of` finds out which unknowns act where.) States are scalars, because a batch of scalars
vectorises.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Scalar
from ..rotations import sincos

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


class Orientation(NamedTuple):
    """The sines and cosines of an attitude, which are slow to compute and used by several equations."""

    sin_phi: Samples
    cos_phi: Samples
    sin_theta: Samples
    cos_theta: Samples
    sin_psi: Samples
    cos_psi: Samples

    @classmethod
    def of(cls, attitude: Attitude) -> "Orientation":
        """The orientation of an attitude."""
        return cls(*sincos(attitude.phi), *sincos(attitude.theta), *sincos(attitude.psi))


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
    """The rotors' mean action over a sample: torques [N m], specific thrust U_c/m [m/s^2], residual speed [rad/s].

    Only a `FlightModel` has the other fields:

    - `spin_up`: Omega_r' [rad/s^2].
    - `sensed_specific_thrust`: U_c/m as an accelerometer senses it [m/s^2]: at the time of the sample, or averaged
      around it like the log.
    - `recording`: for each recording, 1 if the sample belongs to it and 0 if not.
    - `velocity`: along the body's axes, see `Flight.body_velocity` [m/s].
    - `early`: the mean of the forcing with a weight: twice the share of the measurement that is still to come. For an
      instant in mid-sample, the weight is 2 before it and 0 after it. `None`: samples begin with their measurement.
    """

    roll: Samples
    pitch: Samples
    yaw: Samples
    mean_specific_thrust: Samples
    residual_speed: Samples
    spin_up: Samples | None = None
    sensed_specific_thrust: Samples | None = None
    recording: tuple[Samples, ...] = ()
    velocity: Vector | None = None
    early: "Forcing | None" = None


# The positions of the leaves of a `State` in the paper's order, Eq. (14).
CASCADE_ORDER = np.array([7, 9, 11, 6, 8, 10, 0, 1, 2, 3, 4, 5])

# The choices of `channels`, the states that are compared, and how many leaves of a state each needs.
CHANNELS = {"rates": 3, "attitude": 6, "all": 12}


def unstack(values: Float[Array, "states *batch"]) -> State:
    """A `State` from its first 3, 6 or 12 leaves in cascade order."""
    v = tuple(values)
    attitude, translation = Attitude(*v[3:6]) if len(v) > 3 else None, Translation(*v[6:]) if len(v) > 6 else None
    return State(Rates(*v[:3]), attitude, translation)


def stack(state: State) -> Float[Array, "*batch states"]:
    """The leaves of a `State` as one array, in cascade order along the last axis."""
    return jnp.stack(jax.tree.leaves(state), axis=-1)


def attitude_rates(rates: Rates, orientation: Orientation) -> Attitude:
    """phi', theta', psi' [rad/s] from body rates: Eqs. (4)-(6). Singular at theta = +-90 degrees."""
    sin_phi, cos_phi, sin_theta, cos_theta, _, _ = orientation
    yaw = (rates.q * sin_phi + rates.r * cos_phi) / cos_theta
    return Attitude(rates.p + sin_theta * yaw, rates.q * cos_phi - rates.r * sin_phi, yaw)


def to_earth(orientation: Orientation, body: Vector) -> Vector:
    """A vector from the body's axes to the earth's: R_z(psi) R_y(theta) R_x(phi)."""
    sin_phi, cos_phi, sin_theta, cos_theta, sin_psi, cos_psi = orientation
    x, y, z = body
    y, z = y * cos_phi - z * sin_phi, y * sin_phi + z * cos_phi
    x, z = x * cos_theta + z * sin_theta, -x * sin_theta + z * cos_theta
    return x * cos_psi - y * sin_psi, x * sin_psi + y * cos_psi, z


def to_body(orientation: Orientation, earth: Vector) -> Vector:
    """A vector from the earth's axes to the body's: the inverse of `to_earth`."""
    sin_phi, cos_phi, sin_theta, cos_theta, sin_psi, cos_psi = orientation
    x, y, z = earth
    x, y = x * cos_psi + y * sin_psi, -x * sin_psi + y * cos_psi
    x, z = x * cos_theta - z * sin_theta, x * sin_theta + z * cos_theta
    return x, y * cos_phi + z * sin_phi, -y * sin_phi + z * cos_phi
