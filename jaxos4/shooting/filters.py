"""The Kalman filters of filter error. Each estimates a disturbance that the model lacks.

A disturbance d acts in each channel: on a body rate as an angular acceleration [rad/s^2], on a specific force as a
force per mass [m/s^2]. It is an Ornstein-Uhlenbeck process, d' = -d / tau + white noise, with the standard deviation s.
The filter of a body rate knows the rate and its disturbance; that of a specific force knows its disturbance. Channels
share no covariance, and the covariances do not depend on the parameters of the model. So the gains are computed first,
and then the innovations.

Arrays have the axes (time, channels, segments). A segment is one part of the flight.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._custom_types import Count, Numeric, Parameters, Scalar
from ..models.state import Forcing, Rates, State
from .scans import FASTEST

Segments = Float[Array, " segments"]
Channels = Float[Array, "channels segments"]
Series = Float[Array, "time channels segments"]
Scalars = tuple[Scalar, ...]
Move = Callable[[State, Forcing, Scalars], State]
Observe = Callable[[State, Forcing, Scalars], Scalars]
# A row of `Observed`: measured, restart.
_Row = tuple[Channels, Bool[Array, " segments"]]

LAGS = 8
"""The largest lag at which innovations are compared, in samples."""

BLOCK = 32
"""The number of rows that are filtered before their likelihood is summed."""

# The number of body rates, which come first among the channels.
_RATES = 3
# Standard deviation of the rates before the first measurement of a segment [rad/s]: as good as unknown.
_UNKNOWN_RATE = 1e3
# The sample time over the time constant below which a Taylor series is more exact.
_SHORT = 0.03


class LogNoise(NamedTuple):
    """The logarithms of each channel's noise levels. Logarithms may have any sign.

    - `strength`: standard deviation of the disturbance, [rad/s^2] for rates and [m/s^2] for specific force.
    - `time_constant`: of the disturbance [s].
    - `sensor`: standard deviation of the sensor's white noise, in the unit of the channel.
    """

    strength: Float[Numeric, " channels"]
    time_constant: Float[Numeric, " channels"]
    sensor: Float[Numeric, " channels"]


class Observed(NamedTuple):
    """What was measured, in segments.

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
    """What a unit of innovation adds to rate and disturbance, and the variance of the innovation."""

    rate: Series
    disturbance: Series
    variance: Series


class Innovations(NamedTuple):
    """The innovations of each segment and their negative log-likelihood.

    The unknowns of a channel are the parameters, and then its own `LogNoise`.

    - `sound`: whether the rates stay below `FASTEST`.
    - `information`: the Fisher information.
    - `products`: sums of the products of standardised innovations 0 to `LAGS` samples apart.
    """

    cost: Segments
    sound: Bool[Array, " segments"]
    gradient: Float[Array, "channels unknowns segments"]
    information: Float[Array, "channels unknowns unknowns segments"]
    products: Float[Array, "channels lags segments"]


class _Covariance(NamedTuple):
    """Of the rate, of rate and disturbance, and of the disturbance."""

    rate: Channels
    cross: Channels
    disturbance: Channels


class _Step(NamedTuple):
    """The disturbance over one sample, of each channel.

    - `kept`: the share of it that remains. `reach`: what a unit of it adds to the rate.
    - `added`: the covariance that its noise adds.
    - `variance`: of the disturbance. `sensor`: of the sensor's noise.
    """

    kept: Channels
    reach: Channels
    added: _Covariance
    variance: Channels
    sensor: Channels


def transition(time_constant: Float[Array, "*channels"], dt: Scalar) -> tuple[Array, Array]:
    """The share of a disturbance that remains after one sample, and what a unit of it adds to the rate [s]."""
    share = dt / time_constant
    return jnp.exp(-share), -time_constant * jnp.expm1(-share)


def _is_rate(channels: int) -> Bool[np.ndarray, "channels 1"]:
    """Which channels are body rates; the others are specific force."""
    return np.arange(channels)[:, None] < _RATES


def _step_of(noise: LogNoise, dt: Scalar) -> _Step:
    """Exact for an Ornstein-Uhlenbeck process."""
    strength, time_constant, sensor = (leaf[:, None] for leaf in noise)
    variance, tau = jnp.exp(2 * strength), jnp.exp(time_constant)
    share, (kept, reach) = dt / tau, transition(tau, dt)
    lost, lost_twice = -jnp.expm1(-share), -jnp.expm1(-2 * share)
    is_rate = _is_rate(strength.shape[0])
    # For long time constants a difference of nearly equal numbers, and so its Taylor series.
    series = share**3 / 3 * (1 - share * (3 / 4 - share * (7 / 20 - share * (1 / 8 - share * (31 / 840)))))
    spread = jnp.where(share < _SHORT, series, share - 2 * lost + lost_twice / 2)
    rate = jnp.where(is_rate, 2 * variance * tau**2 * spread, 0.0)
    cross = jnp.where(is_rate, variance * tau * lost**2, 0.0)
    reach = jnp.where(is_rate, reach, 0.0)
    return _Step(kept, reach, _Covariance(rate, cross, variance * lost_twice), variance, jnp.exp(2 * sensor))


def _restart(p: _Covariance, restart: Bool[Array, " segments"], step: _Step) -> _Covariance:
    is_rate = _is_rate(p.rate.shape[0])
    return _Covariance(
        jnp.where(restart, jnp.where(is_rate, _UNKNOWN_RATE**2, 0.0), p.rate),
        jnp.where(restart, 0.0, p.cross),
        jnp.where(restart, step.variance, p.disturbance),
    )


def _measure(p: _Covariance, is_measured: Bool[Array, "channels segments"], step: _Step) -> tuple[_Covariance, "Gains"]:
    """The covariance after a measurement, and the gains that belong to it."""
    is_rate = _is_rate(p.rate.shape[0])
    variance = jnp.where(is_rate, p.rate, p.disturbance) + step.sensor
    weight = jnp.where(is_measured, 1 / variance, 0.0)
    # The share that remains, without a difference of large numbers.
    kept = jnp.where(is_measured, step.sensor / variance, 1.0)
    disturbance = jnp.where(is_rate, p.cross, p.disturbance) * weight
    after = _Covariance(
        p.rate * jnp.where(is_rate, kept, 1.0),
        p.cross * kept,
        jnp.where(is_rate, p.disturbance - p.cross * disturbance, p.disturbance * kept),
    )
    return after, Gains(p.rate * weight, disturbance, jnp.where(is_measured, variance, 1.0))


def _predict(p: _Covariance, step: _Step) -> _Covariance:
    """The covariance one sample later."""
    reach, kept, added = step.reach, step.kept, step.added
    return _Covariance(
        p.rate + 2 * reach * p.cross + reach**2 * p.disturbance + added.rate,
        kept * (p.cross + reach * p.disturbance) + added.cross,
        kept**2 * p.disturbance + added.disturbance,
    )


def gains_of(observed: Observed, noise: LogNoise, dt: Scalar) -> Gains:
    """The gains of the filters of all channels."""
    return _gains(_first_covariance(observed, noise, dt), noise, observed, dt)[1]


def _first_covariance(observed: Observed, noise: LogNoise, dt: Scalar) -> _Covariance:
    zero = jnp.zeros(observed.measured.shape[1:], dtype=float)
    return _Covariance(zero, zero, zero + _step_of(noise, dt).variance)


def _gains(p: _Covariance, noise: LogNoise, observed: Observed, dt: Scalar) -> tuple[_Covariance, Gains]:
    """The gains of some rows, and the covariance after them, from that before them."""
    step = _step_of(noise, dt)

    def body(p: _Covariance, row):
        is_measured, restart = row
        p, gain = _measure(_restart(p, restart, step), is_measured, step)
        return _predict(p, step), gain

    return jax.lax.scan(body, p, (~jnp.isnan(observed.measured), observed.restart))


def _basis(noise: LogNoise) -> LogNoise:
    """The three directions of `noise`: in each, the same logarithm of all channels changes."""
    return LogNoise(*np.eye(3)[:, :, None] * np.ones(noise.strength.shape[0]))


def _start(observed: Observed, zero: Channels) -> Channels:
    """The rates at the first sample; 0 if unknown."""
    return zero if observed.known is None else zero.at[:_RATES].set(observed.known)


class _Known(NamedTuple):
    """What the filters know before a measurement."""

    rates: Rates
    disturbance: tuple[Segments, ...]


class _Feedback(NamedTuple):
    """What the noise changes in a filter: its gains, and the disturbance over one sample."""

    rate: tuple[Segments, ...]
    disturbance: tuple[Segments, ...]
    reach: tuple[Scalar, ...]
    kept: tuple[Scalar, ...]


def _advance(
    move: Move, observe: Observe, known: _Known, forcing: Forcing, scalars: Scalars, feedback: _Feedback, row: _Row
) -> tuple[_Known, tuple[Segments, ...]]:
    """What is known one sample later, and the innovations of this sample."""
    y, restart = row
    known = jax.tree.map(lambda leaf: jnp.where(restart, 0.0, leaf), known)
    outputs = observe(State(known.rates), forcing, scalars)
    force = (h + d for h, d in zip(outputs[_RATES:], known.disturbance[_RATES:], strict=True))
    expected = (*outputs[:_RATES], *force)
    errors = tuple(jnp.where(jnp.isnan(z), 0.0, jnp.nan_to_num(z) - h) for z, h in zip(y, expected, strict=True))
    disturbance = tuple(
        d + gain * e for d, gain, e in zip(known.disturbance, feedback.disturbance, errors, strict=True)
    )
    rates = (x + gain * e for x, gain, e in zip(known.rates, feedback.rate, errors[:_RATES], strict=True))
    following = move(State(Rates(*rates)), forcing, scalars).rates
    pushed = (x + a * d for x, a, d in zip(following, feedback.reach, disturbance[:_RATES], strict=True))
    faded = tuple(share * d for share, d in zip(feedback.kept, disturbance, strict=True))
    return _Known(Rates(*pushed), faded), errors


class _Carry(NamedTuple):
    """The state of the filters between blocks of rows, each part with its derivatives, and the sums so far.

    - `covariance`: derivatives in the noise on the first axis. `known`: in all unknowns on the first axis.
    - `last`: the last `LAGS` standardised innovations.
    """

    covariance: tuple[_Covariance, _Covariance]
    known: tuple[_Known, _Known]
    last: Float[Array, "lags channels segments"]
    sums: Innovations


def innovate(
    move: Move,
    observe: Observe,
    observed: Observed,
    forcing: Forcing,
    parameters: Parameters,
    noise: LogNoise,
    dt: Scalar,
    *,
    rows: Count | int,
    forcing_tangents: Forcing | None,
    forcing_parameters: tuple[int, ...],
) -> Innovations:
    """Filter all segments. The likelihood of the innovations has derivatives in the parameters and in the noise.

    A change of one channel's noise is taken to change no other channel's innovations.

    **Arguments:**

    - `move`, `observe`: from a state, the forcing and the parameters, the state one sample later and the outputs of the
      sensors.
    - `observed`: its number of rows is a multiple of `BLOCK`.
    - `forcing`: leaves (time, segments). `forcing_tangents`: their derivatives (time, positions, segments) in the
      parameters at the positions `forcing_parameters`.
    - `rows`: how many rows are filtered; the others are padding. It is data, so that flights of different lengths share
      a program.
    """
    count, (time, channels, segments) = parameters.shape[0], observed.measured.shape
    unknowns, first = count + 3, _first_covariance(observed, noise, dt)
    push = jax.linearize(lambda noise: _first_covariance(observed, noise, dt), noise)[1]
    start = _start(observed, jnp.zeros((channels, segments), dtype=float))
    zero = jnp.zeros(segments, dtype=float)
    known = _Known(Rates(*start[:_RATES]), (zero,) * channels)
    nothing = Innovations(
        cost=zero,
        sound=jnp.ones(segments, dtype=bool),
        gradient=jnp.zeros((channels, unknowns, segments), dtype=float),
        information=jnp.zeros((channels, unknowns, unknowns, segments), dtype=float),
        products=jnp.zeros((channels, LAGS + 1, segments), dtype=float),
    )
    carry = _Carry(
        (first, jax.vmap(push)(_basis(noise))),
        (known, jax.tree.map(lambda leaf: jnp.zeros((unknowns, *leaf.shape), dtype=float), known)),
        jnp.zeros((LAGS, channels, segments), dtype=float),
        nothing,
    )
    filtered = functools.partial(
        _filter_rows, move, observe, parameters, noise, dt, np.asarray(forcing_parameters, int)
    )
    data = observed._replace(known=None), forcing, forcing_tangents
    blocks = jax.tree.map(lambda leaf: leaf.reshape(time // BLOCK, BLOCK, *leaf.shape[1:]), data)

    def block(i: Count, carry: _Carry) -> _Carry:
        return filtered(carry, *jax.tree.map(lambda leaf: leaf[i], blocks))

    return jax.lax.fori_loop(0, -(-rows // BLOCK), block, carry).sums


def _filter_rows(
    move: Move,
    observe: Observe,
    parameters: Parameters,
    noise: LogNoise,
    dt: Scalar,
    positions: np.ndarray,
    carry: _Carry,
    observed: Observed,
    forcing: Forcing,
    forcing_tangents: Forcing | None,
) -> _Carry:
    """The filters after some more rows. Other arguments as of `innovate`."""
    count, segments = parameters.shape[0], observed.measured.shape[2]
    scalars, basis = tuple(parameters), tuple(np.eye(count + 3, count, dtype=parameters.dtype).T)
    (at, gains), push = jax.linearize(lambda p, noise: _gains(p, noise, observed, dt), carry.covariance[0], noise)
    by_noise, gain_slopes = jax.vmap(push, out_axes=(0, 1))(carry.covariance[1], _basis(noise))
    covariance = at, by_noise
    advance = functools.partial(_advance, *(jax.vmap(each, in_axes=(0, 0, None)) for each in (move, observe)))

    def over_a_sample(noise: LogNoise) -> tuple[tuple[Scalar, ...], tuple[Scalar, ...]]:
        kept, reach = transition(jnp.exp(noise.time_constant), dt)
        return tuple(reach[:_RATES]), tuple(kept)

    (reach, kept), push = jax.linearize(over_a_sample, noise)
    by_noise = jax.vmap(push)(_basis(noise))
    by_noise = jax.tree.map(lambda slope: jnp.concatenate([jnp.zeros(count), slope]), by_noise)

    def body(carry, row):
        known, slopes, sound = carry
        forcing, tangents, gain, gain_slope, row = row
        for x in known.rates:
            sound = sound & ((jnp.abs(x) < FASTEST) | row[1])
        feedback = _Feedback(tuple(gain.rate[:_RATES]), tuple(gain.disturbance), reach, kept)
        by_gain = (tuple(jnp.moveaxis(leaf, 0, 1)) for leaf in (gain_slope.rate[:, :_RATES], gain_slope.disturbance))
        nothing = jnp.zeros((count, segments), dtype=float)
        by_gain = (tuple(jnp.concatenate([nothing, slope]) for slope in each) for each in by_gain)
        direction = _Feedback(*by_gain, *by_noise)
        at, directions = (known, scalars, feedback), (slopes, basis, direction)
        if tangents is not None:
            wide = jax.tree.map(lambda t: jnp.zeros((count + 3, segments), dtype=float).at[positions].set(t), tangents)
            at, directions = (*at, forcing), (*directions, wide)

        def step(known: _Known, scalars, feedback: _Feedback, forcing: Forcing = forcing):
            return advance(known, forcing, scalars, feedback, row)

        (known, errors), push = jax.linearize(step, *at)
        slopes, by_errors = jax.vmap(push)(*directions)
        return (known, slopes, sound), (jnp.stack(errors), jnp.stack(by_errors))

    rows = forcing, forcing_tangents, gains, gain_slopes, (observed.measured, observed.restart)
    (known, known_slopes, sound), (errors, slopes) = jax.lax.scan(body, (*carry.known, carry.sums.sound), rows)
    found, last = _likelihood(observed, gains, gain_slopes.variance, carry.last, sound, errors, slopes)
    sums = jax.tree.map(jnp.add, carry.sums, found)._replace(sound=sound)
    return _Carry(covariance, (known, known_slopes), last, sums)


def _likelihood(
    observed: Observed,
    gains: Gains,
    variance_slopes: Float[Array, "time 3 channels segments"],
    last: Float[Array, "lags channels segments"],
    sound: Bool[Array, " segments"],
    errors: Series,
    slopes: Float[Array, "time channels unknowns segments"],
) -> tuple[Innovations, Float[Array, "lags channels segments"]]:
    """The likelihood of innovations `errors` with the derivatives `slopes`, and the last standardised innovations."""
    count = slopes.shape[2] - 3
    counts = ~jnp.isnan(observed.measured) & observed.counts[:, None]
    weight = jnp.where(counts, 1 / gains.variance, 0.0)
    logarithm = jnp.where(counts, jnp.log(gains.variance), 0.0)
    relative = jnp.moveaxis(variance_slopes * weight[:, None], 1, 2)  # (time, channels, 3, segments)
    gradient = jnp.einsum("tcul,tcl->cul", slopes, weight * errors)
    surprise = (weight > 0) * (1 - weight * errors**2) / 2
    gradient = gradient.at[:, count:].add(jnp.einsum("tcul,tcl->cul", relative, surprise))
    information = jnp.einsum("tcul,tcvl->cuvl", slopes * weight[:, :, None], slopes)
    information = information.at[:, count:, count:].add(jnp.einsum("tcul,tcvl->cuvl", relative, relative) / 2)
    cost = (weight * errors**2 + logarithm).sum(axis=(0, 1)) / 2
    standard = jnp.concatenate([last, jnp.sqrt(weight) * errors])
    now = standard[LAGS:]
    products = [(now * standard[LAGS - lag : standard.shape[0] - lag]).sum(axis=0) for lag in range(LAGS + 1)]
    return Innovations(cost, sound, gradient, information, jnp.stack(products, axis=1)), standard[-LAGS:]
