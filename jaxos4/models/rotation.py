"""Rotations between the body's axes and the earth's, and the kinematics of the Euler angles."""

from ..trigonometry import sincos
from .state import Attitude, Rates, Samples, Vector


def attitude_rates(rates: Rates, attitude: Attitude) -> Attitude:
    """phi', theta', psi' [rad/s] from body rates: Eqs. (4)-(6). Singular at theta = +-90 degrees."""
    sin_phi, cos_phi = sincos(attitude.phi)
    sin_theta, cos_theta = sincos(attitude.theta)
    yaw = (rates.q * sin_phi + rates.r * cos_phi) / cos_theta
    return Attitude(rates.p + sin_theta * yaw, rates.q * cos_phi - rates.r * sin_phi, yaw)


def to_earth(attitude: Attitude, body: Vector) -> Vector:
    """A vector from the body's axes to the earth's: R_z(psi) R_y(theta) R_x(phi)."""
    sin_phi, cos_phi, sin_theta, cos_theta, sin_psi, cos_psi = sines_and_cosines(attitude)
    x, y, z = body
    y, z = y * cos_phi - z * sin_phi, y * sin_phi + z * cos_phi
    x, z = x * cos_theta + z * sin_theta, -x * sin_theta + z * cos_theta
    return x * cos_psi - y * sin_psi, x * sin_psi + y * cos_psi, z


def to_body(attitude: Attitude, earth: Vector) -> Vector:
    """A vector from the earth's axes to the body's: the inverse of `to_earth`."""
    sin_phi, cos_phi, sin_theta, cos_theta, sin_psi, cos_psi = sines_and_cosines(attitude)
    x, y, z = earth
    x, y = x * cos_psi + y * sin_psi, -x * sin_psi + y * cos_psi
    x, z = x * cos_theta - z * sin_theta, x * sin_theta + z * cos_theta
    return x, y * cos_phi + z * sin_phi, -y * sin_phi + z * cos_phi


def sines_and_cosines(attitude: Attitude) -> tuple[Samples, ...]:
    """The sine and the cosine of phi, theta and psi."""
    return (*sincos(attitude.phi), *sincos(attitude.theta), *sincos(attitude.psi))
