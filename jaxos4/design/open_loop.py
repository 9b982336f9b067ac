"""Flights of an OS4 without feedback: their inputs, their sensitivities, and the envelope that they need."""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Key, Parameters, RotorSpeeds, Scalar, as_float
from .._xla import quick_jit
from ..airframe import Airframe
from ..bracket import Bracket
from ..errors import InputError
from ..excitation import multisine
from ..flight import Inputs
from ..models.abstract import AbstractModel
from ..models.state import Forcing, State, unstack
from ..simulation import euler_step, simulate
from .envelope import Envelope, hover_squares
from .task import Coefficients

# Vehicles that must stay within the envelope, and the finer step at which they are flown.
VEHICLES, FINER = 200, 10
# The amplitude of tones below this frequency [Hz] is that at this frequency: angles would allow almost none.
_SLOWEST = 0.3
# Squared rotor speeds stay above this, which is outside of the envelope [rad^2/s^2].
_LEAST = 1e-6


class Multisine(eqx.Module):
    """Rotor speeds as a function of coefficients: angular and vertical accelerations are sums of cosines.

    The frequencies are the multiples of 1 / (2 duration) up to a bandwidth. Such cosines can make every input of this
    bandwidth, so only amplitudes are searched: a phase follows from neighbouring tones.

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
    def within(cls, airframe: Airframe, envelope: Envelope, samples: int, dt: float, bandwidth: float) -> "Multisine":
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


def sense(
    model: AbstractModel,
    omega: RotorSpeeds,
    parameters: Parameters,
    dt: Scalar,
    weights: Float[Array, " sensors"],
    start_is_known: bool,
) -> Float[Array, "samples sensors unknowns"]:
    """The derivatives of the weighted outputs of a flight from rest, by forward Euler.

    The unknowns are the parameters and, if the start is not known, the initial state of the measured channels. The
    program has fast reverse-mode derivatives.

    - `weights`: 1 / sigma of each channel, in cascade order.
    """
    count, sensors = parameters.shape[0], weights.shape[0]
    unknowns = count + (0 if start_is_known else sensors)
    identity, scalars = np.eye(unknowns), tuple(parameters)
    starts = np.zeros((12, unknowns))
    starts[: unknowns - count, count:] = np.eye(unknowns - count)
    first, first_slopes = unstack(jnp.zeros(12, dtype=float)), jax.vmap(unstack)(jnp.asarray(starts.T))

    def step(carry: tuple[State, State], forcing: Forcing):
        state, slopes = carry
        following, push = jax.linearize(lambda x, a: euler_step(model, x, forcing, a, dt), state, scalars)
        carry = following, jax.vmap(push)(slopes, tuple(identity[:, :count].T))
        return carry, carry[1]

    forcing = jax.tree.map(lambda leaf: leaf[:-1], model.forcing(Inputs(omega, dt), parameters))
    # Recomputing a step is faster than keeping its intermediate values for the reverse pass.
    slopes = jax.lax.scan(jax.checkpoint(step), (first, first_slopes), forcing)[1]
    rows = jnp.concatenate([starts[None, :sensors], jnp.stack(jax.tree.leaves(slopes)[:sensors], axis=1)])
    return weights[:, None] * rows


@functools.partial(jax.jit, static_argnums=2)
def drawn(bracket: Bracket, key: Key, count: int) -> Float[Array, "count parameters"]:
    """Vehicles drawn uniformly from the bracket."""
    lower, upper = bracket.lower, bracket.upper
    return lower + (upper - lower) * jax.random.uniform(key, (count, lower.shape[0]), dtype=float)


@quick_jit
def fly_finely(
    model: AbstractModel,
    vehicles: Float[Array, "vehicles parameters"],
    omega: RotorSpeeds,
    dt: Scalar,
    finer: int = FINER,
) -> Float[Array, "vehicles times 12"]:
    """The states of all vehicles from rest, at a `finer` step than the sample time."""
    held = jnp.concatenate([jnp.repeat(omega[:-1], finer, axis=0), omega[-1:]])
    return jax.vmap(lambda a: simulate(model, a, held, dt=dt / finer).states)(vehicles)


def envelope_of(
    model: AbstractModel, *, bracket: Bracket | None = None, duration: float = 5.0, dt: float = 0.01, key: Key
) -> Envelope:
    """The envelope that the standard multisine needs, for all vehicles of a bracket.

    **Raises:** `InputError` if it cannot be flown.
    """
    bracket = Bracket.default(model) if bracket is None else bracket
    try:
        omega = multisine(model.airframe, duration=duration, dt=dt)
    except ValueError as error:
        raise InputError(f"the standard multisine, which sets the envelope: {error}") from None
    states = np.asarray(fly_finely(model, drawn(bracket, key, VEHICLES), omega, as_float(dt)))
    if not np.isfinite(states).all():
        raise InputError("`bracket`: some of its vehicles turn over in the standard multisine; narrow it.")
    return Envelope.of(omega, states, dt)
