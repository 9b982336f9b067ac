"""The noise of filter error, and the gains of its Kalman filters. The gains depend on no parameter.

A disturbance d acts in each channel. It is an Ornstein-Uhlenbeck process, d' = -d / tau + white noise. On a body rate x
it acts as an angular acceleration [rad/s^2], x' = d. On a specific force it acts through a low-pass filter, because
gusts and rotors answer smoothly: the force per mass [m/s^2] is x, with x' = (d - x) / smoothing.

A measurement is the mean over a part of its sample (`AveragingWindow`). A filter estimates x and d at the beginning of
a sample. With the noise within the sample, they determine x and d at its end, and the measurement. The joint covariance
of these three is exact, so innovations of the right model are white at every sample time. In names, `driven` stands for
x, and `disturbance` for d.

Arrays have the axes (time, channels, segments). A segment is one part of the flight.
"""

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._custom_types import Numeric, Scalar
from ..models.state import CHANNELS

PerSegment = Float[Array, " segments"]
Channels = Float[Array, "channels segments"]
Times = Float[Array, "channels *segments"]
Series = Float[Array, "time channels segments"]
T = TypeVar("T")

RATE_COUNT = CHANNELS["rates"]
"""The number of body rates, which come first among the channels."""
# Standard deviation of the rates before the first measurement of a segment [rad/s]: as good as unknown.
_UNKNOWN_RATE = 1e3
# Nodes of the quadrature over each part of a sample: exact to nine digits, as a part has at most four time constants.
_NODES = 8
# The time constant of the low-pass filter of a force that has none [s].
_NO_FILTER = 1e-9


# The part of a sample over which a measurement is averaged: beginning and length [s]; a length of 0: an instant.
AveragingWindow = tuple[Scalar | float, Scalar | float]
INSTANT: AveragingWindow = (0.0, 0.0)
"""A measurement at the beginning of its sample."""


class LogNoise(NamedTuple):
    """The logarithms of each channel's noise levels, which may have any sign; common to all segments, or of each.

    - `strength`: standard deviation of the disturbance [rad/s^2] for rates, and of x [m/s^2] for specific force.
    - `time_constant`: of the disturbance [s].
    - `sensor`: standard deviation of the sensor's white noise, in the unit of the channel.
    - `smoothing`: the time constant of the low-pass filter of a specific force [s]; without meaning for a rate. `None`:
      no filter, so that the disturbance itself is the force.
    """

    strength: Float[Numeric, "channels *segments"]
    time_constant: Float[Numeric, "channels *segments"]
    sensor: Float[Numeric, "channels *segments"]
    smoothing: Float[Numeric, "channels *segments"] | None = None


class Gains(NamedTuple):
    """The effect of a unit of innovation, and the variance of the innovation.

    - `driven`, `disturbance`: the gain on x and on d at the beginning of the sample.
    - `driven_later`: the additional effect on x at the end. `disturbance_later`: the effect on d at the end.
    """

    driven: Series
    disturbance: Series
    driven_later: Series
    disturbance_later: Series
    variance: Series


class Covariance(NamedTuple):
    """Variance of x, covariance of x and d, and variance of d."""

    driven: Channels
    cross: Channels
    disturbance: Channels


class Transition(NamedTuple):
    """The propagation of d and x over one sample, without noise.

    - `kept`, `driven_kept`: the shares of d and of x that remain. `driven_by`: the change of x for a unit of d.
    """

    kept: Channels
    driven_kept: Channels
    driven_by: Channels

    @classmethod
    def of(cls, noise: LogNoise, dt: Float[Array, "..."]) -> "Transition":
        """The propagation over one sample of this length."""
        tau, fast = _times(noise)
        return cls(jnp.exp(-dt / tau), _x_from_x(fast, dt), _x_from_d(tau, fast, dt))


class Step(NamedTuple):
    """The disturbance over one sample, of each channel.

    - `transition`: propagates the disturbance over one sample, without noise.
    - `driven_seen`, `seen`: the change of the measurement for a unit of x and of d.
    - `since_seen`: what is left of x at the end of the sample, for each unit by which x changes the measurement.
    - `added`: the covariance that the disturbance's noise adds at the end of the sample.
    - `noise`: the variance that the disturbance's noise adds to the measurement; `with_driven`, `with_disturbance`: the
      covariance of this part of the measurement with x and d at the end.
    - `first`: the covariance before anything is measured; rates are known. `sensor`: the variance of the sensor noise.
    """

    transition: Transition
    driven_seen: Channels
    seen: Channels
    since_seen: Channels
    added: Covariance
    noise: Channels
    with_driven: Channels
    with_disturbance: Channels
    first: Covariance
    sensor: Channels


def is_rate(channels: Float[Numeric, "channels *rest"]) -> Bool[np.ndarray, "channels *ones"]:
    """Which rows of an array are of body rates; the others are of specific force."""
    return (np.arange(len(channels)) < RATE_COUNT).reshape(-1, *(1,) * (channels.ndim - 1))


def _times(noise: LogNoise) -> tuple[Times, Times]:
    """The time constants [s] of a channel's disturbance d, and of the low-pass filter from d to x."""
    tau = jnp.exp(noise.time_constant)
    if noise.smoothing is None:
        return tau, jnp.full_like(tau, _NO_FILTER)
    return tau, jnp.where(is_rate(tau), _NO_FILTER, jnp.exp(noise.smoothing))


def _x_from_x(fast: Times, time: Array) -> Array:
    """The response of x to x after a time [s]."""
    return jnp.where(is_rate(fast), 1.0, jnp.exp(-time / fast))


def _x_from_d(tau: Times, fast: Times, time: Array) -> Array:
    """The response of x to d after a time [s]."""
    force = tau / (tau - fast) * (jnp.exp(-time / tau) - jnp.exp(-time / fast))
    return jnp.where(is_rate(tau), -tau * jnp.expm1(-time / tau), force)


def step_of(noise: LogNoise, dt: Float[Array, "..."], window: AveragingWindow = INSTANT) -> Step:
    """The step over one sample of this length. Measurements are means over `window`."""
    noise = jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[0], -1), noise)
    (tau, fast), variance = _times(noise), jnp.exp(2 * noise.strength)
    rate = is_rate(tau)
    # `strength` is the standard deviation of a force; its disturbance has a larger one.
    drive = jnp.where(rate, variance, variance * (tau + fast) / tau)
    begin, length = window
    begin, end = jnp.asarray(begin, dtype=float), jnp.asarray(begin + length, dtype=float)
    long = jnp.where(length > 0, length, 1.0)

    def integral(time: Array) -> Array:
        """The response of the integral of x to d after a time [s]."""
        slow, quick = (-x * jnp.expm1(-time / x) for x in (tau, fast))
        return jnp.where(rate, tau * (time - slow), tau * (slow - quick) / (tau - fast))

    def measured(time: Array) -> Array:
        """The change of the measurement for a unit of d at this time of the sample."""
        until_begin, until_end = jnp.maximum(begin - time, 0.0), jnp.maximum(end - time, 0.0)
        mean = (integral(until_end) - integral(until_begin)) / long
        return jnp.where(length > 0, mean, _x_from_d(tau, fast, until_begin))

    # The parts of the sample before, in and after the window, and the nodes of a quadrature in each.
    edges = jnp.stack(jnp.broadcast_arrays(jnp.zeros_like(begin), begin, end, dt))
    nodes, weights = (x.reshape(-1, *(1,) * edges.ndim) for x in np.polynomial.legendre.leggauss(_NODES))
    parts = edges[1:] - edges[:-1]
    time = (edges[:-1] + (nodes + 1) / 2 * parts).reshape(-1, 1, *edges.shape[1:] or (1,))
    share = (weights / 2 * parts).reshape(time.shape) * 2 * drive / tau
    x, d, m = _x_from_d(tau, fast, dt - time), jnp.exp(-(dt - time) / tau), measured(time)
    products = x * x, x * d, d * d, m * m, m * x, m * d
    x_x, x_d, d_d, m_m, m_x, m_d = ((share * each).sum(axis=0) for each in products)
    # The mean over the window of the share of x that remains. It is finite for every filter.
    in_window = jnp.where(length > 0, length, 0.0) / fast
    mean = jnp.where(in_window > 0, -jnp.expm1(-in_window) / jnp.where(in_window > 0, in_window, 1.0), 1.0)
    force = jnp.where(rate, 0.0, variance)
    return Step(
        transition=Transition.of(noise, dt),
        driven_seen=jnp.where(rate, 1.0, _x_from_x(fast, begin) * mean),
        seen=measured(jnp.zeros_like(begin)),
        since_seen=jnp.where(rate, 1.0, _x_from_x(fast, dt - begin) / mean),
        added=Covariance(x_x, x_d, d_d),
        noise=m_m,
        with_driven=m_x,
        with_disturbance=m_d,
        first=Covariance(force, force, drive),
        sensor=jnp.exp(2 * noise.sensor),
    )


def first_covariance(step: Step, segments: int) -> Covariance:
    """The covariance at the beginning of a segment whose rates are known."""
    return jax.tree.map(lambda leaf: jnp.zeros((leaf.shape[0], segments), dtype=float) + leaf, step.first)


def next_gains(
    p: Covariance, step: Step, is_measured: Bool[Array, "channels segments"], restart: Bool[Array, " segments"]
) -> tuple[Covariance, Gains]:
    """The covariance one sample later, and the gains of this sample, from the covariance at its beginning."""
    # After a restart the rates are unknown. Inside the loop this costs no time.
    first = first_covariance(step, p.driven.shape[-1])
    first = first._replace(driven=first.driven + jnp.where(is_rate(first.driven), _UNKNOWN_RATE**2, 0.0))
    driven, cross, disturbance = jax.tree.map(lambda anew, known: jnp.where(restart, anew, known), first, p)
    (kept, _, driven_by), seen, since = step.transition, step.seen, step.since_seen
    # Covariances with the measurement, and with `gap`: x at the end minus `since` times the measurement. The gap does
    # not depend on x at the beginning, whose variance may be huge. So no difference of large numbers is computed.
    driven_seen = step.driven_seen * driven + seen * cross
    disturbance_seen = step.driven_seen * cross + seen * disturbance
    own = seen * disturbance_seen + step.noise
    measured = step.driven_seen * driven_seen + own
    lead = driven_by - since * seen
    gap_seen = lead * disturbance_seen + step.with_driven - since * step.noise
    gap = lead**2 * disturbance + step.added.driven - since * (2 * step.with_driven - since * step.noise)
    later_seen = kept * disturbance_seen + step.with_disturbance
    gap_later = kept * lead * disturbance + step.added.cross - since * step.with_disturbance
    later = kept**2 * disturbance + step.added.disturbance
    variance = measured + step.sensor
    weight = jnp.where(is_measured, 1 / variance, 0.0)
    share = jnp.where(is_measured, step.sensor / variance, 1.0)
    after = Covariance(
        share * since * (since * measured + 2 * gap_seen) + gap - weight * gap_seen**2,
        share * since * later_seen + gap_later - weight * gap_seen * later_seen,
        later - weight * later_seen**2,
    )
    gains = Gains(
        driven_seen * weight,
        disturbance_seen * weight,
        (since * own + gap_seen) * weight,
        later_seen * weight,
        jnp.where(is_measured, variance, 1.0),
    )
    return after, gains


def basis(unknowns: T) -> T:
    """The directions of derivatives: in each direction, one unknown changes by 1 in all channels."""
    leaves, tree = jax.tree.flatten(unknowns)
    directions = np.eye(len(leaves))
    rows = zip(directions, leaves, strict=True)
    return tree.unflatten([np.multiply.outer(row, np.ones(leaf.shape)) for row, leaf in rows])


# The changes of the estimates at the end of a sample for a unit of each input innovation: of the rate [rad/s], or the
# force besides the model's [m/s^2]; and of the disturbance [rad/s^2], or [m/s^2].
OfInputs = tuple[Float[Array, " channels *segments"], ...]
InputGains = tuple[OfInputs, OfInputs]


class Feedback(NamedTuple):
    """The parts of a filter that depend on the noise, by channel: its `Gains`, `InputGains`, and fields of `Step`."""

    driven: tuple[PerSegment, ...]
    driven_later: tuple[PerSegment, ...]
    disturbance_later: tuple[PerSegment, ...]
    driven_seen: tuple[PerSegment, ...]
    seen: tuple[PerSegment, ...]
    kept: tuple[PerSegment, ...]
    driven_kept: tuple[PerSegment, ...]
    driven_by: tuple[PerSegment, ...]
    input_gains: InputGains

    @classmethod
    def of(cls, gains: Gains, step: Step, input_gains: InputGains) -> "Feedback":
        """The feedback by these gains, over one step."""
        fields = gains.driven, gains.driven_later, gains.disturbance_later, step.driven_seen, step.seen
        return cls(*map(tuple, (*fields, *step.transition)), input_gains=input_gains)


def by_inputs(gains: tuple[Array, ...], inputs: Float[Array, "feedthroughs channels segments"]) -> Channels:
    """The change of an estimate by input innovations, by channel."""
    each = (v * (k if k.ndim > 1 else k[:, None]) for k, v in zip(gains, inputs, strict=True))
    return sum(each, jnp.zeros(inputs.shape[1:], dtype=float))


def feedback_slopes(gains: Gains, steps: Step, input_gains: InputGains, count: int) -> Feedback:
    """The derivatives of the feedback: 0 in `count` parameters, then in the noise and in the gains of inputs."""
    levels, units = gains.variance.shape[0], basis(input_gains)
    of_noise = jax.tree.map(lambda leaf: jnp.zeros((levels, *leaf.shape[1:]), leaf.dtype), units)
    some, more = jax.vmap(Feedback.of)(gains, steps, of_noise), len(jax.tree.leaves(input_gains))

    def padded(before: int, after: int, tree: Any) -> Any:
        return jax.tree.map(lambda leaf: jnp.pad(leaf, ((before, after), *((0, 0),) * (leaf.ndim - 1))), tree)

    inputs = padded(count, 0, jax.tree.map(lambda a, b: jnp.concatenate([a, b]), of_noise, units))
    return padded(count, more, some)._replace(input_gains=inputs)
