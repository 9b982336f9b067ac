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
    unknowns, steps, errors, ended = moves
    direction, longest = view.basis[:, :, number], brackets.longest[:, number]
    below, above = (jnp.minimum(most, longest) for most in room(unknowns, direction, stage.limits))
    gradient = view.curvature.gradient + jnp.einsum("wuv,wv->wu", view.information, unknowns - view.unknowns)
    predicted = stage.summed(number, -(direction * gradient).sum(axis=-1))
    predicted = jnp.clip(jnp.nan_to_num(predicted), -below, above)
    lower = jnp.maximum(predicted - brackets.half_width[:, number], -below)
    upper = jnp.minimum(predicted + brackets.half_width[:, number], above)
    step, at_end = bisect(stage.slope(rows_at, unknowns, direction, number), lower, upper, halvings)
    return Moves(
        unknowns + step[:, None] * direction,
        steps.at[:, number].set(step),
        errors.at[:, number].set(step - predicted),
        ended.at[:, number].set(at_end & (step > -below) & (step < above)),
    )


def bisect(
    slope: Callable[[Float[Array, " windows"]], Float[Array, " windows"]],
    lower: Float[Array, " windows"],
    upper: Float[Array, " windows"],
    halvings: int,
) -> tuple[Float[Array, " windows"], Bool[Array, " windows"]]:
    """Narrows each bracket towards the zero of the slope, in all windows in parallel.

    The sign of the slope says which side of the trial holds the zero. The first trial is the middle. The next is where
    a line meets zero: through the last two trials, at first with the slope's rate of change of a direction of unit
    information. It is the middle again if the line leads out of what is left of the bracket.

    Returns the best guess of the zero, and whether it is an end of the bracket.
    """

    def halve(carry, _):
        low, high, trial, rate, last = carry
        value = slope(trial)
        low, high = jnp.where(value <= 0, trial, low), jnp.where(value >= 0, trial, high)
        secant = (value - last[1]) / (trial - last[0])
        rate = jnp.where(secant > 0, secant, rate)
        zero = trial - value / rate
        narrowed_there = ((zero <= low) & (low > lower)) | ((zero >= high) & (high < upper))
        following = jnp.where(narrowed_there, (low + high) / 2, jnp.clip(zero, low, high))
        return (low, high, following, rate, (trial, value)), None

    middle = (lower + upper) / 2
    first = lower, upper, middle, jnp.ones_like(middle), (middle, jnp.zeros_like(middle))
    (_, _, found, _, _), _ = jax.lax.scan(halve, first, length=halvings)
    return found, (found == lower) | (found == upper)
