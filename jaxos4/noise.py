"""Sensor noise: turns a simulated flight into a measured one; `vmap` it over keys, flights or its own numbers.

A noise changes `Flight.states` and nothing else. States that were not measured stay NaN.
"""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ._custom_types import Key, States, as_float, setting
from .flight import STATE_NAMES, STATE_UNITS, Flight

PerChannel = Float[Array, "12"]

_SIGMA_OF_UNIT = {"m": 0.005, "m/s": 0.02, "rad": 0.005, "rad/s": 0.01}
SENSOR_SIGMA = np.array([_SIGMA_OF_UNIT[unit] for unit in STATE_UNITS])
"""Standard deviations of the standard flight's sensors in the order and units of `STATE_NAMES`, `STATE_UNITS`."""
SENSOR_SIGMA.flags.writeable = False
# Standard deviation of an accelerometer in flight [m/s^2]: mostly vibration.
FORCE_SIGMA = 0.3


def _with_states(flight: Flight, states: States) -> Flight:
    return eqx.tree_at(lambda f: f.states, flight, states)


class AbstractNoise(eqx.Module):
    """Sensor noise. A setting "for each state" is one number for all states, or an array of 12 numbers."""

    @abc.abstractmethod
    def __call__(self, flight: Flight, *, key: Key) -> Flight:
        """The flight with noisy states. The same random `key` gives the same flight."""


class WhiteNoise(AbstractNoise):
    """Independent Gaussian errors of every sample, with `sigma` for each state in `STATE_UNITS`. 0: exact."""

    sigma: PerChannel = eqx.field(converter=setting("sigma", STATE_NAMES))

    def __call__(self, flight: Flight, *, key: Key) -> Flight:
        """See `AbstractNoise`."""
        return _with_states(flight, flight.states + self.sigma * _normal(key, flight.states))


class ConstantBias(AbstractNoise):
    """A Gaussian offset of each state that is constant during the flight; `sigma`, `mean`: in `STATE_UNITS`."""

    sigma: PerChannel = eqx.field(converter=setting("sigma", STATE_NAMES))
    mean: PerChannel = eqx.field(converter=setting("mean", STATE_NAMES, low=-np.inf), default=0.0)

    def __call__(self, flight: Flight, *, key: Key) -> Flight:
        """See `AbstractNoise`."""
        return _with_states(flight, flight.states + self.mean + self.sigma * _normal(key, flight.states[0]))


class GaussMarkov(AbstractNoise):
    """Coloured errors: a stationary first-order process with autocorrelation sigma^2 exp(-|tau| / T).

    The samples are exact: e_{k+1} = a e_k + sigma sqrt(1 - a^2) w_k with a = exp(-dt / T) and w_k standard normal.

    - `sigma`: standard deviation for each state, in `STATE_UNITS`.
    - `correlation_time`: T [s] for each state, positive. Infinite: a constant bias.
    """

    sigma: PerChannel = eqx.field(converter=setting("sigma", STATE_NAMES))
    correlation_time: PerChannel = eqx.field(
        converter=setting("correlation_time", STATE_NAMES, positive=True, finite=False)
    )

    def __call__(self, flight: Flight, *, key: Key) -> Flight:
        """See `AbstractNoise`."""
        errors = coloured(_normal(key, flight.states), flight.dt / self.correlation_time)
        return _with_states(flight, flight.states + self.sigma * errors)


class Quantisation(AbstractNoise):
    """Rounding to the nearest multiple of `step`, for each state in `STATE_UNITS`. 0: not rounded."""

    step: PerChannel = eqx.field(converter=setting("step", STATE_NAMES))

    def __call__(self, flight: Flight, *, key: Key) -> Flight:
        """See `AbstractNoise`."""
        step = jnp.where(self.step > 0, self.step, 1)
        return _with_states(flight, jnp.where(self.step > 0, step * jnp.round(flight.states / step), flight.states))


class Dropouts(AbstractNoise):
    """Lost samples: each sample of each state becomes NaN with `probability`, independently of the others."""

    probability: PerChannel = eqx.field(converter=setting("probability", STATE_NAMES, high=1.0))

    def __call__(self, flight: Flight, *, key: Key) -> Flight:
        """See `AbstractNoise`."""
        lost = jax.random.bernoulli(key, self.probability, flight.states.shape)
        return _with_states(flight, jnp.where(lost, jnp.nan, flight.states))


class Chain(AbstractNoise):
    """Several noises, applied in order. Noise i draws from `fold_in(key, i)`."""

    noises: tuple[AbstractNoise, ...] = eqx.field(converter=tuple)

    def __call__(self, flight: Flight, *, key: Key) -> Flight:
        """See `AbstractNoise`."""
        for i, noise in enumerate(self.noises):
            flight = noise(flight, key=jax.random.fold_in(key, i))
        return flight


def coloured(draws: Float[Array, "count columns"], step: Float[Array, "*columns"]) -> Float[Array, "count columns"]:
    """Ornstein-Uhlenbeck processes of unit variance, from white noise; `step`: time step / correlation time."""
    decay, fresh = jnp.exp(-step), jnp.sqrt(-jnp.expm1(-2 * step))

    def advance(value: Array, draw: Array) -> tuple[Array, Array]:
        value = decay * value + fresh * draw
        return value, value

    return jnp.concatenate([draws[:1], jax.lax.scan(advance, draws[0], draws[1:])[1]])


def _normal(key: Key, like: Float[Array, " *shape"]) -> Float[Array, " *shape"]:
    return jax.random.normal(key, like.shape, like.dtype)


def measure(flight: Flight, noise: AbstractNoise, *, seed: int) -> Flight:
    """The flight as noisy sensors record it, with random numbers from `seed`."""
    return noise(flight, key=jax.random.key(seed))


NOISES: dict[str, Callable[[ArrayLike], AbstractNoise]] = {
    "white": WhiteNoise,
    "coloured": lambda sigma: GaussMarkov(sigma, 0.05),
    "biased": lambda sigma: Chain((WhiteNoise(sigma), ConstantBias(0.5 * as_float(sigma)))),
    "quantised": lambda sigma: Chain((WhiteNoise(sigma), Quantisation(2.0 * as_float(sigma)))),
    "lossy": lambda sigma: Chain((WhiteNoise(sigma), Dropouts(0.1))),
}
"""The kinds of noise that studies name, each made from a standard deviation sigma.

`white`; `coloured` with a correlation time of 0.05 s; `biased`: white with a constant offset of standard deviation
sigma / 2; `quantised`: white, rounded to multiples of 2 sigma; `lossy`: white, 10 % of the samples lost.
"""
