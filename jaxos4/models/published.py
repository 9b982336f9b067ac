"""The model as the paper prints it.

Its equations are here:

- Eqs. (1)-(3), (7)-(9): `PublishedOS4`, rates and translation.
- Eqs. (4)-(6): attitude, `rotation.attitude_rates`.
- Eqs. (10)-(13): torques and thrust, `Airframe.mixer`; the definitions of alpha below them, `alpha_from_inertia`.
- Eq. (14): the order of the state, `STATE_NAMES`.
"""

from .._custom_types import Scalar, as_float
from ..airframe import OS4, Airframe
from ..trigonometry import sincos
from .abstract import AbstractOS4
from .state import Attitude, Forcing, Rates


class PublishedOS4(AbstractOS4):
    """The model exactly as the paper prints it: Eqs. (1)-(13), kept as a benchmark.

    It departs from the physics of a rigid body, which is `CorrectedOS4`, in three places:

    - The gyroscopic terms lack the rotor speed: alpha2 = J_R d / Ix multiplies q alone, in 1/s.
    - Eq. (2) has alpha5 r; physics has alpha5 p.
    - Eqs. (7)-(9) mix two earth frames.
    """

    airframe: Airframe = OS4

    @property
    def gyroscopic_factor(self) -> Scalar:
        """The drag coefficient d: the paper prints alpha2 = J_R d / Ix."""
        return as_float(self.airframe.drag_coefficient)

    @property
    def gyroscopic_unit(self) -> str:
        """The unit that Eqs. (1)-(2) need."""
        return "1/s"

    def angular_acceleration(self, rates: Rates, forcing: Forcing, parameters) -> Rates:
        """p', q', r' [rad/s^2]: Eqs. (1)-(3)."""
        p, q, r = rates
        a1, a2, a3, a4, a5, a6, a7, a8 = parameters
        return Rates(
            q * r * a1 - a2 * q + a3 * forcing.roll,
            p * r * a4 + r * a5 + a6 * forcing.pitch,
            p * q * a7 + a8 * forcing.yaw,
        )

    def acceleration(self, attitude: Attitude, forcing: Forcing) -> tuple[Scalar, Scalar, Scalar]:
        """x'', y'', z'' [m/s^2]: Eqs. (7)-(9)."""
        sin_phi, cos_phi = sincos(attitude.phi)
        sin_theta, cos_theta = sincos(attitude.theta)
        sin_psi, cos_psi = sincos(attitude.psi)
        return (
            (sin_phi * cos_psi - sin_psi * sin_theta * cos_phi) * forcing.thrust,
            (-sin_psi * sin_phi - sin_theta * cos_phi * cos_psi) * forcing.thrust,
            cos_theta * cos_phi * forcing.thrust - self.airframe.gravity,
        )
