"""The Kalman filters of filter error: innovations, their likelihood, and its derivatives.

The gains are computed first (`jaxos4.shooting.gains`), and then the innovations, block by block of rows.

Arrays have the axes (time, channels, segments). A segment is one part of the flight.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._custom_types import Count, Parameters, Scalar
from ..models.state import Forcing, Rates, State
from .gains import (
    RATES,
    Channels,
    Covariance,
    Gains,
    LogNoise,
    Observed,
    Series,
    basis,
    Step,
    first_covariance,
    next_gains,
    step_of,
)
from .scans import FASTEST

Segments = Float[Array, " segments"]
Scalars = tuple[Scalar, ...]
Move = Callable[[State, Forcing, Scalars], State]
Observe = Callable[[State, Forcing, Scalars], Scalars]
# A row of `Observed`: measured, restart.
_Row = tuple[Channels, Bool[Array, " segments"]]

LAGS = 8
"""The largest lag at which innovations are compared, in samples."""

BLOCK = 32
"""The number of rows that are filtered before their likelihood is summed."""


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


def _start(observed: Observed, zero: Channels) -> Channels:
    """The rates at the first sample; 0 if unknown."""
    return zero if observed.known is None else zero.at[:RATES].set(observed.known)


class _Known(NamedTuple):
    """What the filters know before a measurement."""

    rates: Rates
    disturbance: tuple[Segments, ...]


def _advance(
    move: Move, observe: Observe, known: _Known, forcing: Forcing, scalars: Scalars, feedback: "_Feedback", row: _Row
) -> tuple[_Known, tuple[Segments, ...]]:
    """What is known one sample later, and the innovations of this sample."""
    y, restart = row
    known = jax.tree.map(lambda leaf: jnp.where(restart, 0.0, leaf), known)
    outputs = observe(State(known.rates), forcing, scalars)
    force = (h + d for h, d in zip(outputs[RATES:], known.disturbance[RATES:], strict=True))
    expected = (*outputs[:RATES], *force)
    errors = tuple(jnp.where(jnp.isnan(z), 0.0, jnp.nan_to_num(z) - h) for z, h in zip(y, expected, strict=True))
    disturbance = tuple(
        d + gain * e for d, gain, e in zip(known.disturbance, feedback.disturbance, errors, strict=True)
    )
    rates = (x + gain * e for x, gain, e in zip(known.rates, feedback.rate, errors[:RATES], strict=False))
    following = move(State(Rates(*rates)), forcing, scalars).rates
    pushed = (x + a * d for x, a, d in zip(following, feedback.reach, disturbance[:RATES], strict=False))
    faded = tuple(share * d for share, d in zip(feedback.kept, disturbance, strict=True))
    return _Known(Rates(*pushed), faded), errors


class _Feedback(NamedTuple):
    """What the noise changes in a filter: its gains, and the disturbance over one sample. Each is a channel's."""

    rate: tuple[Segments, ...]
    disturbance: tuple[Segments, ...]
    reach: tuple[Segments, ...]
    kept: tuple[Segments, ...]


class _Carry(NamedTuple):
    """The state of the filters between blocks of rows, each part with its derivatives, and the sums so far.

    - `covariance`: derivatives in the noise on the first axis. `known`: in all unknowns on the first axis.
    - `last`: the last `LAGS` standardised innovations.
    """

    covariance: tuple[Covariance, Covariance]
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
    unknowns = count + 3
    step, push = jax.linearize(lambda noise: step_of(noise, dt), noise)
    steps = step, jax.vmap(push)(basis(noise))
    covariance, push = jax.linearize(lambda step: first_covariance(step, segments), step)
    start = _start(observed, jnp.zeros((channels, segments), dtype=float))
    zero = jnp.zeros(segments, dtype=float)
    known = _Known(Rates(*start[:RATES]), (zero,) * channels)
    nothing = Innovations(
        cost=zero,
        sound=jnp.ones(segments, dtype=bool),
        gradient=jnp.zeros((channels, unknowns, segments), dtype=float),
        information=jnp.zeros((channels, unknowns, unknowns, segments), dtype=float),
        products=jnp.zeros((channels, LAGS + 1, segments), dtype=float),
    )
    carry = _Carry(
        (covariance, jax.vmap(push)(steps[1])),
        (known, jax.tree.map(lambda leaf: jnp.zeros((unknowns, *leaf.shape), dtype=float), known)),
        jnp.zeros((LAGS, channels, segments), dtype=float),
        nothing,
    )
    advance = functools.partial(_advance, move, observe)
    filtered = functools.partial(_filter_rows, advance, parameters, steps, np.asarray(forcing_parameters, int))
    data = observed._replace(known=None), forcing, forcing_tangents
    blocks = jax.tree.map(lambda leaf: leaf.reshape(time // BLOCK, BLOCK, *leaf.shape[1:]), data)

    def block(i: Count, carry: _Carry) -> _Carry:
        return filtered(carry, *jax.tree.map(lambda leaf: leaf[i], blocks))

    return jax.lax.fori_loop(0, -(-rows // BLOCK), block, carry).sums


def _filter_rows(
    advance: Callable[..., tuple[_Known, Scalars]],
    parameters: Parameters,
    steps: tuple[Step, Step],
    positions: np.ndarray,
    carry: _Carry,
    observed: Observed,
    forcing: Forcing,
    forcing_tangents: Forcing | None,
) -> _Carry:
    """The filters after some more rows. `steps`: the disturbance over a sample, with its derivatives in the noise."""
    count, segments = parameters.shape[0], observed.measured.shape[2]
    scalars, own = tuple(parameters), parameters.shape[1:]
    units = tuple(np.eye(count + 3, count, dtype=parameters.dtype).T)

    def body(carry, row):
        (covariance, by_noise), (known, slopes), sound = carry
        forcing, tangents, row = row
        for x in known.rates:
            sound = sound & ((jnp.abs(x) < FASTEST) | row[1])
        (covariance, gains), push = jax.linearize(lambda p, step: next_gains(p, step, *row), covariance, steps[0])
        by_noise, gain_slopes = jax.vmap(push)(by_noise, steps[1])

        def feedback(gains: Gains, step: Step) -> _Feedback:
            return _Feedback(*map(tuple, (gains.rate, gains.disturbance, step.reach, step.kept)))

        direction = jax.vmap(feedback)(gain_slopes, steps[1])
        direction = jax.tree.map(lambda s: jnp.concatenate([jnp.zeros((count, *s.shape[1:])), s]), direction)
        at, directions = (known, scalars, feedback(gains, steps[0])), (slopes, units, direction)
        if tangents is not None:
            wide = jax.tree.map(lambda t: jnp.zeros((count + 3, segments), dtype=float).at[positions].set(t), tangents)
            at, directions = (*at, forcing), (*directions, wide)

        def step(known: _Known, scalars, feedback: _Feedback, forcing: Forcing = forcing):
            return advance(known, forcing, scalars, feedback, row)

        def pushed(slopes: _Known, units: Scalars, *others: Any) -> tuple[_Known, Scalars]:
            return push(slopes, tuple(jnp.broadcast_to(unit, own) for unit in units), *others)

        (known, errors), push = jax.linearize(step, *at)
        slopes, by_errors = jax.vmap(pushed)(*directions)
        found = jnp.stack(errors), jnp.stack(by_errors), gains.variance, gain_slopes.variance
        return ((covariance, by_noise), (known, slopes), sound), found

    rows = forcing, forcing_tangents, (observed.measured, observed.restart)
    (covariance, known, sound), found = jax.lax.scan(body, (carry.covariance, carry.known, carry.sums.sound), rows)
    errors, slopes, variance, variance_slopes = found
    found, last = _likelihood(observed, variance, variance_slopes, carry.last, sound, errors, slopes)
    sums = jax.tree.map(jnp.add, carry.sums, found)._replace(sound=sound)
    return _Carry(covariance, known, last, sums)


def _likelihood(
    observed: Observed,
    variance: Series,
    variance_slopes: Float[Array, "time 3 channels segments"],
    last: Float[Array, "lags channels segments"],
    sound: Bool[Array, " segments"],
    errors: Series,
    slopes: Float[Array, "time channels unknowns segments"],
) -> tuple[Innovations, Float[Array, "lags channels segments"]]:
    """The likelihood of innovations `errors` with the derivatives `slopes`, and the last standardised innovations."""
    count = slopes.shape[2] - 3
    counts = ~jnp.isnan(observed.measured) & observed.counts[:, None]
    weight = jnp.where(counts, 1 / variance, 0.0)
    logarithm = jnp.where(counts, jnp.log(variance), 0.0)
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
