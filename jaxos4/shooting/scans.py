"""The inner loops: one scan over a window simulates it and sums its cost, gradient and information.

The sums travel with the state, so that memory does not grow with the flight. Derivatives are forward-mode. Values
inside a scan are scalars of a lane, because stacking them in every step is slow.
"""

import functools
import operator
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Count, InitialState, Parameters, Scalar
from ..batching import computed_once, with_batch
from ..models.state import CHANNELS, Forcing, State, Translation, unstack
from .abstract import LocalModel

if TYPE_CHECKING:
    from .problem import ShootingProblem

# rad/s; no quadrotor reaches this body rate and no gyro measures it, so a faster trajectory has diverged.
FASTEST = 1e3

# Rows of the information that are summed together, without the columns to the right of their diagonal block.
_ROWS = 4
# The first row, the row after the last, and the outputs on which the unknowns of these rows act.
Panel = tuple[int, int, tuple[int, ...]]

# Returns the state one sample later and the output of noise-free sensors, from the forcing, a state and the parameters.
Advance = Callable[[Forcing, State, tuple[Scalar, ...]], tuple[State, tuple[Scalar, ...]]]
# One value, or one for each lane of a batch.
Lanes = Float[Array, "*#lanes"]
# The number of rows that count in a padded flight. It is data and not a shape, so that flights of different lengths
# share one compiled program.
Length = Int[Array, ""] | None


class Rows(NamedTuple):
    """One window, or a batch of windows: one leaf for each channel, one row for each sample.

    `forcing` acts from each sample to the next. A missing measurement is NaN. `forcing_tangents` holds the derivatives
    of the forcing in the parameters on which it depends, along the last axis.
    """

    forcing: Forcing
    measured: tuple[Float[Array, "*windows rows"], ...]
    forcing_tangents: Forcing | None = None


def predict_window(
    advance: Advance, forcing: Forcing, parameters: Parameters, initial_state: InitialState, length: Length = None
) -> Float[Array, "length columns"]:
    """The output of noise-free sensors in one window; 0 in padding."""
    scalars, first = tuple(parameters), unstack(initial_state)

    def step(state: State, forcing: Forcing) -> tuple[State, tuple[Scalar, ...]]:
        return advance(forcing, state, scalars)

    if length is None:
        return jnp.stack(jax.lax.scan(step, first, forcing)[1], axis=-1)
    samples = forcing.roll.shape[0]
    columns = len(jax.eval_shape(step, first, jax.tree.map(lambda leaf: leaf[0], forcing))[1])

    def fill(i: Int[Array, ""], carry):
        state, outputs = carry
        state, predicted = step(state, jax.tree.map(lambda leaf: leaf[i], forcing))
        return state, outputs.at[i].set(jnp.stack(predicted))

    return jax.lax.fori_loop(0, length, fill, (first, jnp.zeros((samples, columns), dtype=float)))[1]


def with_tangents(
    of: Callable[[Parameters], Forcing], parameters: Parameters, places: tuple[int, ...]
) -> tuple[Forcing, Forcing]:
    """The forcing as a function `of` the parameters, and its derivatives in the parameters at these `places`."""
    positions = np.asarray(places, dtype=int)

    def forcing(values: Float[Array, " positions"]) -> tuple[Forcing, Forcing]:
        new = of(parameters.at[positions].set(values))
        return new._replace(recording=(), velocity=None), new  # no parameter changes these fields

    slopes, new = jax.jacfwd(forcing, has_aux=True)(parameters[positions])
    zeros: Forcing = jax.tree.map(lambda leaf: jnp.zeros((*leaf.shape, positions.size), leaf.dtype), new)
    return new, slopes._replace(recording=zeros.recording, velocity=zeros.velocity)


def shoot(
    advance: Advance,
    rows: Rows,
    weights: tuple[Scalar, ...],
    parameters: Parameters,
    initial_state: InitialState,
    length: Length = None,
) -> tuple[Scalar, Bool[Array, ""]]:
    """The cost of one simulated window, and whether its trajectory is feasible. `weights`: 1 / sigma of each channel.

    A trajectory fails at a pitch of +-90 degrees, or at a body rate above `FASTEST`. Only the samples before count. The
    cost of a failed shot is meaningless, but its derivative still points back to feasible trajectories.
    """
    scalars = tuple(parameters)

    def step(carry: tuple[State, Scalar, Array], row: Rows) -> tuple[tuple[State, Scalar, Array], None]:
        state, cost, feasible = carry
        feasible = feasible & _is_feasible(state)
        following, predicted = advance(row.forcing, state, scalars)
        return (following, cost + _half_square(_errors(row, predicted, weights, feasible)), feasible), None

    first = unstack(initial_state), jnp.zeros((), dtype=float), jnp.ones((), dtype=bool)
    if length is None:  # in a batch, `scan` keeps the lanes of a sample contiguous, which halves the time
        return jax.lax.scan(step, first, rows)[0][1:]

    def sample(i: Count, carry: tuple[State, Scalar, Array]) -> tuple[State, Scalar, Array]:
        return step(carry, jax.tree.map(lambda leaf: leaf[i], rows))[0]

    return jax.lax.fori_loop(0, length, sample, first)[1:]


def shot_with_derivatives(
    problem: "ShootingProblem", length: Length
) -> Callable[[Rows, Parameters, InitialState], LocalModel]:
    """`shoot` with derivatives: gradient and information in the parameters and a free initial state.

    It runs `_linearised_shot`, which computes a batch in lanes.
    """
    places, is_free = problem.model.forcing_parameters, problem.initial_state is None
    alone = functools.partial(_linearised_shot, forcing_parameters=places, initial_state_is_free=is_free)

    def together(lanes: int, many: Any, shared: Any) -> LocalModel:
        if many[1] is not None:  # lanes of different lengths
            return jax.vmap(lambda one: alone(*eqx.combine(one, shared)))(many)
        last = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), many[2:])
        same = jax.tree.map(lambda leaf: leaf[..., None], shared[2:])
        weights, rows, *at = eqx.combine(last, same)

        def advance(*at: Any) -> tuple[State, tuple[Lanes, ...]]:
            return jax.vmap(lambda one, *at: eqx.combine(one, shared[0])(*at))(many[0], *at)

        parameters, initial_state = (jnp.broadcast_to(values, (values.shape[0], lanes)) for values in at)
        out = alone(advance, shared[1], weights, rows, parameters, initial_state)
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), out)

    return with_batch(alone, together, problem.advance, length, problem.weights)


class _Carried(NamedTuple):
    """A linearised shot up to some sample.

    - `late`: the tangents of the unknowns that act on the translation alone. `tangent`: those of all other unknowns.
    - `cost`, `feasible`: see `shoot`.
    - `gradient`: in the unknowns of `tangent`, and then of `late`.
    - `information`: in panels of rows, each in the columns of `tangent`, and then of `late`. Columns to the right of
      the rows' diagonal block are left out.
    """

    state: State
    tangent: State
    late: Translation | None
    cost: Lanes
    feasible: Bool[Array, "*lanes"]
    gradient: list[Array]
    information: list[list[Array]]


def _linearised_shot(
    advance: Advance,
    length: Length,
    weights: tuple[Lanes, ...],
    rows: Rows,
    parameters: Float[Array, "parameters *lanes"],
    initial_state: Float[Array, "size *lanes"],
    *,
    forcing_parameters: tuple[int, ...],
    initial_state_is_free: bool,
) -> LocalModel:
    """`shot_with_derivatives` for one flight, or for flights in lanes, which are then the last axis of all arrays.

    Rows and weights that all lanes share have a last axis of 1.
    """
    (count, *lanes), scalars = parameters.shape, tuple(parameters)

    def along_lanes(leaf: Array) -> Array:
        return jnp.broadcast_to(leaf, tuple(lanes))

    at = jax.tree.map(lambda leaf: along_lanes(leaf[0]), rows.forcing), unstack(initial_state), scalars
    first_late, panels = panels_of(advance, at, forcing_parameters, free=initial_state_is_free)
    # NumPy, so that they are constants of the program.
    parameter_tangents = tuple(np.eye(count, first_late, dtype=parameters.dtype))

    def step(i: Count, carry: _Carried) -> _Carried:
        row = jax.tree.map(lambda leaf: leaf[i], rows)
        feasible = carry.feasible & _is_feasible(carry.state)
        # After a failure the state is 0, so that no derivative overflows.
        state = jax.tree.map(lambda x: jnp.where(feasible, x, 0.0), carry.state)
        forcing = jax.tree.map(along_lanes, row.forcing)

        # If only the rates are simulated, repeating them is cheaper.
        repeated = not lanes or state.attitude is None
        at, late = (forcing, state, scalars), carry.late
        sample = functools.partial(_linearised_sample, advance, row, at, weights, feasible, late is not None)
        following, push, push_late, cost, pull, squares = sample() if repeated else computed_once(feasible, sample)
        directions = [carry.tangent, parameter_tangents]
        if row.forcing_tangents is not None:
            nothing, positions = jnp.zeros((first_late, *lanes), parameters.dtype), np.asarray(forcing_parameters)
            wide = jax.tree.map(lambda slope: nothing.at[positions].set(slope), row.forcing_tangents)
            directions.insert(0, wide)

        def pushed(*direction: Any) -> tuple[State, tuple[Lanes, ...]]:
            return push(*jax.tree.map(along_lanes, direction))

        tangent, *slopes = jax.vmap(pushed)(*directions)
        if push_late is not None:
            moved, of_late = jax.vmap(push_late)(late)
            late, slopes = moved.translation, [*slopes, of_late]

        gradient = [g - sum(map(operator.mul, pull, s)) for g, s in zip(carry.gradient, slopes, strict=True)]
        information = [
            _added(blocks, panel, first_late, squares, slopes)
            for panel, blocks in zip(panels, carry.information, strict=True)
        ]
        return _Carried(following, tangent, late, carry.cost + cost, feasible, gradient, information)

    samples = rows.forcing.roll.shape[0] if length is None else length
    first = _before(initial_state, count, first_late, panels)
    last = jax.lax.fori_loop(0, samples, step, first)
    information = symmetric(tuple(jnp.concatenate(blocks, axis=1) for blocks in last.information))
    return LocalModel(last.cost, last.feasible, jnp.concatenate(last.gradient), information)


def _before(initial_state: Float[Array, "size *lanes"], count: int, first_late: int, panels: list[Panel]) -> _Carried:
    """The carry before the first sample, for `count` parameters. The unknowns before `first_late` have a `tangent`."""
    (size, *lanes), unknowns, dtype = initial_state.shape, panels[-1][1], initial_state.dtype
    own = np.eye(size, unknowns, count, dtype=dtype).reshape(size, unknowns, *(1 for _ in lanes))
    tangents = jnp.broadcast_to(own, (size, unknowns, *lanes))

    def zeros(*shape: int) -> Array:
        return jnp.zeros((*shape, *lanes), dtype=dtype)

    def blocks(top: int, end: int) -> list[Array]:
        return [zeros(end - top, width) for width in ([end] if top < first_late else [first_late, end - first_late])]

    return _Carried(
        state=unstack(initial_state),
        tangent=unstack(tangents[:, :first_late]),
        late=unstack(tangents[:, first_late:]).translation if first_late < unknowns else None,
        cost=zeros(),
        feasible=jnp.ones(tuple(lanes), dtype=bool),
        gradient=[zeros(width) for width in (first_late, unknowns - first_late) if width],
        information=[blocks(top, end) for top, end, _ in panels],
    )


def _added(
    blocks: list[Array], panel: Panel, first_late: int, squares: list[Lanes], slopes: list[tuple[Array, ...]]
) -> list[Array]:
    """The rows of a panel, with those of one sample added."""
    (top, end, outputs), late = panel, len(blocks) - 1
    own = slice(top - first_late * late, end - first_late * late)
    rows = [(i, (squares[i] * slopes[late][i][own])[:, None]) for i in outputs]
    return [b + sum(row * s[i][: b.shape[1]] for i, row in rows) for b, s in zip(blocks, slopes, strict=False)]


def _linearised_sample(
    advance: Advance,
    row: Rows,
    at: tuple[Forcing, State, tuple[Lanes, ...]],
    weights: tuple[Lanes, ...],
    feasible: Bool[Array, "*lanes"],
    has_late: bool,
) -> tuple[State, Callable, Callable | None, Lanes, list[Lanes], list[Lanes]]:
    """The next state, the derivative of `advance`, the cost, and the weighted errors and squared weights.

    The second derivative is in the translation alone; `None` unless `has_late`.
    """
    forcing, state, scalars = at
    if row.forcing_tangents is None:
        linear = jax.linearize(functools.partial(advance, forcing), state, scalars)
    else:
        linear = jax.linearize(advance, forcing, state, scalars)
    (following, predicted), push = linear
    errors = _errors(row, predicted, weights, feasible)
    known = [jnp.where(jnp.isnan(y) | ~feasible, 0.0, w) for y, w in zip(row.measured, weights, strict=True)]
    pull = [w * e for w, e in zip(known, errors, strict=True)]
    push_late = None
    if has_late:
        _, push_late = jax.linearize(
            lambda t: advance(forcing, state._replace(translation=t), scalars), state.translation
        )
    return following, push, push_late, _half_square(errors), pull, [w * w for w in known]


def _is_feasible(state: State) -> Bool[Array, " *lanes"]:
    p, q, r = state.rates
    slow = (jnp.abs(p) < FASTEST) & (jnp.abs(q) < FASTEST) & (jnp.abs(r) < FASTEST)
    return slow if state.attitude is None else slow & (jnp.abs(state.attitude.theta) < jnp.pi / 2)


def _errors(
    row: Rows, predicted: tuple[Lanes, ...], weights: tuple[Lanes, ...], feasible: Bool[Array, "*#lanes"]
) -> list[Lanes]:
    return [
        jnp.where(jnp.isnan(y) | ~feasible, 0.0, w * (y - x))
        for y, w, x in zip(row.measured, weights, predicted, strict=True)
    ]


def _half_square(errors: list[Lanes]) -> Lanes:
    return functools.reduce(lambda total, e: total + e * e, errors, jnp.zeros_like(errors[0])) / 2


def panels_of(
    advance: Callable, at: tuple[Any, Any, tuple], forcing_parameters: tuple[int, ...], *, free: bool
) -> tuple[int, list[Panel]]:
    """The index after the last unknown that acts on rates or attitude, and the panels of all rows.

    - `advance`: returns the next state and the outputs, from the forcing, a state and the parameters, which are `at`.
      An inner function of it counts as one operation.
    - `free`: whether the initial state is unknown too. Its leaves then follow the parameters.
    """
    program = jax.make_jaxpr(advance)(*at).jaxpr
    nothing = np.zeros(len(program.invars), dtype=bool)
    known = dict(zip(program.invars, np.eye(nothing.size, dtype=bool), strict=True))

    def sources(variables: list) -> np.ndarray:
        """The leaves of `at` on which any of these variables depends."""
        return np.any([nothing, *(known.get(v, nothing) for v in variables if not isinstance(v, Literal))], axis=0)

    for equation in program.eqns:
        known |= dict.fromkeys(equation.outvars, sources(equation.invars))
    leaves = np.array([sources([v]) for v in program.outvars])
    forces, size, count = (len(jax.tree.leaves(part)) for part in at)
    unknowns = np.eye(count + size * free, dtype=bool)
    reached = unknowns[count:] if free else np.zeros((size, count), dtype=bool)
    driven = np.zeros((forces, len(unknowns)), dtype=bool)
    driven[:, list(forcing_parameters)] = True
    for _ in range(size):  # an effect reaches the last state after at most `size` samples
        reached = reached | (leaves @ np.concatenate([driven, reached, unknowns[:count]]))[:size]
    acting, panels = (leaves @ np.concatenate([driven, reached, unknowns[:count]]))[size:], []
    first_late = max(count, *(np.flatnonzero(reached[: CHANNELS["attitude"]].any(axis=0)) + 1).tolist())
    for row, outputs in enumerate(tuple(np.flatnonzero(column).tolist()) for column in acting.T):
        top, _, before = panels[-1] if panels else (row, row, ())
        joined = before == outputs and row - top < _ROWS and row != first_late
        panels = [*panels[:-1], (top, row + 1, outputs)] if joined else [*panels, (row, row + 1, outputs)]
    return first_late, panels


def symmetric(panels: tuple[Array, ...]) -> Float[Array, "unknowns unknowns *lanes"]:
    """The symmetric matrix from panels of its rows, which end with their diagonal blocks."""
    size, lanes = panels[-1].shape[1], panels[0].ndim - 2
    filled = [jnp.pad(panel, ((0, 0), (0, size - panel.shape[1]), *((0, 0),) * lanes)) for panel in panels]
    lower = jnp.concatenate(filled)
    below = np.tri(size, dtype=bool).reshape(size, size, *(1,) * lanes)
    return jnp.where(below, lower, jnp.swapaxes(lower, 0, 1))
