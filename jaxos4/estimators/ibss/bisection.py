"""Bisect along a direction, and along all directions one after another."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...shooting import Rows
from .brackets import Brackets, room
from .stage import RowsAt, Stage
from .view import View


class Moves(NamedTuple):
    """Where a sweep has come to, and for each direction its step, the prediction's error, and whether to grow.

    `at_end`: the search ended at an end of its bracket that was not a limit of the unknowns.
    """

    unknowns: Float[Array, "windows unknowns"]
    steps: Float[Array, "windows unknowns"]
    errors: Float[Array, "windows unknowns"]
    at_end: Bool[Array, "windows unknowns"]


def move_along_all(stage: Stage, view: View, brackets: Brackets, *, halvings: int, stay: Bool[Array, ""]) -> Moves:
    """Bisects along each direction in turn; along none with `stay`."""
    nothing = jnp.zeros_like(view.unknowns)
    moves = Moves(view.unknowns, nothing, nothing, nothing.astype(bool))
    changes = len(stage.problem.model.forcing_parameters)
    first_change = view.unknowns.shape[1] - changes
    fixed = view.rows._replace(forcing_tangents=None)

    def along(i: Int[Array, ""], moves: Moves) -> Moves:
        number = stage.order[i]

        def rows_at(unknowns: Float[Array, "windows unknowns"]) -> Rows:
            """The last directions alone change the forcing: it is recomputed only for those."""
            if not changes:
                return fixed
            return jax.lax.cond(number >= first_change, stage.with_forcing, lambda _: fixed, unknowns)

        return _move_along(stage, view, brackets, rows_at, halvings, number, moves)

    return jax.lax.fori_loop(0, jnp.where(stay, 0, stage.size), along, moves)


def _move_along(
    stage: Stage, view: View, brackets: Brackets, rows_at: RowsAt, halvings: int, number: Int[Array, ""], moves: Moves
) -> Moves:
    """Bisects along one direction, in a bracket around the step that the quadratic model predicts from here."""
    unknowns, steps, errors, at_end = moves
    direction, longest = view.basis[:, :, number], brackets.longest[:, number]
    below, above = (jnp.minimum(most, longest) for most in room(unknowns, direction, stage.limits))
    gradient = view.curvature.gradient + jnp.einsum("wuv,wv->wu", view.information, unknowns - view.unknowns)
    predicted = stage.summed(number, -(direction * gradient).sum(axis=-1))
    predicted = jnp.clip(jnp.nan_to_num(predicted), -below, above)
    lower = jnp.maximum(predicted - brackets.half_width[:, number], -below)
    upper = jnp.minimum(predicted + brackets.half_width[:, number], above)
    step, at_lower, at_upper = bisect(stage.slope(rows_at, unknowns, direction, number), lower, upper, halvings)
    return Moves(
        unknowns + step[:, None] * direction,
        steps.at[:, number].set(step),
        errors.at[:, number].set(step - predicted),
        at_end.at[:, number].set((at_lower & (lower > -below)) | (at_upper & (upper < above))),
    )


def bisect(
    slope: Callable[[Float[Array, " windows"]], Float[Array, " windows"]],
    lower: Float[Array, " windows"],
    upper: Float[Array, " windows"],
    halvings: int,
) -> tuple[Float[Array, " windows"], Bool[Array, " windows"], Bool[Array, " windows"]]:
    """Halves each bracket towards the zero of the slope, in all windows in parallel.

    Returns the middle of the last bracket, and whether the search ended at the lower or the upper end of the first.
    """

    def halve(ends, _):
        low, high = ends
        middle = (low + high) / 2
        value = slope(middle)
        return (jnp.where(value <= 0, middle, low), jnp.where(value >= 0, middle, high)), None

    (low, high), _ = jax.lax.scan(halve, (lower, upper), length=halvings)
    return (low + high) / 2, low == lower, high == upper
