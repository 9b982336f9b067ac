"""The model of a rigid body: the published model without its departures from physics."""

import jax.numpy as jnp

from .._custom_types import Scalar
from ..airframe import OS4, Airframe
from ..trigonometry import sincos
from .abstract import AbstractOS4
from .state import Attitude, Forcing, Rates


class CorrectedOS4(AbstractOS4):
    """The published model with the equations of a rigid body: x forward, y left, z up.

    alpha2 = J_R / Ix and alpha5 = J_R / Iy have no unit. The model leaves out the reaction of accelerating rotors,
    -J_R Omega_r' / Iz in yaw.
    """

    airframe: Airframe = OS4

    @property
    def gyroscopic_factor(self) -> Scalar:
        """1: alpha2 = J_R / Ix."""
        return jnp.asarray(1.0)

    @property
    def gyroscopic_unit(self) -> str:
        """None: alpha2 and alpha5 are ratios of inertias."""
        return "1"

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
        """The thrust along the body's z axis, rotated into the earth frame, and gravity."""
        sin_phi, cos_phi = sincos(attitude.phi)
        sin_theta, cos_theta = sincos(attitude.theta)
        sin_psi, cos_psi = sincos(attitude.psi)
        return (
            (cos_psi * sin_theta * cos_phi + sin_psi * sin_phi) * forcing.thrust,
            (sin_psi * sin_theta * cos_phi - cos_psi * sin_phi) * forcing.thrust,
            cos_theta * cos_phi * forcing.thrust - self.airframe.gravity,
        )
