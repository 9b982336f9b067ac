"""The gains of the Kalman filters of filter error, which do not depend on the parameters of the model.

A disturbance d acts in each channel: on a body rate as an angular acceleration [rad/s^2], on a specific force as a
force per mass [m/s^2]. It is an Ornstein-Uhlenbeck process, d' = -d / tau + white noise, with the standard deviation s.
The filter of a body rate knows the rate and its disturbance. A specific force is measured as its mean over a sample.
Its filter knows the disturbance at the end of the sample and, in the place of the rate, the mean over the sample. Both
rate and mean are integrals of the disturbance, but each sample has its own mean. Channels share no covariance.

Arrays have the axes (time, channels, segments). A segment is one part of the flight.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._custom_types import Numeric, Scalar, as_float
from ..models.state import CHANNELS

Channels = Float[Array, "channels segments"]
Series = Float[Array, "time channels segments"]

RATES = CHANNELS["rates"]
"""The number of body rates, which come first among the channels."""
# Standard deviation of the rates before the first measurement of a segment [rad/s]: as good as unknown.
_UNKNOWN_RATE = 1e3
# The sample time over the time constant below which a Taylor series is more exact.
_SHORT = 0.03


class LogNoise(NamedTuple):
    """The logarithms of each channel's noise levels, in all segments or in each. Logarithms may have any sign.

    - `strength`: standard deviation of the disturbance, [rad/s^2] for rates and [m/s^2] for specific force.
    - `time_constant`: of the disturbance [s].
    - `sensor`: standard deviation of the sensor's white noise, in the unit of the channel.
    """

    strength: Float[Numeric, "channels *segments"]
    time_constant: Float[Numeric, "channels *segments"]
    sensor: Float[Numeric, "channels *segments"]


class Observed(NamedTuple):
    """The measurements, in segments.

    - `measured`: body rates, then specific force. NaN: not measured.
    - `restart`: whether a segment forgets what it knew before this sample.
    - `counts`: whether the innovations at a sample count.
    - `known`: the rates at the first sample. `None`: unknown.
    """

    measured: Series
    restart: Bool[Array, "time segments"]
    counts: Bool[Array, "time segments"]
    known: Float[Array, "3 segments"] | None = None


class Gains(NamedTuple):
    """The gains of rate and disturbance for a unit of innovation, and the variance of the innovation."""

    rate: Series
    disturbance: Series
    variance: Series


class Covariance(NamedTuple):
    """Variance of the rate, covariance of rate and disturbance, variance of the disturbance."""

    rate: Channels
    cross: Channels
    disturbance: Channels


class Step(NamedTuple):
    """The disturbance over one sample, of each channel.

    - `kept`: the share of it that remains. `reach`: what a unit of it adds to the rate, or its mean over the sample.
    - `added`: the covariance that its noise adds.
    - `variance`: of the disturbance. `sensor`: of the sensor's noise.
    - `memory`: 1 for a rate; 0 for the mean over a sample, which the next mean does not know.
    """

    kept: Channels
    reach: Channels
    added: Covariance
    variance: Channels
    sensor: Channels
    memory: Channels


def is_rate(channels: int) -> Bool[np.ndarray, " channels"]:
    """Which channels are body rates; the others are specific force."""
    return np.arange(channels) < RATES


def transition(time_constant: Float[Array, "channels *segments"], dt: Float[Array, "..."]) -> tuple[Array, Array]:
    """The share of a disturbance that remains after one sample, and what a unit of it adds: see `Step`."""
    share = dt / time_constant
    rate = is_rate(len(time_constant)).reshape(-1, *(1,) * (time_constant.ndim - 1))
    return jnp.exp(-share), -time_constant * jnp.expm1(-share) / jnp.where(rate, 1.0, dt)


def step_of(noise: LogNoise, dt: Float[Array, "..."]) -> Step:
    """The step over one sample of this length, exact for an Ornstein-Uhlenbeck process."""
    strength, time_constant, sensor = (leaf.reshape(leaf.shape[0], -1) for leaf in noise)
    variance, tau = jnp.exp(2 * strength), jnp.exp(time_constant)
    share, (kept, reach) = dt / tau, transition(tau, dt)
    lost, lost_twice = -jnp.expm1(-share), -jnp.expm1(-2 * share)
    # For long time constants a difference of nearly equal numbers, and so its Taylor series.
    series = share**3 / 3 * (1 - share * (3 / 4 - share * (7 / 20 - share * (1 / 8 - share * (31 / 840)))))
    spread = jnp.where(share < _SHORT, series, share - 2 * lost + lost_twice / 2)
    rate = is_rate(strength.shape[0])[:, None]
    unit = jnp.where(rate, 1.0, 1 / dt)
    added = Covariance(
        2 * variance * jnp.square(tau * unit) * spread, variance * tau * unit * lost**2, variance * lost_twice
    )
    memory = jnp.broadcast_to(as_float(rate), variance.shape)
    return Step(kept, reach, added, variance, jnp.exp(2 * sensor), memory)


def _measure(p: Covariance, is_measured: Bool[Array, "channels segments"], step: Step) -> tuple[Covariance, "Gains"]:
    """The covariance after a measurement, and the gains that belong to it."""
    variance = p.rate + step.sensor
    weight = jnp.where(is_measured, 1 / variance, 0.0)
    # The share that remains, without a difference of large numbers.
    kept = jnp.where(is_measured, step.sensor / variance, 1.0)
    disturbance = p.cross * weight
    after = Covariance(p.rate * kept, p.cross * kept, p.disturbance - p.cross * disturbance)
    return after, Gains(p.rate * weight, disturbance, jnp.where(is_measured, variance, 1.0))


def _predict(p: Covariance, step: Step) -> Covariance:
    """The covariance one sample later."""
    reach, kept, added, memory = step.reach, step.kept, step.added, step.memory
    return Covariance(
        memory * (p.rate + 2 * reach * p.cross) + reach**2 * p.disturbance + added.rate,
        kept * (memory * p.cross + reach * p.disturbance) + added.cross,
        kept**2 * p.disturbance + added.disturbance,
    )


def first_covariance(step: Step, segments: int) -> Covariance:
    """The covariance before the first measurement of a segment whose rates are known then."""
    zero = jnp.zeros((step.variance.shape[0], segments), dtype=float)
    begin = Covariance(zero, zero, zero + step.variance)
    return jax.tree.map(lambda now, later: jnp.where(step.memory > 0, now, later), begin, _predict(begin, step))


def next_gains(
    p: Covariance, step: Step, is_measured: Bool[Array, "channels segments"], restart: Bool[Array, " segments"]
) -> tuple[Covariance, Gains]:
    """The covariance one sample later, and the gains of this sample, from the covariance before it."""
    # After a restart the rates are unknown. XLA takes no longer than if this came before the loop.
    first = first_covariance(step, p.rate.shape[-1])
    first = first._replace(rate=first.rate + step.memory * _UNKNOWN_RATE**2)
    p = jax.tree.map(lambda anew, known: jnp.where(restart, anew, known), first, p)
    p, gains = _measure(p, is_measured, step)
    return _predict(p, step), gains


def gains_of(observed: Observed, noise: LogNoise, dt: Scalar) -> Gains:
    """The gains of the filters of all channels."""
    step = step_of(noise, dt)
    first = first_covariance(step, observed.measured.shape[-1])
    return jax.lax.scan(
        lambda p, row: next_gains(p, step, *row), first, (~jnp.isnan(observed.measured), observed.restart)
    )[1]


def basis(noise: LogNoise) -> LogNoise:
    """The three directions of `noise`: in each, the same logarithm of all channels changes."""
    shape = noise.strength.shape
    return LogNoise(*np.eye(3).reshape(3, 3, *(1 for _ in shape)) * np.ones(shape))


@jax.jit  # traced once, although many ask for it
def first_noise(measured: Float[Array, "samples channels"], dt: Scalar, time_constant: Scalar) -> LogNoise:
    """Rough noise levels from differences of the measurements. `time_constant`: of all disturbances [s]."""

    def power(values: Float[Array, "rows channels"]) -> Float[Array, " channels"]:
        known = ~jnp.isnan(values)
        return jnp.where(known, jnp.square(values), 0.0).sum(axis=0) / jnp.maximum(known.sum(axis=0), 1)

    def logarithm(values: Float[Array, " channels"]) -> Float[Array, " channels"]:
        return jnp.log(jnp.where((values > 0) & jnp.isfinite(values), values, 1.0))

    # White noise has second differences of 6 times its variance.
    sensor = jnp.sqrt(power(jnp.diff(measured, n=2, axis=0)) / 6)
    change = jnp.sqrt(power(jnp.diff(measured, axis=0))) / dt / 2
    mean = jnp.nansum(measured, axis=0) / jnp.maximum((~jnp.isnan(measured)).sum(axis=0), 1)
    spread = jnp.sqrt(power(measured - mean)) / 2
    strength = jnp.where(is_rate(measured.shape[1]), change, spread)
    return LogNoise(logarithm(strength), jnp.full(strength.shape, jnp.log(time_constant)), logarithm(sensor))
