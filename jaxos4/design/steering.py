"""Rotor speeds as a function of few coefficients: tones of angular and vertical acceleration."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Numeric, RotorSpeeds, as_float
from ..airframe import Airframe
from ..errors import InputError
from .envelope import Envelope
from .search import Coefficients

# The amplitude of tones below this frequency [Hz] is that at this frequency: angles would allow almost none.
_SLOWEST = 0.3
# Squared rotor speeds stay above this, where the envelope is left anyway [rad^2/s^2].
_LEAST = 1e-6


class Steering(eqx.Module):
    """A multisine: angular accelerations and vertical acceleration are sums of cosines, and rotor speeds follow.

    The frequencies are the multiples of 1 / (2 duration) up to a bandwidth. Such cosines can make every input of this
    bandwidth, so amplitudes are all that a search has to find: a phase follows from neighbouring tones.

    - `tones`: each tone at each sample.
    - `scale`: the amplitude of each tone for a coefficient of 1, about as large as the envelope allows: for roll,
      pitch, yaw [rad/s^2] and vertical acceleration [m/s^2].
    - `hover`: squared rotor speeds that carry the weight [rad^2/s^2]. `action`: their change by a unit of each
      acceleration.
    """

    tones: Float[Array, "samples tones"] = eqx.field(converter=as_float)
    scale: Float[Array, "4 tones"] = eqx.field(converter=as_float)
    hover: Float[Array, "4"] = eqx.field(converter=as_float)
    action: Float[Array, "4 4"] = eqx.field(converter=as_float)

    @classmethod
    def within(cls, airframe: Airframe, envelope: Envelope, samples: int, dt: float, bandwidth: float) -> "Steering":
        """Tones up to `bandwidth` [Hz] in so many samples, scaled to the envelope."""
        duration = (samples - 1) * dt
        frequency = np.arange(math.floor(2 * duration * bandwidth + 1e-9) + 1) / (2 * duration)
        hover = hover_squares(airframe, envelope)
        action = np.linalg.solve(np.asarray(airframe.mixer), np.diag(np.append(airframe.inertia, airframe.mass)))
        speed, limits = np.sqrt(hover), np.asarray([envelope.slowest, envelope.fastest])
        change = (np.abs(action) / (2 * speed)[:, None]).max(axis=0)[:, None]  # of rotor speed, by one unit
        angular = 2 * math.pi * np.maximum(frequency, _SLOWEST)
        uses = (
            change / np.abs(speed[:, None] - limits).min(),
            change * angular / np.asarray(envelope.slew),
            1 / (angular * np.append(envelope.rate, envelope.velocity)[:, None]),
            1 / (angular**2 * np.append(envelope.angle, envelope.distance)[:, None]),
        )
        tones = np.cos(2 * math.pi * frequency * dt * np.arange(samples)[:, None])
        return cls(tones, 1 / np.linalg.norm(np.broadcast_arrays(*uses), axis=0), hover, action)

    def __call__(self, coefficients: Coefficients) -> RotorSpeeds:
        """The rotor speeds [rad/s]."""
        acceleration = self.tones @ (self.scale * coefficients.reshape(self.scale.shape)).T
        return jnp.sqrt(jnp.maximum(self.hover + acceleration @ self.action.T, _LEAST))


def hover_squares(airframe: Airframe, envelope: Envelope) -> Float[np.ndarray, "4"]:
    """The squared rotor speeds that carry the weight. Raises `InputError` if they lie outside of the envelope."""
    squares = airframe.hover_squares
    slowest, fastest = float(envelope.slowest), min(float(envelope.fastest), float(airframe.max_rotor_speed))
    if not np.all((squares > slowest**2) & (squares < fastest**2)):
        speeds = ", ".join(f"{x:.4g}" for x in np.sqrt(np.maximum(squares, 0)))
        raise InputError(
            f"the vehicle cannot hover within the envelope: its rotors need {speeds} rad/s, and the limits are "
            f"{slowest:.4g} and {fastest:.4g} rad/s; correct the limits, or the airframe."
        )
    return squares


def amplified(
    omega: Float[Numeric, "samples 4"], hover: Float[Numeric, "4"], factor: float
) -> Float[np.ndarray, "samples 4"]:
    """The same input with all accelerations multiplied by `factor`, which is at most 1."""
    return np.sqrt(hover + factor * (np.square(omega) - hover))
