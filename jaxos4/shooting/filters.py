"""The Kalman filters of filter error: innovations, their likelihood, and its derivatives.

The gains are computed first (`jaxos4.shooting.gains`), and then the innovations, block by block of rows.

Arrays have the axes (time, channels, segments). A segment is one part of the flight.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._custom_types import Count, Scalar
from ..batching import computed_once, with_batch
from ..models.state import Forcing, Rates, State
from .gains import (
    RATE_COUNT,
    AveragingWindow,
    Channels,
    Covariance,
    Feedback,
    InputGains,
    LogNoise,
    Observed,
    PerSegment,
    Step,
    basis,
    by_inputs,
    feedback_slopes,
    first_covariance,
    next_gains,
    step_of,
)
from .scans import FASTEST
from .sums import LAGS, Innovations, likelihood

Scalars = tuple[Float[Array, "*#segments"], ...]
Move = Callable[[State, Forcing, Scalars], State]
Observe = Callable[[State, Forcing, Scalars], Scalars]
Functions = tuple[Move, Move, Observe]

BLOCK = 32
"""The number of rows that are filtered before their likelihood is summed."""


class _Row(NamedTuple):
    """One sample of all segments.

    - `measured`: 0 for a missing measurement. `inputs`: the input innovations, 0 where nothing was measured.
    - `restarts`, `restarts_next`: whether the filter of a segment restarts before this sample, or before the next.
    """

    measured: Channels
    is_measured: Bool[Array, "channels segments"]
    inputs: Float[Array, "feedthroughs channels segments"]
    restarts: Bool[Array, " segments"]
    restarts_next: Bool[Array, " segments"]


class _Known(NamedTuple):
    """The estimates of the filters at the beginning of a sample, by channel.

    - `driven`: the rates, then the part of each specific force that the model does not predict.
    - `disturbance`: their disturbances.
    """

    driven: tuple[PerSegment, ...]
    disturbance: tuple[PerSegment, ...]


def _advance(
    functions: tuple[Callable, ...],
    known: _Known,
    forcing: Forcing,
    scalars: Scalars,
    feedback: Feedback,
    row: _Row,
    going: Bool[Array, " segments"],
) -> tuple[_Known, tuple[PerSegment, ...]]:
    """The estimates one sample later, and the innovations of this sample. `going`: the segments that have not diverged.

    Innovations, rates and their derivatives are computed once, although several results need them.
    """
    move, average, observe = functions
    seen = tuple(a * d for a, d in zip(feedback.seen, known.disturbance, strict=True))

    def compared() -> tuple[PerSegment, ...]:
        mean = average(State(Rates(*known.driven[:RATE_COUNT])), forcing, scalars).rates
        rates = Rates(*(x + a for x, a in zip(mean, seen, strict=False)))
        outputs = observe(State(rates), forcing, scalars)
        forces = zip(outputs, feedback.driven_seen, known.driven, seen, strict=True)
        outputs = (*outputs[:RATE_COUNT], *(h + share * x + a for h, share, x, a in [*forces][RATE_COUNT:]))
        return tuple(z - h for z, h in zip(row.measured, outputs, strict=True))

    errors = computed_once(going, compared)
    # A missing measurement has a gain of 0.
    driven = tuple(x + gain * e for x, gain, e in zip(known.driven, feedback.driven, errors, strict=True))
    rates = computed_once(going, lambda: move(State(Rates(*driven[:RATE_COUNT])), forcing, scalars).rates)
    driven = (*rates, *(share * x for share, x in [*zip(feedback.driven_kept, driven, strict=True)][RATE_COUNT:]))
    added = tuple(by_inputs(gains, row.inputs) for gains in feedback.input_gains)
    later = zip(driven, feedback.reach, known.disturbance, feedback.driven_later, errors, added[0], strict=True)
    driven = tuple(x + a * d + gain * e + v for x, a, d, gain, e, v in later)
    faded = zip(feedback.kept, known.disturbance, feedback.disturbance_later, errors, added[1], strict=True)
    disturbance = tuple(share * d + gain * e + v for share, d, gain, e, v in faded)
    return _emptied(_Known(driven, disturbance), row.restarts_next), errors


def _emptied(known: _Known, where: Bool[Array, " segments"]) -> _Known:
    return jax.tree.map(lambda leaf: jnp.where(where, 0.0, leaf), known)


class _Carry(NamedTuple):
    """The state of the filters between blocks of rows, each part with its derivatives, and the sums so far.

    - `covariance`: with its derivatives in the noise, on the first axis.
    - `known`: with its derivatives in the parameters, the noise, and the gains of input innovations, on the first axis.
    - `last`: the last `LAGS` standardised innovations.
    """

    covariance: tuple[Covariance, Covariance]
    known: tuple[_Known, _Known]
    last: Float[Array, "lags channels segments"]
    sums: Innovations


class Segmented(NamedTuple):
    """A flight in segments.

    - `observed`: its number of rows is a multiple of `BLOCK`, of which `rows` are filtered; the others are padding.
    - `inputs`: input innovations, see `jaxos4.shooting.feedthrough`.
    - `forcing`: leaves (time, segments). `forcing_tangents`: their derivatives (time, positions, segments) in the
      parameters on which they depend.
    - `window`: the part of a sample that a measurement averages.
    """

    observed: Observed
    inputs: Float[Array, "time feedthroughs channels segments"]
    forcing: Forcing
    forcing_tangents: Forcing | None
    rows: Count | int
    dt: Scalar
    window: AveragingWindow


class Point(NamedTuple):
    """The unknowns at which a flight is filtered.

    - `parameters`: common to all segments, or of each segment.
    - `feedthrough`: the coefficients by which input innovations explain the innovations of the same samples.
    - `noise_feedthrough`: feedthroughs that were found before; the innovations that they explain count as noise.
    """

    parameters: Float[Array, "parameters *segments"]
    noise: LogNoise
    feedthrough: tuple[Float[Array, " channels *segments"], ...]
    noise_feedthrough: tuple[Float[Array, " channels *segments"], ...]
    input_gains: InputGains


def innovate(functions: Functions, positions: tuple[int, ...], flight: Segmented, at: Point) -> Innovations:
    """Filter all segments. The likelihood of the innovations has derivatives in all unknowns.

    In the derivatives, the noise of a channel affects its own innovations only.

    - `functions`: three functions of a state, the forcing and the parameters. They return the state one sample later,
      its mean over the window of a measurement, and the outputs of the sensors.
    - `positions`: indices of the parameters on which the forcing depends.
    """
    return with_batch(_innovate, _innovate_lanes, functions, positions, flight, at)()


def _innovate_lanes(lanes: int, many: Any, shared: Any) -> Innovations:
    """The innovations of a batch, whose lanes become segments. The segments of a lane are adjacent."""
    (moving, _, flight, at), (fixed, positions, fixed_flight, fixed_at) = many, shared
    segments = eqx.combine(flight, fixed_flight).observed.measured.shape[-1]

    def lanes_before_last(one: Any, same: Any) -> Any:
        one = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -2), one)
        same = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf[..., None, :], (*leaf.shape[:-1], lanes, segments)), same
        )
        return jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-2], lanes * segments), eqx.combine(one, same))

    def repeated(leaf: Array) -> Array:
        return jnp.repeat(leaf, segments, axis=0)

    def in_each_segment(one: Any, same: Any) -> Any:
        """Values in each segment, from values common to a lane or of each segment."""
        one = jax.tree.map(lambda leaf: leaf if leaf.ndim > 2 else jnp.repeat(leaf[..., None], segments, 2), one)
        same = jax.tree.map(lambda leaf: leaf if leaf.ndim > 1 else jnp.repeat(leaf[:, None], segments, 1), same)
        return lanes_before_last(one, same)

    def of_each_segment(one: Any, same: Any) -> Any:
        return eqx.combine(jax.tree.map(repeated, one), same)

    own = jax.tree.map(repeated, moving)

    def each(which: int) -> Callable:
        def function(*at: Any) -> Any:
            return jax.vmap(lambda one, *at: eqx.combine(one, fixed[which])(*at))(own[which], *at)

        return function

    rows = fixed_flight.rows if flight.rows is None else flight.rows.max()  # surplus rows of shorter lanes do not count
    observed, inputs, forcing, tangents = lanes_before_last(flight[:4], fixed_flight[:4])
    dt, window = (of_each_segment(*pair) for pair in zip(flight[5:], fixed_flight[5:], strict=True))
    flight = Segmented(observed, inputs, forcing, tangents, rows, dt, window)
    functions = each(0), each(1), each(2)
    found = _filter(functions, positions, flight, in_each_segment(at, fixed_at))
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf.reshape(*leaf.shape[:-1], lanes, segments), -2, 0), found)


def _innovate(functions: Functions, positions: tuple[int, ...], flight: Segmented, at: Point) -> Innovations:
    """The innovations of one flight."""
    own = None if at.parameters.ndim == 1 else 0
    move, average, observe = (jax.vmap(function, in_axes=(0, 0, own)) for function in functions)
    return _filter((move, average, observe), positions, flight, at)


def _filter(functions: tuple[Callable, ...], positions: tuple[int, ...], flight: Segmented, at: Point) -> Innovations:
    """See `innovate`. `functions` act on all segments. Arrays in `at` may have segments as last axis."""
    observed, inputs, forcing, forcing_tangents, rows, dt, window = flight
    count, (time, channels, segments) = at.parameters.shape[0], observed.measured.shape
    driving = count + len(jax.tree.leaves((at.noise, at.input_gains)))  # the unknowns that change the estimates
    unknowns = driving + len(at.feedthrough)
    step, push = jax.linearize(lambda noise: step_of(noise, dt, window), at.noise)
    steps = step, jax.vmap(push)(basis(at.noise))
    covariance, push = jax.linearize(lambda step: first_covariance(step, segments), step)
    zero = jnp.zeros(segments, dtype=float)
    start = (zero,) * RATE_COUNT if observed.known is None else observed.known
    known = _Known((*start, *(zero,) * (channels - RATE_COUNT)), (zero,) * channels)
    known = _emptied(known, observed.restart[0])
    nothing = Innovations(
        cost=zero,
        feasible=jnp.ones(segments, dtype=bool),
        gradient=jnp.zeros((channels, unknowns, segments), dtype=float),
        information=jnp.zeros((channels, unknowns, unknowns, segments), dtype=float),
        products=jnp.zeros((channels, LAGS + 1, segments), dtype=float),
    )
    no_slopes = jax.tree.map(lambda _: jnp.zeros((driving, segments), dtype=float), known)
    carry = _Carry(
        (covariance, jax.vmap(push)(steps[1])),
        (known, no_slopes),
        jnp.zeros((LAGS, channels, segments), dtype=float),
        nothing,
    )
    advance = functools.partial(_advance, functions)
    filtered = functools.partial(_filter_rows, advance, at, steps, np.asarray(positions, int))
    missing, following = jnp.isnan(observed.measured), jnp.roll(observed.restart, -1, axis=0)
    row = _Row(
        measured=jnp.where(missing, 0.0, observed.measured),
        is_measured=~missing,
        inputs=jnp.where(missing[:, None], 0.0, inputs),
        restarts=observed.restart,
        restarts_next=following,
    )
    data = row, observed.counts, forcing, forcing_tangents
    blocks = jax.tree.map(lambda leaf: leaf.reshape(time // BLOCK, BLOCK, *leaf.shape[1:]), data)

    def block(i: Count, carry: _Carry) -> _Carry:
        return filtered(carry, *jax.tree.map(lambda leaf: leaf[i], blocks))

    return jax.lax.fori_loop(0, -(-rows // BLOCK), block, carry).sums


def _filter_rows(
    advance: Callable[..., Any],
    point: Point,
    steps: tuple[Step, Step],
    positions: np.ndarray,
    carry: _Carry,
    row: _Row,
    counts: Bool[Array, "time segments"],
    forcing: Forcing,
    forcing_tangents: Forcing | None,
) -> _Carry:
    """The filters after some more rows.

    `steps`: the disturbance over a sample, with its derivatives in the noise.
    """
    parameters, (count, *_), segments = point.parameters, point.parameters.shape, counts.shape[1]
    scalars, own = tuple(parameters), parameters.shape[1:]
    driving = jax.tree.leaves(carry.known[1])[0].shape[0]
    units = tuple(np.eye(count, driving, dtype=parameters.dtype))

    def body(carry, rows):
        (covariance, by_noise), (known, slopes), feasible = carry
        forcing, tangents, row = rows
        for x in known.driven[:RATE_COUNT]:
            feasible = feasible & (jnp.abs(x) < FASTEST)
        (covariance, gains), push = jax.linearize(
            lambda p, step: next_gains(p, step, row.is_measured, row.restarts), covariance, steps[0]
        )
        by_noise, gain_slopes = jax.vmap(push)(by_noise, steps[1])
        feedback = Feedback.of(gains, steps[0], point.input_gains)
        # The noise acts only through the feedback, and the parameters do not act on the feedback.
        by_unknowns = feedback_slopes(gain_slopes, steps[1], point.input_gains, count)

        def filtered(known: _Known, feedback: Feedback, scalars: tuple, forcing: Forcing = forcing):
            return advance(known, forcing, scalars, feedback, row, feasible)

        def pushed(slopes: _Known, feedback: Feedback, units: tuple, *others: Any) -> Any:
            return push(slopes, feedback, tuple(jnp.broadcast_to(unit, own) for unit in units), *others)

        at, directions = (known, feedback, scalars), (slopes, by_unknowns, units)
        if tangents is not None:
            wide = jax.tree.map(lambda t: jnp.zeros((driving, segments), dtype=float).at[positions].set(t), tangents)
            at, directions = (*at, forcing), (*directions, wide)
        (known, errors), push = jax.linearize(filtered, *at)
        slopes, by_errors = jax.vmap(pushed)(*directions)  # pyright: ignore[reportArgumentType]
        found = tuple(map(jnp.stack, (errors, by_errors))), gains.variance, gain_slopes.variance
        return ((covariance, by_noise), (known, slopes), feasible), found

    first = carry.covariance, carry.known, carry.sums.feasible
    (covariance, known, feasible), found = jax.lax.scan(body, first, (forcing, forcing_tangents, row))
    (errors, slopes), variance, variance_slopes = found
    counts = row.is_measured & counts[:, None]
    # Known feedthroughs explain a part of the innovations that counts as noise; the others are estimated.
    both = point.feedthrough, point.noise_feedthrough
    explained, as_noise = (jax.vmap(by_inputs, in_axes=(None, 0))(each, row.inputs) for each in both)
    errors, slopes = errors - explained, jnp.concatenate([slopes, -jnp.moveaxis(row.inputs, 2, 1)], axis=2)
    by_noise, squares = slice(count, count + variance_slopes.shape[1]), jnp.square(as_noise)
    found, last = likelihood(counts, variance, variance_slopes, carry.last, feasible, errors, slopes, squares, by_noise)
    sums = jax.tree.map(jnp.add, carry.sums, found)._replace(feasible=feasible)
    return _Carry(covariance, known, last, sums)
