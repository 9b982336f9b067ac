"""The inner loops: one scan over a window simulates it and sums its cost, gradient and information.

The sums travel with the state, so that memory does not grow with the flight. Derivatives are forward-mode. Values
inside a scan are scalars of a lane, because stacking them in every step is slow.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import InitialState, Numeric, Parameters, Scalar
from ..models.state import Forcing, State, unstack
from .batching import computed_once, with_batch

# A body rate [rad/s] that no quadrotor reaches and no gyro measures: a faster trajectory has diverged.
FASTEST = 1e3

# Rows of the information that are summed together, without the columns right of their square.
_PANEL = 4

# From a state, the forcing and the parameters: the state one sample later, and the output of noise-free sensors.
Advance = Callable[[State, Forcing, tuple[Scalar, ...]], tuple[State, tuple[Scalar, ...]]]
Carry = TypeVar("Carry")
Series = TypeVar("Series", Forcing, tuple[Array, ...])
# One value, or one for each lane of a batch.
Lanes = Float[Array, "*#lanes"]
# The number of rows that count in a padded flight. It is data and not a shape, so that flights of different lengths
# share one compiled program.
Length = Int[Array, ""] | None


class Rows(NamedTuple):
    """One window, or a batch of windows: one leaf for each channel, one row for each sample.

    `forcing` acts from each sample to the next. A missing measurement is NaN. `forcing_tangents` is the derivative of
    the forcing in the parameters on which it depends, along the last axis.
    """

    forcing: Forcing
    measured: tuple[Float[Array, "*windows rows"], ...]
    forcing_tangents: Forcing | None = None


class Shot(NamedTuple):
    """One simulated window.

    - `cost`: of the samples before the trajectory fails.
    - `sound`: whether no sample fails, by a pitch angle beyond +-90 degrees or a body rate above `FASTEST`. The cost of
      a failed shot means nothing, but its derivative still points back to valid trajectories.
    """

    cost: Scalar
    sound: Bool[Array, ""]


class Parts(NamedTuple):
    """The likelihood of each part of a flight, without the prior.

    - `gradient`, `information`: about all unknowns.
    - `products`: for each channel, sums of the products of standardised innovations 0, 1, 2, ... samples apart.
    """

    gradient: Float[Array, "parts unknowns"]
    information: Float[Array, "parts unknowns unknowns"]
    products: Float[Array, "parts channels lags"]


class Curvature(NamedTuple):
    """A shot with its gradient and its Fisher information J^T W^2 J in (parameters, initial state).

    `parts`: from a likelihood whose parts are compared.
    """

    shot: Shot
    gradient: Float[Array, " unknowns"]
    information: Float[Array, "unknowns unknowns"]
    parts: Parts | None = None


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

    nothing = Shot(jnp.zeros((), dtype=float), jnp.ones((), dtype=bool))
    return _fold(step, (unstack(initial_state), nothing), rows, length)[1]


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

    One tangent for each unknown travels with the state. A batch is computed in lanes.
    """

    def alone(*data: Any) -> Curvature:
        return _linearised_shot(
            *data, forcing_parameters=forcing_parameters, initial_state_is_free=initial_state_is_free
        )

    def together(lanes: int, many: Any, shared: Any) -> Curvature:
        if many[-1] is not None:  # lanes of different lengths
            return jax.vmap(lambda one: alone(*eqx.combine(one, shared)))(many)
        last = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), many[1:-1])
        same = jax.tree.map(lambda leaf: leaf[..., None], shared[1:-1])
        rows, weights, *at = eqx.combine(last, same)
        at = (jnp.broadcast_to(values, (values.shape[0], lanes)) for values in at)

        def advance(*at: Any) -> tuple[State, tuple[Lanes, ...]]:
            return jax.vmap(lambda one, *at: eqx.combine(one, shared[0])(*at))(many[0], *at)

        out = alone(advance, rows, weights, *at, shared[-1])
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), out)

    return with_batch(alone, together, advance, rows, weights, parameters, initial_state, length)


class _Carried(NamedTuple):
    """A linearised shot up to some sample.

    `information`: panels of `_PANEL` rows of the information, each without what lies right of its square.
    """

    state: State
    tangent: State
    shot: Shot
    gradient: Float[Array, "unknowns *lanes"]
    information: tuple[Array, ...]


def _linearised_shot(
    advance: Advance,
    rows: Rows,
    weights: tuple[Lanes, ...],
    parameters: Float[Array, "parameters *lanes"],
    initial_state: Float[Array, "size *lanes"],
    length: Length,
    *,
    forcing_parameters: tuple[int, ...],
    initial_state_is_free: bool,
) -> Curvature:
    """`shoot_with_derivatives` of one flight, or of flights in lanes, which are then the last axis of all arrays.

    Rows and weights that all lanes share have a last axis of 1.
    """
    (count, *lanes), size = parameters.shape, initial_state.shape[0]
    free = size if initial_state_is_free else 0
    unknowns = count + free
    panels = [(top, min(top + _PANEL, unknowns)) for top in range(0, unknowns, _PANEL)]
    # NumPy, so that they are constants of the program.
    identity = np.eye(unknowns, dtype=parameters.dtype)
    parameter_tangents = tuple(identity[:, :count].T)
    start_tangents = identity[:, count:].T if free else np.zeros((size, unknowns), dtype=parameters.dtype)
    scalars = tuple(parameters)

    def zeros(*shape: int) -> Array:
        return jnp.zeros((*shape, *lanes), dtype=parameters.dtype)

    def along_lanes(leaf: Array) -> Array:
        return jnp.broadcast_to(leaf, tuple(lanes))

    def step(carry: _Carried, row: Rows) -> _Carried:
        sound = carry.shot.sound & _is_sound(carry.state)
        # At rest after a failure, so that no derivative overflows.
        state = jax.tree.map(lambda x: jnp.where(sound, x, 0.0), carry.state)
        forcing = jax.tree.map(along_lanes, row.forcing)

        # The rates alone are cheaper to repeat.
        repeated = not lanes or state.attitude is None
        shot = functools.partial(_linearised_sample, advance, row, (state, forcing, scalars), weights, sound)
        following, push, cost, pull, squares = shot() if repeated else computed_once(sound, shot)
        directions = [carry.tangent, parameter_tangents]
        if row.forcing_tangents is not None:
            nothing, positions = zeros(unknowns), np.asarray(forcing_parameters)
            wide = jax.tree.map(lambda slope: nothing.at[positions].set(slope), row.forcing_tangents)
            directions.insert(1, wide)

        def pushed(*direction: Any) -> tuple[State, tuple[Lanes, ...]]:
            return push(*jax.tree.map(along_lanes, direction))

        tangent, slopes = jax.vmap(pushed)(*directions)
        gradient = carry.gradient - sum(p * s for p, s in zip(pull, slopes, strict=True))
        information = tuple(
            panel + sum((w * s[top:end])[:, None] * s[:end] for w, s in zip(squares, slopes, strict=True))
            for panel, (top, end) in zip(carry.information, panels, strict=True)
        )
        return _Carried(following, tangent, Shot(carry.shot.cost + cost, sound), gradient, information)

    tangents = np.reshape(start_tangents, (*start_tangents.shape, *(1 for _ in lanes)))
    first = _Carried(
        state=unstack(initial_state),
        tangent=unstack(jnp.broadcast_to(tangents, (size, unknowns, *lanes))),
        shot=Shot(zeros(), jnp.ones(tuple(lanes), dtype=bool)),
        gradient=zeros(unknowns),
        information=tuple(zeros(end - top, end) for top, end in panels),
    )
    last = _fold(step, first, rows, length)
    return Curvature(last.shot, last.gradient, _symmetric(last.information))


def _linearised_sample(
    advance: Advance,
    row: Rows,
    at: tuple[State, Forcing, tuple[Lanes, ...]],
    weights: tuple[Lanes, ...],
    sound: Bool[Array, "*lanes"],
) -> tuple[State, Callable, Lanes, list[Lanes], list[Lanes]]:
    """The next state, the derivative of `advance`, the cost, and the weighted errors and squared weights."""
    state, forcing, scalars = at
    if row.forcing_tangents is None:
        linear = jax.linearize(lambda state, scalars: advance(state, forcing, scalars), state, scalars)
    else:
        linear = jax.linearize(advance, *at)
    (following, predicted), push = linear
    errors = _errors(row, predicted, weights, sound)
    known = [jnp.where(jnp.isnan(y) | ~sound, 0.0, w) for y, w in zip(row.measured, weights, strict=True)]
    pull = [w * e for w, e in zip(known, errors, strict=True)]
    return following, push, _half_square(errors), pull, [w * w for w in known]


def _symmetric(panels: tuple[Array, ...]) -> Float[Array, "unknowns unknowns *lanes"]:
    """The symmetric matrix of which each panel holds some rows, without what lies right of the panel's square."""
    size, lanes = panels[-1].shape[1], panels[0].ndim - 2
    filled = [jnp.pad(panel, ((0, 0), (0, size - panel.shape[1]), *((0, 0),) * lanes)) for panel in panels]
    lower = jnp.concatenate(filled)
    below = np.tri(size, dtype=bool).reshape(size, size, *(1,) * lanes)
    return jnp.where(below, lower, jnp.swapaxes(lower, 0, 1))


def _is_sound(state: State) -> Bool[Array, " *lanes"]:
    p, q, r = state.rates
    slow = (jnp.abs(p) < FASTEST) & (jnp.abs(q) < FASTEST) & (jnp.abs(r) < FASTEST)
    return slow if state.attitude is None else slow & (jnp.abs(state.attitude.theta) < jnp.pi / 2)


def _errors(
    row: Rows, predicted: tuple[Lanes, ...], weights: tuple[Lanes, ...], sound: Bool[Array, "*#lanes"]
) -> list[Lanes]:
    return [
        jnp.where(jnp.isnan(y) | ~sound, 0.0, w * (y - x))
        for y, w, x in zip(row.measured, weights, predicted, strict=True)
    ]


def _half_square(errors: list[Lanes]) -> Lanes:
    return functools.reduce(lambda total, e: total + e * e, errors, jnp.zeros_like(errors[0])) / 2


def each_window(function: Callable, *arguments: Any) -> Any:
    """`function` of each window. The only window of a flight needs no `vmap`, which takes long to trace."""
    if jax.tree.leaves(arguments[0])[0].shape[0] > 1:
        return jax.vmap(function)(*arguments)
    only = jax.tree.map(lambda leaf: leaf[0], arguments)
    return jax.tree.map(lambda leaf: leaf[None], function(*only))


def windowed(series: Series, index: Int[Numeric, "windows length"]) -> Series:
    """The series of each window, from those of the flight. Windows of equal length need no copy."""

    def rows(leaf: Float[Array, "samples ..."]) -> Float[Array, "windows length ..."]:
        return leaf.reshape(index.shape) if index.size == leaf.shape[0] else leaf[index]

    return jax.tree.map(rows, series)
