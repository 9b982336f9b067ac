"""The published model with its departures from rigid-body physics corrected."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Scalar
from ..airframe import OS4, Airframe, alpha_from_inertia
from ..trigonometry import sincos
from .abstract import AbstractModel
from .state import Attitude, Forcing, Rates


class CorrectedOS4(AbstractModel):
    """The published model with its departures from rigid-body physics mended: x forward, y left, z up.

    alpha2 = J_R / Ix and alpha5 = J_R / Iy are dimensionless and multiply Omega_r q and Omega_r p, so that a flight
    can tell them. The reaction of accelerating rotors, -J_R Omega_r' in yaw, is left out.
    """

    airframe: Airframe = OS4

    @property
    def alpha(self) -> Float[Array, "8"]:
        """alpha_1..8 with J_R in the place of J_R d."""
        return alpha_from_inertia(self.airframe.inertia, self.airframe.rotor_inertia * self.gyroscopic_factor)

    @property
    def gyroscopic_factor(self) -> Scalar:
        """1: alpha2 = J_R / Ix."""
        return jnp.asarray(1.0)

    @property
    def parameter_units(self) -> tuple[str, ...]:
        """Units of alpha_1..8."""
        return ("1", "1", "1/(kg m^2)", "1", "1", "1/(kg m^2)", "1", "1/(kg m^2)")

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """Euler's equations with the gyroscopic torque -omega x (0, 0, J_R Omega_r)."""
        p, q, r = rates
        a1, a2, a3, a4, a5, a6, a7, a8 = parameters
        return Rates(
            q * r * a1 - a2 * forcing.residual_speed * q + a3 * forcing.roll,
            p * r * a4 + a5 * forcing.residual_speed * p + a6 * forcing.pitch,
            p * q * a7 + a8 * forcing.yaw,
        )

    def acceleration(self, attitude: Attitude, forcing: Forcing) -> tuple[Scalar, Scalar, Scalar]:
        """Thrust along the body's z axis, turned into the earth frame, and gravity."""
        sin_phi, cos_phi = sincos(attitude.phi)
        sin_theta, cos_theta = sincos(attitude.theta)
        sin_psi, cos_psi = sincos(attitude.psi)
        return (
            (cos_psi * sin_theta * cos_phi + sin_psi * sin_phi) * forcing.thrust,
            (sin_psi * sin_theta * cos_phi - cos_psi * sin_phi) * forcing.thrust,
            cos_theta * cos_phi * forcing.thrust - self.airframe.gravity,
        )
