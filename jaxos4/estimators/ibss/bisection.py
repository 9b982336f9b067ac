"""Bisect along a direction, and along all directions one after another."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

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


def move_along_all(
    stage: Stage, view: View, brackets: Brackets, *, whitened: bool, halvings: int, stay: Bool[Array, ""]
) -> Moves:
    """Bisects along each direction in turn; along none with `stay`."""
    nothing = jnp.zeros_like(view.unknowns)
    moves = Moves(view.unknowns, nothing, nothing, nothing.astype(bool))
    size, free = nothing.shape[1], stage.problem.free_size
    forcing_parameters = len(stage.problem.model.forcing_parameters)
    # Whitened directions change the forcing only at the end of the list: it is recomputed only for those.
    unchanged = size - forcing_parameters if whitened or not forcing_parameters else 0
    fixed = view.rows._replace(forcing_tangents=None)
    # The directions of the initial states that this stage does not search, `own` to `free`, are skipped.
    skipped = free - stage.own
    for begin, end, rows_at in ((0, unchanged, lambda _: fixed), (unchanged, size, stage.with_forcing)):
        if begin < end:
            first = jnp.where(begin == 0, skipped, begin)

            def along(i: Int[Array, ""], moves: Moves, rows_at: RowsAt = rows_at) -> Moves:
                number = jnp.where(i < free, i - skipped, i)
                return _move_along(stage, view, brackets, rows_at, halvings, number, moves)

            moves = jax.lax.fori_loop(first, jnp.where(stay, first, end), along, moves)
    return moves


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
