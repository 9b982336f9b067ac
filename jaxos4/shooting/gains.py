"""The noise of filter error, its unknowns, and the gains of its Kalman filters, which depend on no parameter.

A disturbance d acts in each channel: on a body rate as an angular acceleration [rad/s^2], on a specific force as a
force per mass [m/s^2]. It is an Ornstein-Uhlenbeck process, d' = -d / tau + white noise, with the standard deviation s.

A measurement is the mean over a window of its sample (`Window`). The filter of a body rate knows the rate and the
disturbance at the beginning of a sample. From them and from the noise within the sample follow three numbers: rate and
disturbance at its end, and what is measured. Their joint covariance is exact, so innovations of the right model are
white at every sample time. The filter of a specific force knows the disturbance alone.

Arrays have the axes (time, channels, segments). A segment is one part of the flight.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._custom_types import Numeric, Scalar
from ..bracket import PROPER_PRIOR
from ..models.state import CHANNELS
from .abstract import Unknowns

Channels = Float[Array, "channels segments"]
Series = Float[Array, "time channels segments"]

RATES = CHANNELS["rates"]
"""The number of body rates, which come first among the channels."""
# Standard deviation of the rates before the first measurement of a segment [rad/s]: as good as unknown.
_UNKNOWN_RATE = 1e3
# Nodes of the quadrature over each part of a sample: exact to rounding, as it is shorter than four time constants.
_NODES = 8


class Window(NamedTuple):
    """The part of a sample over which a measurement is averaged: from `begin` on, for `length` [s]; 0: an instant."""

    begin: Scalar | float = 0.0
    length: Scalar | float = 0.0


INSTANT = Window()
"""A measurement at the beginning of its sample."""


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
    """The effect of a unit of innovation, and the variance of the innovation.

    - `rate`, `disturbance`: at the beginning of the sample.
    - `rate_later`: at the end, besides `rate`. `disturbance_later`: at the end.
    """

    rate: Series
    disturbance: Series
    rate_later: Series
    disturbance_later: Series
    variance: Series


class Covariance(NamedTuple):
    """Variance of the rate, covariance of rate and disturbance, variance of the disturbance."""

    rate: Channels
    cross: Channels
    disturbance: Channels


class Step(NamedTuple):
    """The disturbance over one sample, of each channel.

    - `kept`: the share of it that remains. `reach`: what a unit of it adds to the rate; of a specific force, its mean.
    - `seen`: what a unit of it adds to the measurement.
    - `added`: the covariance that its noise adds at the end of the sample.
    - `noise`: the variance that its noise adds to the measurement; `with_rate`, `with_disturbance`: the covariance with
      the rate and the disturbance at the end.
    - `variance`: of the disturbance. `sensor`: of the sensor's noise.
    - `memory`: 1 for a rate; 0 for a specific force, which has no state besides its disturbance.
    """

    kept: Channels
    reach: Channels
    seen: Channels
    added: Covariance
    noise: Channels
    with_rate: Channels
    with_disturbance: Channels
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


def step_of(noise: LogNoise, dt: Float[Array, "..."], window: Window = INSTANT) -> Step:
    """The step over one sample of this length. Measurements are means over `window`."""
    strength, time_constant, sensor = (leaf.reshape(leaf.shape[0], -1) for leaf in noise)
    variance, tau = jnp.exp(2 * strength), jnp.exp(time_constant)
    rate = jnp.broadcast_to(is_rate(strength.shape[0])[:, None], variance.shape)
    begin, end = jnp.asarray(window.begin, dtype=float), jnp.asarray(window.begin + window.length, dtype=float)
    long = jnp.where(window.length > 0, window.length, 1.0)

    # What a unit of the disturbance makes after a time: disturbance, rate, and the integral of the rate.
    def faded(time: Array) -> Array:
        return jnp.exp(-time / tau)

    def turned(time: Array) -> Array:
        return -tau * jnp.expm1(-time / tau)

    def swept(time: Array) -> Array:
        return tau * (time - turned(time))

    def measured(time: Array) -> Array:
        """By a unit of the disturbance at this time of the sample."""
        until_begin, until_end = jnp.maximum(begin - time, 0.0), jnp.maximum(end - time, 0.0)
        mean = jnp.where(rate, swept(until_end) - swept(until_begin), turned(until_end) - turned(until_begin)) / long
        instant = jnp.where(rate, turned(until_begin), faded(until_begin) * (time <= begin))
        return jnp.where(window.length > 0, mean, instant)

    def moved(time: Array) -> Array:
        return jnp.where(rate, turned(dt - time), turned(dt - time) / dt)

    # The parts of the sample before, in and after the window, and the nodes of a quadrature in each.
    edges = jnp.stack(jnp.broadcast_arrays(jnp.zeros_like(begin), begin, end, dt))
    nodes, weights = (x.reshape(-1, *(1,) * edges.ndim) for x in np.polynomial.legendre.leggauss(_NODES))
    parts = edges[1:] - edges[:-1]
    time = (edges[:-1] + (nodes + 1) / 2 * parts).reshape(-1, 1, *edges.shape[1:] or (1,))
    share = (weights / 2 * parts).reshape(time.shape) * 2 * variance / tau
    x, d, m = moved(time), faded(dt - time), measured(time)
    products = x * x, x * d, d * d, m * m, m * x, m * d
    x_x, x_d, d_d, m_m, m_x, m_d = ((share * each).sum(axis=0) for each in products)
    kept, reach = transition(tau, dt)
    return Step(
        kept=kept,
        reach=reach,
        seen=measured(jnp.zeros_like(begin)),
        added=Covariance(x_x, x_d, d_d),
        noise=m_m,
        with_rate=m_x,
        with_disturbance=m_d,
        variance=variance,
        sensor=jnp.exp(2 * sensor),
        memory=rate.astype(variance.dtype),
    )


def first_covariance(step: Step, segments: int) -> Covariance:
    """The covariance at the beginning of a segment whose rates are known."""
    zero = jnp.zeros((step.variance.shape[0], segments), dtype=float)
    return Covariance(zero, zero, zero + step.variance)


def next_gains(
    p: Covariance, step: Step, is_measured: Bool[Array, "channels segments"], restart: Bool[Array, " segments"]
) -> tuple[Covariance, Gains]:
    """The covariance one sample later, and the gains of this sample, from the covariance at its beginning."""
    # After a restart the rates are unknown. XLA takes no longer than if this came before the loop.
    first = first_covariance(step, p.rate.shape[-1])
    first = first._replace(rate=first.rate + step.memory * _UNKNOWN_RATE**2)
    rate, cross, disturbance = jax.tree.map(lambda anew, known: jnp.where(restart, anew, known), first, p)
    kept, seen = step.kept, step.seen
    # Covariances with the measurement, and with `gap`: the rate at the end less the measurement. The gap does not
    # depend on the rate at the beginning, whose variance may be huge. So no difference of large numbers is computed.
    rate_seen = step.memory * rate + seen * cross
    disturbance_seen = step.memory * cross + seen * disturbance
    own = seen * disturbance_seen + step.noise
    measured = step.memory * rate_seen + own
    lead = step.reach - seen
    gap_seen = lead * disturbance_seen + step.with_rate - step.noise
    gap = lead**2 * disturbance + step.added.rate - 2 * step.with_rate + step.noise
    later_seen = kept * disturbance_seen + step.with_disturbance
    gap_later = kept * lead * disturbance + step.added.cross - step.with_disturbance
    later = kept**2 * disturbance + step.added.disturbance
    variance = measured + step.sensor
    weight = jnp.where(is_measured, 1 / variance, 0.0)
    share = jnp.where(is_measured, step.sensor / variance, 1.0)
    after = Covariance(
        step.memory * (share * (measured + 2 * gap_seen) + gap - weight * gap_seen**2),
        step.memory * (share * later_seen + gap_later - weight * gap_seen * later_seen),
        later - weight * later_seen**2,
    )
    gains = Gains(
        step.memory * rate_seen * weight,
        disturbance_seen * weight,
        step.memory * (own + gap_seen) * weight,
        later_seen * weight,
        jnp.where(is_measured, variance, 1.0),
    )
    return after, gains


def gains_of(observed: Observed, noise: LogNoise, dt: Scalar, window: Window = INSTANT) -> Gains:
    """The gains of the filters of all channels."""
    step = step_of(noise, dt, window)
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


class NoiseUnknowns(NamedTuple):
    """How the noise of each channel is looked for: the logarithms of a strength, a time constant and a sensor's noise.

    - `precision`: of a weak prior on each logarithm, as the reciprocal of a variance.
    - `stride`: the cost is roughly quadratic in a logarithm over such a step.
    - `reach`: factor to either side of the first noise levels; large, as simulated flights have no disturbance.
    - `times`: time constants of the disturbance at which searches start [s]: the likelihood has several maxima.
    - `shortest`, `longest`: of the time constants, in samples and in seconds.
    - `shortest_of_force`: of a disturbance of specific force [s]: what is faster is vibration, a noise of the sensor.
    """

    precision: float = 1e-2
    stride: float = 1.0
    reach: float = 1e8
    times: tuple[float, ...] = (0.2, 0.03)
    shortest: float = 0.25
    longest: float = 3.0
    shortest_of_force: float = 0.25

    def after(
        self,
        own: Unknowns,
        channels: tuple[str, ...],
        feedthroughs: int,
        measured: Float[Array, "samples channels"],
        dt: Scalar,
        least_noise: Float[Array, " channels"],
    ) -> Unknowns:
        """The parameters, then noise and feedthroughs of each channel, in brackets from differences of measurements."""
        first = jnp.stack(first_noise(measured, dt, self.times[0]), axis=1)
        lowest, highest = first - np.log(self.reach), first + np.log(self.reach)
        shortest = jnp.where(is_rate(first.shape[0]), jnp.log(self.shortest * dt), np.log(self.shortest_of_force))
        lowest, highest = lowest.at[:, 1].set(shortest), highest.at[:, 1].set(np.log(self.longest))
        lowest = lowest.at[:, 2].max(jnp.log(jnp.maximum(least_noise, jnp.finfo(float).tiny)))
        first, lowest, highest = (
            jnp.pad(x, ((0, 0), (0, feedthroughs)), constant_values=value)
            for x, value in ((first, 0.0), (lowest, -np.inf), (highest, np.inf))
        )
        names = tuple(each.format(name) for name in channels for each in own_names(feedthroughs))
        precision = jnp.full(first.size, self.precision)
        return Unknowns(
            names=own.names + names,
            units=own.units + tuple("1" if name.startswith("log") else "rad/s" for name in names),
            parameters=own.count,
            prior=PROPER_PRIOR,
            center=jnp.concatenate([own.center, first.ravel()]),
            half_width=jnp.concatenate([own.half_width, 1 / jnp.sqrt(precision)]),
            free=jnp.concatenate([own.free, jnp.ones(first.size, dtype=bool)]),
            precision=jnp.concatenate([1 / jnp.square(own.usable.half_width), precision]),
            lowest=jnp.concatenate([own.lowest, lowest.ravel()]),
            highest=jnp.concatenate([own.highest, highest.ravel()]),
            stride=jnp.concatenate([own.stride, jnp.full(first.size, self.stride)]),
        )


def own_names(feedthroughs: int) -> tuple[str, ...]:
    """The names of the unknowns of a channel, with its name to be filled in."""
    more = tuple(f"{{}}_feedthrough_{i + 1}" for i in range(feedthroughs))
    return ("log_{}_strength", "log_{}_time", "log_{}_sensor", *more)
