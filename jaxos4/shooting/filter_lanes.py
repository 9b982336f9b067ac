"""The filters of one flight, or of a batch of flights: its lanes become segments."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..batching import with_batch
from ..models.state import Forcing, State
from .filters import Point, Scalars, Segmented, SegmentLikelihoods, innovations_at

Move = Callable[[State, Forcing, Scalars], State]
Observe = Callable[[State, Forcing, Scalars], Scalars]
Functions = tuple[Move, Move, Observe]


def innovate(functions: Functions, positions: tuple[int, ...], flight: Segmented, at: Point) -> SegmentLikelihoods:
    """Filter all segments. The likelihood of the innovations has derivatives in all unknowns.

    In the derivatives, the noise of a channel affects its own innovations only.

    - `functions`: three functions of a state, the forcing and the parameters. They return the state one sample later,
      its mean over the window of a measurement, and the outputs of the sensors.
    - `positions`: indices of the parameters on which the forcing depends.
    """
    return with_batch(_innovate, _innovate_lanes, functions, positions, flight, at)()


def _innovate_lanes(lanes: int, many: Any, shared: Any) -> SegmentLikelihoods:
    """The likelihoods of a batch, whose lanes become segments. The segments of a lane are adjacent."""
    (moving, _, flight, at), (fixed, positions, fixed_flight, fixed_at) = many, shared
    segments = eqx.combine(flight, fixed_flight).measured.shape[-1]

    def one_after_the_other(one: Any, same: Any) -> Any:
        """The segments or samples of the first lane, then those of the next, along the last axis."""
        one = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -2), one)
        same = jax.tree.map(lambda leaf: jnp.repeat(leaf[..., None, :], lanes, -2), same)
        joined = eqx.combine(one, same)
        return jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-2], lanes * leaf.shape[-1]), joined)

    def repeated(leaf: Array) -> Array:
        return jnp.repeat(leaf, segments, axis=0)

    def in_each_segment(one: Any, same: Any) -> Any:
        """Values in each segment, from values common to a lane or of each segment."""
        one = jax.tree.map(lambda leaf: leaf if leaf.ndim > 2 else jnp.repeat(leaf[..., None], segments, 2), one)
        same = jax.tree.map(lambda leaf: leaf if leaf.ndim > 1 else jnp.repeat(leaf[:, None], segments, 1), same)
        return one_after_the_other(one, same)

    own = jax.tree.map(repeated, moving)

    def each(which: int) -> Callable:
        def function(*at: Any) -> Any:
            return jax.vmap(lambda one, *at: eqx.combine(one, fixed[which])(*at))(own[which], *at)

        return function

    rows = fixed_flight.rows if flight.rows is None else flight.rows.max()  # surplus rows of shorter lanes do not count
    series = one_after_the_other(*(part._replace(rows=None, dt=None, window=None) for part in (flight, fixed_flight)))
    # The first sample of the lane of each segment.
    first = np.repeat(np.arange(lanes) * (series.forcing.roll.shape[0] // lanes), segments)
    own_step, fixed_step = (flight.dt, flight.window), (fixed_flight.dt, fixed_flight.window)
    dt, window = eqx.combine(jax.tree.map(repeated, own_step), fixed_step)
    flight = series._replace(place=series.place + first, rows=rows, dt=dt, window=window)
    functions = each(0), each(1), each(2)
    found = innovations_at(functions, positions, flight, in_each_segment(at, fixed_at))
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf.reshape(*leaf.shape[:-1], lanes, segments), -2, 0), found)


def _innovate(functions: Functions, positions: tuple[int, ...], flight: Segmented, at: Point) -> SegmentLikelihoods:
    """The likelihoods of one flight."""
    own = None if at.parameters.ndim == 1 else 0
    move, average, observe = (jax.vmap(function, in_axes=(0, 0, own)) for function in functions)
    return innovations_at((move, average, observe), positions, flight, at)
