"""The Kalman filters of filter error: innovations, their likelihood, and its derivatives.

The gains are computed first (`jaxos4.shooting.gains`), and then the innovations, block by block of rows.

Arrays have the axes (time, channels, segments). A segment is one part of the flight.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Count, Scalar
from ..batching import computed_once
from ..models.state import Forcing, Rates, State
from .gains import (
    RATE_COUNT,
    AveragingWindow,
    Channels,
    Feedback,
    InputGains,
    LogNoise,
    PerSegment,
    Series,
    Step,
    basis,
    by_inputs,
    feedback_slopes,
    first_covariance,
    next_gains,
    step_of,
)
from .scans import FASTEST

Scalars = tuple[Float[Array, "*#segments"], ...]

BLOCK = 32
"""The number of rows that are filtered before their likelihood is summed."""


LAGS = 8
"""The largest lag at which innovations are compared, in samples."""


class SegmentLikelihoods(NamedTuple):
    """The negative log-likelihood of each segment, with derivatives.

    The unknowns of a channel are the parameters, then its `LogNoise`, gains of input innovations, and feedthroughs.

    - `feasible`: whether the rates stay below `FASTEST`.
    - `information`: the Fisher information.
    - `products`: sums of the products of standardised innovations 0 to `LAGS` samples apart.
    """

    cost: PerSegment
    feasible: Bool[Array, " segments"]
    gradient: Float[Array, "channels unknowns segments"]
    information: Float[Array, "channels unknowns unknowns segments"]
    products: Float[Array, "channels lags segments"]


class Segmented(NamedTuple):
    """A flight in segments.

    - `measured`: body rates, then specific force. NaN: not measured. The number of rows is a multiple of `BLOCK`.
    - `restart`: whether the filter of a segment restarts before this sample.
    - `counts`: whether the innovations at a sample count.
    - `known`: the rates at the first sample. `None`: unknown.
    - `inputs`: input innovations, see `jaxos4.shooting.feedthrough`.
    - `place`: the sample of the flight in each row.
    - `forcing`: leaves (samples). `forcing_tangents`: their derivatives (positions, samples) in the parameters on which
      they depend. Both change with the parameters, and most rows may be padding, so they are looked up block by block.
    - `rows`: the number of rows that are filtered; the others are padding.
    - `window`: the part of a sample that a measurement averages.
    """

    measured: Series
    restart: Bool[Array, "time segments"]
    counts: Bool[Array, "time segments"]
    known: Float[Array, "3 segments"] | None
    inputs: Float[Array, "time feedthroughs channels segments"]
    place: Int[Array, "time segments"]
    forcing: Forcing
    forcing_tangents: Forcing | None
    rows: Count | int
    dt: Scalar
    window: AveragingWindow


# The estimates of the filters, by channel: the rates, then the part of each specific force that the model does not
# predict; and their disturbances.
Estimates = tuple[tuple[PerSegment, ...], tuple[PerSegment, ...]]


class Point(NamedTuple):
    """The unknowns at which a flight is filtered.

    - `parameters`: common to all segments, or of each segment.
    - `feedthrough`: the coefficients by which input innovations explain the innovations of the same samples.
    - `noise_feedthrough`: see `InnovationsProblem`.
    - `input_gains`: the gains of input innovations.
    """

    parameters: Float[Array, "parameters *segments"]
    noise: LogNoise
    feedthrough: tuple[Float[Array, " channels *segments"], ...]
    noise_feedthrough: tuple[Float[Array, " channels *segments"], ...]
    input_gains: InputGains


class _Row(NamedTuple):
    """One sample of all segments.

    - `measured`: 0 for a missing measurement. `inputs`: the input innovations, 0 where nothing was measured.
    - `restart`, `restart_next`: whether the filter of a segment restarts before this sample, or before the next.
    """

    measured: Channels
    is_measured: Bool[Array, "channels segments"]
    inputs: Float[Array, "feedthroughs channels segments"]
    restart: Bool[Array, " segments"]
    restart_next: Bool[Array, " segments"]


def innovations_at(
    functions: tuple[Callable, ...], positions: tuple[int, ...], flight: Segmented, at: Point
) -> SegmentLikelihoods:
    """See `filter_lanes.innovate`. `functions` act on all segments. Arrays in `at` may have segments as last axis."""
    (count, *own), (time, channels, segments) = at.parameters.shape, flight.measured.shape
    driving = count + len(jax.tree.leaves((at.noise, at.input_gains)))  # the unknowns that change the estimates
    unknowns, levels = driving + len(at.feedthrough), slice(count, count + len(jax.tree.leaves(at.noise)))
    scalars, units = tuple(at.parameters), tuple(np.eye(count, driving, dtype=at.parameters.dtype))
    places, (steps, first) = np.asarray(positions, int), _start(flight, at.noise, driving)
    shapes = (channels, unknowns), (channels, unknowns, unknowns), (channels, LAGS + 1)
    nothing = tuple(jnp.zeros((*shape, segments), dtype=float) for shape in ((), *shapes))
    missing = jnp.isnan(flight.measured)
    row = _Row(
        measured=jnp.where(missing, 0.0, flight.measured),
        is_measured=~missing,
        inputs=jnp.where(missing[:, None], 0.0, flight.inputs),
        restart=flight.restart,
        restart_next=jnp.roll(flight.restart, -1, axis=0),
    )
    data = row, flight.counts, flight.place
    blocks = jax.tree.map(lambda leaf: leaf.reshape(time // BLOCK, BLOCK, *leaf.shape[1:]), data)

    def sample(carry, rows):
        """The filters one sample later, and the innovations of this sample with their derivatives."""
        (covariance, by_noise), (estimates, slopes), feasible = carry
        forcing, tangents, row = rows
        for x in estimates[0][:RATE_COUNT]:
            feasible = feasible & (jnp.abs(x) < FASTEST)
        (covariance, gains), push = jax.linearize(
            lambda p, step: next_gains(p, step, row.is_measured, row.restart), covariance, steps[0]
        )
        by_noise, gain_slopes = jax.vmap(push)(by_noise, steps[1])
        feedback = Feedback.of(gains, steps[0], at.input_gains)
        # The noise acts only through the feedback, and the parameters do not act on the feedback.
        by_unknowns = feedback_slopes(gain_slopes, steps[1], at.input_gains, count)

        def filtered(estimates: Estimates, feedback: Feedback, scalars: tuple, forcing: Forcing = forcing):
            return _advance(functions, estimates, forcing, scalars, feedback, row, feasible)

        def pushed(slopes: Estimates, feedback: Feedback, units: tuple, *others: Any) -> Any:
            return push(slopes, feedback, tuple(jnp.broadcast_to(unit, tuple(own)) for unit in units), *others)

        before, directions = (estimates, feedback, scalars), (slopes, by_unknowns, units)
        if tangents is not None:
            wide = jax.tree.map(lambda t: jnp.zeros((driving, segments), dtype=float).at[places].set(t), tangents)
            before, directions = (*before, forcing), (*directions, wide)
        (estimates, errors), push = jax.linearize(filtered, *before)
        slopes, by_errors = jax.vmap(pushed)(*directions)  # pyright: ignore[reportArgumentType]
        found = tuple(map(jnp.stack, (errors, by_errors))), gains.variance, gain_slopes.variance
        return ((covariance, by_noise), (estimates, slopes), feasible), found

    def block(i: Count, carry: tuple) -> tuple:
        """The filters after some more rows, the last standardised innovations, and the sums of the likelihood."""
        filters, last, sums = carry
        row, counts, place = jax.tree.map(lambda leaf: leaf[i], blocks)
        forcing = jax.tree.map(lambda leaf: leaf[place], flight.forcing)
        tangents = jax.tree.map(lambda leaf: jnp.moveaxis(leaf[:, place], 0, 1), flight.forcing_tangents)
        filters, found = jax.lax.scan(sample, filters, (forcing, tangents, row))
        (errors, slopes), variance, variance_slopes = found
        counts = row.is_measured & counts[:, None]
        # What input innovations explain is no longer an error. What they explained at the end of the first stage still
        # counts as noise.
        both = at.feedthrough, at.noise_feedthrough
        explained, as_noise = (jax.vmap(by_inputs, in_axes=(None, 0))(each, row.inputs) for each in both)
        errors, slopes = errors - explained, jnp.concatenate([slopes, -jnp.moveaxis(row.inputs, 2, 1)], axis=2)
        squares = jnp.square(as_noise)
        found, last = _likelihood(counts, variance, variance_slopes, last, errors, slopes, squares, levels)
        return filters, last, jax.tree.map(jnp.add, sums, found)

    begin = first, jnp.zeros((LAGS, channels, segments), dtype=float), nothing
    (*_, feasible), _, (cost, *sums) = jax.lax.fori_loop(0, -(-flight.rows // BLOCK), block, begin)
    return SegmentLikelihoods(cost, feasible, *sums)


def _start(flight: Segmented, noise: LogNoise, driving: int) -> tuple[tuple[Step, Step], tuple]:
    """The disturbance over a sample with its derivatives in the noise, and the filters before the first sample.

    The filters are covariance, estimates, and which segments are feasible. The covariance stands with its derivatives
    in the noise, the estimates with theirs in the `driving` unknowns; derivatives are on the first axis.
    """
    _, channels, segments = flight.measured.shape
    step, push = jax.linearize(lambda noise: step_of(noise, flight.dt, flight.window), noise)
    steps = step, jax.vmap(push)(basis(noise))
    covariance, push = jax.linearize(lambda step: first_covariance(step, segments), step)
    zero = jnp.zeros(segments, dtype=float)
    start = (zero,) * RATE_COUNT if flight.known is None else flight.known
    estimates = _emptied(((*start, *(zero,) * (channels - RATE_COUNT)), (zero,) * channels), flight.restart[0])
    no_slopes = jax.tree.map(lambda _: jnp.zeros((driving, segments), dtype=float), estimates)
    filters = (covariance, jax.vmap(push)(steps[1])), (estimates, no_slopes), jnp.ones(segments, dtype=bool)
    return steps, filters


def _advance(
    functions: tuple[Callable, ...],
    estimates: Estimates,
    forcing: Forcing,
    scalars: Scalars,
    feedback: Feedback,
    row: _Row,
    going: Bool[Array, " segments"],
) -> tuple[Estimates, tuple[PerSegment, ...]]:
    """The estimates one sample later, and the innovations of this sample. `going`: the segments that have not diverged.

    Innovations, rates and their derivatives are computed once, although several results need them.
    """
    move, average, observe = functions
    before, disturbance = estimates
    seen = tuple(a * d for a, d in zip(feedback.seen, disturbance, strict=True))

    def compared() -> tuple[PerSegment, ...]:
        mean = average(State(Rates(*before[:RATE_COUNT])), forcing, scalars).rates
        rates = Rates(*(x + a for x, a in zip(mean, seen, strict=False)))
        outputs = observe(State(rates), forcing, scalars)
        forces = zip(outputs, feedback.driven_seen, before, seen, strict=True)
        outputs = (*outputs[:RATE_COUNT], *(h + share * x + a for h, share, x, a in [*forces][RATE_COUNT:]))
        return tuple(z - h for z, h in zip(row.measured, outputs, strict=True))

    errors = computed_once(going, compared)
    # A missing measurement has a gain of 0.
    corrected = tuple(x + gain * e for x, gain, e in zip(before, feedback.driven, errors, strict=True))
    rates = computed_once(going, lambda: move(State(Rates(*corrected[:RATE_COUNT])), forcing, scalars).rates)
    moved = (*rates, *(share * x for share, x in [*zip(feedback.driven_kept, corrected, strict=True)][RATE_COUNT:]))
    added = tuple(by_inputs(gains, row.inputs) for gains in feedback.input_gains)
    later = zip(moved, feedback.driven_by, disturbance, feedback.driven_later, errors, added[0], strict=True)
    driven = tuple(x + a * d + gain * e + v for x, a, d, gain, e, v in later)
    faded = zip(feedback.kept, disturbance, feedback.disturbance_later, errors, added[1], strict=True)
    disturbance = tuple(share * d + gain * e + v for share, d, gain, e, v in faded)
    return _emptied((driven, disturbance), row.restart_next), errors


def _emptied(estimates: Estimates, where: Bool[Array, " segments"]) -> Estimates:
    return jax.tree.map(lambda leaf: jnp.where(where, 0.0, leaf), estimates)


def _likelihood(
    counts: Bool[Array, "time channels segments"],
    variance: Series,
    variance_slopes: Float[Array, "time levels channels segments"],
    last: Float[Array, "lags channels segments"],
    errors: Series,
    slopes: Float[Array, "time channels unknowns segments"],
    feedthrough_squares: Series,
    noise: slice,
) -> tuple[tuple[PerSegment, Array, Array, Array], Float[Array, "lags channels segments"]]:
    """The likelihood of innovations `errors` with the derivatives `slopes`, and the last standardised innovations.

    `feedthrough_squares`: the squares of the explained part of the innovations, which counts as noise. `noise`: the
    indices of the noise among the unknowns.

    **Returns:** `cost`, `gradient`, `information` and `products` of `SegmentLikelihoods`; then the next `last`.
    """
    weight = jnp.where(counts, 1 / variance, 0.0)
    logarithm = jnp.where(counts, jnp.log(variance), 0.0)
    relative = jnp.moveaxis(variance_slopes * weight[:, None], 1, 2)  # (time, channels, levels, segments)
    gradient = jnp.einsum("tcul,tcl->cul", slopes, weight * errors)
    squares = errors**2 + feedthrough_squares
    surprise = (weight > 0) * (1 - weight * squares) / 2
    gradient = gradient.at[:, noise].add(jnp.einsum("tcul,tcl->cul", relative, surprise))
    information = jnp.einsum("tcul,tcvl->cuvl", slopes * weight[:, :, None], slopes)
    information = information.at[:, noise, noise].add(jnp.einsum("tcul,tcvl->cuvl", relative, relative) / 2)
    cost = (weight * squares + logarithm).sum(axis=(0, 1)) / 2
    standard = jnp.concatenate([last, jnp.sqrt(weight) * errors])
    now = standard[LAGS:]
    products = [(now * standard[LAGS - lag : standard.shape[0] - lag]).sum(axis=0) for lag in range(LAGS + 1)]
    return (cost, gradient, information, jnp.stack(products, axis=1)), standard[-LAGS:]
