"""The inner loops: one scan over a window simulates it and sums its cost, gradient and information.

The sums travel with the state, so that memory does not grow with the flight. Derivatives are forward-mode. Values
inside a scan are scalars of a lane, because stacking them in every step is slow.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import InitialState, Parameters, Scalar
from ..models.state import Forcing, State, unstack
from .rows import Rows

# A body rate [rad/s] that no quadrotor reaches and no gyro measures: a faster trajectory has diverged.
FASTEST = 1e3

# From a state, the forcing and the parameters: the state one sample later, and the output of noise-free sensors.
Advance = Callable[[State, Forcing, tuple[Scalar, ...]], tuple[State, tuple[Scalar, ...]]]
Carry = TypeVar("Carry")
# The number of rows that count in a padded flight. It is data and not a shape, so that flights of different lengths
# share one compiled program.
Length = Int[Array, ""] | None


class Shot(NamedTuple):
    """One simulated window.

    - `cost`: of the samples before the trajectory fails.
    - `sound`: whether no sample fails, by a pitch angle beyond +-90 degrees or a body rate above `FASTEST`. The cost of
      a failed shot means nothing, but its derivative still points back to valid trajectories.
    """

    cost: Scalar
    sound: Bool[Array, ""]


class Curvature(NamedTuple):
    """A shot with its gradient and its Fisher information J^T W^2 J in (parameters, initial state)."""

    shot: Shot
    gradient: Float[Array, " unknowns"]
    information: Float[Array, "unknowns unknowns"]


def predict_window(
    advance: Advance, forcing: Forcing, parameters: Parameters, initial_state: InitialState, length: Length = None
) -> Float[Array, "length columns"]:
    """The output of noise-free sensors in one window; 0 in padding."""
    scalars, first = tuple(parameters), unstack(initial_state)

    def step(state: State, forcing: Forcing) -> tuple[State, tuple[Scalar, ...]]:
        return advance(state, forcing, scalars)

    if length is None:
        return jnp.stack(jax.lax.scan(step, first, forcing)[1], axis=-1)
    samples = forcing.roll.shape[0]
    columns = len(jax.eval_shape(step, first, jax.tree.map(lambda leaf: leaf[0], forcing))[1])

    def fill(i: Int[Array, ""], carry):
        state, outputs = carry
        state, predicted = step(state, jax.tree.map(lambda leaf: leaf[i], forcing))
        return state, outputs.at[i].set(jnp.stack(predicted))

    return jax.lax.fori_loop(0, length, fill, (first, jnp.zeros((samples, columns), dtype=float)))[1]


def _fold(step: Callable, first: Carry, rows: Rows, length: Length) -> Carry:
    """The last carry of `step` over the rows that count."""
    if length is None:
        return jax.lax.scan(lambda carry, row: (step(carry, row), None), first, rows)[0]
    return jax.lax.fori_loop(0, length, lambda i, carry: step(carry, jax.tree.map(lambda leaf: leaf[i], rows)), first)


def shoot(
    advance: Advance,
    rows: Rows,
    weights: tuple[Scalar, ...],
    parameters: Parameters,
    initial_state: InitialState,
    length: Length = None,
) -> Shot:
    """Simulate one window and compare it with the measurements. `weights`: 1 / sigma of each channel."""
    scalars = tuple(parameters)

    def step(carry: tuple[State, Shot], row: Rows) -> tuple[State, Shot]:
        state, shot = carry
        sound = shot.sound & _is_sound(state)
        following, predicted = advance(state, row.forcing, scalars)
        return following, Shot(shot.cost + _half_square(_errors(row, predicted, weights, sound)), sound)

    return _fold(step, (unstack(initial_state), _no_shot()), rows, length)[1]


def shoot_with_derivatives(
    advance: Advance,
    rows: Rows,
    weights: tuple[Scalar, ...],
    parameters: Parameters,
    initial_state: InitialState,
    *,
    forcing_parameters: tuple[int, ...],
    initial_state_is_free: bool,
    length: Length = None,
) -> Curvature:
    """`shoot` with the gradient and the information in the parameters and, if it is free, the initial state.

    One tangent for each unknown travels with the state.
    """
    count, size = parameters.shape[0], initial_state.shape[0]
    free = size if initial_state_is_free else 0
    unknowns = count + free
    # NumPy, so that they are constants of the program.
    identity = np.eye(unknowns, dtype=parameters.dtype)
    scalars = tuple(parameters)
    parameter_tangents = tuple(identity[:, :count].T)
    start_tangents = identity[:, count:] if free else np.zeros((unknowns, size), dtype=parameters.dtype)

    def linearised(state: State, tangent: State, row: Rows):
        if row.forcing_tangents is None:
            at, push = jax.linearize(lambda x, a: advance(x, row.forcing, a), state, scalars)
            return at, jax.vmap(push)(tangent, parameter_tangents)
        at, push = jax.linearize(advance, state, row.forcing, scalars)
        positions = np.asarray(forcing_parameters)
        forcing = jax.tree.map(
            lambda slope: jnp.zeros(unknowns, dtype=float).at[positions].set(slope), row.forcing_tangents
        )
        return at, jax.vmap(push)(tangent, forcing, parameter_tangents)

    def step(carry: tuple[State, State, Curvature], row: Rows):
        state, tangent, total = carry
        sound = total.shot.sound & _is_sound(state)
        (following, predicted), (following_tangent, slope) = linearised(state, tangent, row)
        errors = _errors(row, predicted, weights, sound)
        slopes = [
            jnp.where(jnp.isnan(y) | ~sound, 0.0, -w * dx)
            for y, w, dx in zip(row.measured, weights, slope, strict=True)
        ]
        total = Curvature(
            Shot(total.shot.cost + _half_square(errors), sound),
            total.gradient + sum(e * s for e, s in zip(errors, slopes, strict=True)),
            total.information + sum(s[:, None] * s[None, :] for s in slopes),
        )
        return following, following_tangent, total

    zero = Curvature(_no_shot(), jnp.zeros(unknowns, dtype=float), jnp.zeros((unknowns, unknowns), dtype=float))
    tangents = jax.vmap(unstack)(jnp.asarray(start_tangents))
    return _fold(step, (unstack(initial_state), tangents, zero), rows, length)[2]


def _no_shot() -> Shot:
    return Shot(jnp.zeros((), dtype=float), jnp.ones((), dtype=bool))


def _is_sound(state: State) -> Bool[Array, ""]:
    p, q, r = state.rates
    slow = (jnp.abs(p) < FASTEST) & (jnp.abs(q) < FASTEST) & (jnp.abs(r) < FASTEST)
    return slow if state.attitude is None else slow & (jnp.abs(state.attitude.theta) < jnp.pi / 2)


def _errors(
    row: Rows, predicted: tuple[Scalar, ...], weights: tuple[Scalar, ...], sound: Bool[Array, ""]
) -> list[Scalar]:
    return [
        jnp.where(jnp.isnan(y) | ~sound, 0.0, w * (y - x))
        for y, w, x in zip(row.measured, weights, predicted, strict=True)
    ]


def _half_square(errors: list[Scalar]) -> Scalar:
    return functools.reduce(lambda total, e: total + e * e, errors, jnp.zeros_like(errors[0])) / 2
