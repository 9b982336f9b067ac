"""The two models of the OS4: as the paper prints it, and corrected to a rigid body.

Eqs. (1)-(3) and (7)-(9) of the paper are `PublishedOS4`; (4)-(6) `state.attitude_rates`; (10)-(13) `Airframe.mixer`,
with alpha by `alpha_from_inertia`; (14) `STATE_NAMES`.
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Scalar, as_float
from ..airframe import INVERSES, OS4, Airframe, alpha_from_inertia
from ..flight import Inputs
from .abstract import DEFAULT_HALF_WIDTH, PARAMETER_NAMES, AbstractModel, Parameter
from .state import Forcing, Orientation, Rates, State, Translation, attitude_rates


class AbstractOS4(AbstractModel):
    """The common part of the OS4 models, with alpha_1..8. `gyroscopic_unit`: the unit of alpha2 and alpha5."""

    gyroscopic_unit: ClassVar[str]

    @abc.abstractmethod
    def horizontal_thrust(self, orientation: Orientation) -> tuple[Scalar, Scalar]:
        """The shares of the thrust along x and y of the earth's frame."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """alpha_1..8."""
        ratio, gyroscopic, inverse_inertia = "1", self.gyroscopic_unit, "1/(kg m^2)"
        units = (ratio, gyroscopic, inverse_inertia) * 2 + (ratio, inverse_inertia)
        return tuple(map(Parameter, PARAMETER_NAMES, units))

    @property
    @eqx.filter_jit  # one program instead of a dozen small ones
    def alpha(self) -> Float[Array, "8"]:
        """alpha_1..8 by the definitions below Eq. (13)."""
        return alpha_from_inertia(self.airframe.inertia, self.airframe.rotor_inertia * self.gyroscopic_factor)

    @property
    @eqx.filter_jit
    def half_width(self) -> Float[Array, "8"]:
        """`DEFAULT_HALF_WIDTH`, with the widths of alpha3, alpha6 and alpha8 scaled to the airframe's inertia."""
        os4, own = (alpha_from_inertia(airframe.inertia, jnp.zeros(())) for airframe in (OS4, self.airframe))
        scaled = np.isin(np.arange(8), INVERSES)
        return jnp.where(scaled, own / jnp.where(scaled, os4, 1.0), 1.0) * DEFAULT_HALF_WIDTH

    def forcing(self, inputs: Inputs, parameters) -> Forcing:
        """Torques and thrust by Eqs. (10)-(13), and the residual speed Omega_r = sum s_i omega_i."""
        del parameters
        omega, airframe = inputs.omega, self.airframe
        roll, pitch, yaw, thrust = (jnp.square(omega) @ airframe.mixer.T).T
        return Forcing(roll, pitch, yaw, thrust / airframe.mass, omega @ jnp.asarray(airframe.rotor_spins))

    def cascade(self, state: State, forcing: Forcing, parameters) -> State:
        """See `AbstractModel`."""
        rates = self.angular_acceleration(state.rates, forcing, parameters)
        if state.attitude is None:
            return State(rates)
        orientation, t = Orientation.of(state.attitude), state.translation
        attitude = attitude_rates(state.rates, orientation)
        if t is None:
            return State(rates, attitude)
        x, y = self.horizontal_thrust(orientation)
        thrust = forcing.mean_specific_thrust
        az = orientation.cos_theta * orientation.cos_phi * thrust - self.airframe.gravity  # Eq. (9)
        return State(rates, attitude, Translation(t.vx, x * thrust, t.vy, y * thrust, t.vz, az))


class PublishedOS4(AbstractOS4):
    """The model exactly as the paper prints it: Eqs. (1)-(13), kept as a benchmark.

    It departs from a rigid body (`CorrectedOS4`) in three places. The gyroscopic terms lack the rotor speed, so that
    alpha2 = J_R d / Ix [1/s]. Eq. (2) has alpha5 r instead of alpha5 p. Eqs. (7)-(9) mix two earth frames.
    """

    gyroscopic_unit: ClassVar[str] = "1/s"
    airframe: Airframe = OS4

    @property
    def gyroscopic_factor(self) -> Scalar:
        """The drag coefficient d: the paper prints alpha2 = J_R d / Ix."""
        return as_float(self.airframe.drag_coefficient)

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """p', q', r' [rad/s^2]: Eqs. (1)-(3)."""
        p, q, r = rates
        a1, a2, a3, a4, a5, a6, a7, a8 = parameters
        return Rates(
            q * r * a1 - a2 * q + a3 * forcing.roll,
            p * r * a4 + r * a5 + a6 * forcing.pitch,
            p * q * a7 + a8 * forcing.yaw,
        )

    def horizontal_thrust(self, orientation: Orientation) -> tuple[Scalar, Scalar]:
        """The shares of the thrust along x and y: Eqs. (7) and (8)."""
        sin_phi, cos_phi, sin_theta, _, sin_psi, cos_psi = orientation
        return (
            sin_phi * cos_psi - sin_psi * sin_theta * cos_phi,
            -sin_psi * sin_phi - sin_theta * cos_phi * cos_psi,
        )


class CorrectedOS4(AbstractOS4):
    """The published model with the equations of a rigid body: x forward, y left, z up.

    alpha2 = J_R / Ix and alpha5 = J_R / Iy have no unit. They multiply Omega_r q and Omega_r p, so a flight excites
    them. The model does not include the reaction of accelerating rotors, -J_R Omega_r' / Iz in yaw.
    """

    gyroscopic_unit: ClassVar[str] = "1"
    airframe: Airframe = OS4

    @property
    def gyroscopic_factor(self) -> Scalar:
        """1: alpha2 = J_R / Ix."""
        return as_float(1.0)

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """Euler's equations with the gyroscopic torque -omega x (0, 0, J_R Omega_r)."""
        p, q, r = rates
        a1, a2, a3, a4, a5, a6, a7, a8 = parameters
        return Rates(
            q * r * a1 - a2 * forcing.residual_speed * q + a3 * forcing.roll,
            p * r * a4 + a5 * forcing.residual_speed * p + a6 * forcing.pitch,
            p * q * a7 + a8 * forcing.yaw,
        )

    def horizontal_thrust(self, orientation: Orientation) -> tuple[Scalar, Scalar]:
        """The body's z axis, rotated into the earth frame."""
        sin_phi, cos_phi, sin_theta, _, sin_psi, cos_psi = orientation
        return (
            cos_psi * sin_theta * cos_phi + sin_psi * sin_phi,
            sin_psi * sin_theta * cos_phi - cos_psi * sin_phi,
        )
