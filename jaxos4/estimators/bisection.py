"""The state of a search by IBSS, the directions along which it goes, and the brackets along them.

All steps are in standard deviations. The unknowns of a window are the shared ones, then its own initial state.
Directions are in the opposite order: those of the initial state come first, so that a step along a parameter carries
the initial states to where they fit best.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Scalar
from ..linalg import JointFactor
from ..shooting import AbstractProblem, Curvature, Shot, Stages
from ..shooting.abstract import WindowUnknowns

PerDirection = Float[Array, "windows n"]

# A sweep that raises the cost by no more may have done so by chance.
_CHANCE = 1.0
_ROUGH = 0.2  # the share of a step that counts along an unknown with a stride: its gradient is approximate
_STRIDE = 0.1  # the information that keeps the predicted steps along an unknown with a stride short


class State(NamedTuple):
    """The search after a sweep.

    - `unknowns`, `curvature`: where it is, and the curvature of the cost there.
    - `spread`: the covariance of the unknowns, which sizes the first brackets of a stage.
    - `error`: how far the last predictions were off, as a share of the longest step.
    - `growth`: by how much each direction's bracket is wider than this error asks for.
    - `trust`: the share of the longest predicted step that a sweep may go.
    - `sweeps`: in this stage; -1 before its first shot, which is at the start. `earlier`: in the stages before.
    - `rollouts`: simulated flights.
    - `done`: whether the search ended by itself.
    - `record`: the bracket of each parameter in each sweep.
    """

    unknowns: WindowUnknowns
    curvature: Curvature
    spread: Float[Array, "windows unknowns unknowns"]
    error: Scalar
    growth: PerDirection
    trust: Scalar
    sweeps: Int[Array, ""]
    earlier: Int[Array, ""]
    rollouts: Int[Array, ""]
    done: Bool[Array, ""]
    record: Float[Array, "record 2 parameters"] | None


class Around(NamedTuple):
    """The view from where a sweep begins: directions of unit information, and the way to the predicted minimum.

    - `factor`, `basis`: see `JointFactor`. A direction is a column of `basis`.
    - `moves`: the unknowns that move: not those at a limit, beyond which the cost falls.
    - `below`, `above`: the way to the limits, against and along each direction.
    - `longest`: the longest predicted step. `near`: whether it is short enough to end the search.
    - `spent`: whether the stage has had its most sweeps, so that this one only looks around.
    """

    factor: Float[Array, "windows unknowns n"]
    basis: Float[Array, "windows unknowns n"]
    moves: Bool[Array, "windows unknowns"]
    below: PerDirection
    above: PerDirection
    longest: Scalar
    near: Bool[Array, ""]
    spent: Bool[Array, ""]


class Stage(NamedTuple):
    """The `number`-th of the stages of a problem; `prior`: of unknowns about which the cost has no prior of its own."""

    problem: AbstractProblem
    stages: Stages
    number: Int[Array, ""]
    prior: Float[Array, "windows unknowns unknowns"]
    limits: tuple[WindowUnknowns, WindowUnknowns]

    @classmethod
    def of(cls, problem: AbstractProblem, stages: Stages, number: Int[Array, ""], reach: Scalar) -> "Stage":
        """A stage of a problem, whose search goes at most `reach` half-widths from the bracket's center."""
        unknowns, prior = problem.unknowns, 1 / jnp.square(prior_std(problem))
        # A cost with a prior of its own needs no other, but the information misjudges the curvature along a stride.
        own, least = unknowns.precision > 0, _STRIDE / jnp.square(unknowns.stride)
        shared = jnp.where(own, least, prior[:, : unknowns.count] / problem.windows)
        prior = prior.at[:, : unknowns.count].set(shared)[:, :, None] * np.eye(prior.shape[1])
        return cls(problem, stages, number, prior, problem.limits(reach))

    @property
    def searched(self) -> Bool[Array, " unknowns"]:
        """The unknowns that the stage searches."""
        return self.stages.searched[self.number]

    @property
    def smallest_step(self) -> Scalar:
        """The step below which rounding decides the sign of a slope."""
        return self.stages.smallest_step[self.number]

    def along(self, basis: Array, gradient: WindowUnknowns, moves: Bool[Array, "windows unknowns"]) -> PerDirection:
        """The slope along each direction, of the unknowns that move."""
        return slopes_along(basis, jnp.where(moves, gradient, 0.0), self.problem.free_size)

    def distance(self, steps: PerDirection) -> Scalar:
        """The longest of some steps to the minimum; those along an unknown with a stride count less."""
        strides = self.problem.each_window(self.problem.unknowns.stride, jnp.inf)[0]
        weight = jnp.where(jnp.isfinite(strides), _ROUGH, 1.0)
        return (jnp.abs(steps) * jnp.roll(weight, -self.problem.unknowns.count)).max()

    def misfit(self, curvature: Curvature) -> Scalar:
        """By how much the residuals exceed the noise of the problem."""
        return self.stages.misfit(self.number, curvature.shot.cost.sum())


class Lines(NamedTuple):
    """The bracket along each direction, as steps from where the sweep began.

    - `predicted`: the predicted step to the minimum.
    - `lower`, `upper`: the bracket around it. `low`, `high`: the part of it that may hold the minimum.
    - `trial`: the step of the next shot.
    - `last`, `value`: the step of the last shot, and the slope there.
    - `rate`: the slope's rate of change.
    """

    predicted: PerDirection
    lower: PerDirection
    upper: PerDirection
    low: PerDirection
    high: PerDirection
    trial: PerDirection
    last: PerDirection
    value: PerDirection
    rate: PerDirection


def coordinate_directions(information: Float[Array, "windows n n"], count: int) -> JointFactor:
    """The unknowns themselves as directions, each scaled to unit information: the diagonal of A, and of A^-T."""
    size = information.shape[-1]
    diagonal = jnp.diagonal(information, axis1=1, axis2=2)
    scale = jnp.sqrt(jnp.where(np.arange(size) < count, diagonal.sum(axis=0), diagonal))[:, :, None]
    columns = jnp.eye(size)[:, np.roll(np.arange(size), -count)]
    return JointFactor(scale * columns, columns / scale)


def slopes_along(
    basis: Float[Array, "windows unknowns n"], gradient: Float[Array, "windows unknowns"], own: int
) -> PerDirection:
    """The slope along each direction: summed over the windows, unless it is one of the first `own`."""
    slopes = jnp.einsum("wud,wu->wd", basis, gradient)
    return slopes.at[:, own:].set(slopes[:, own:].sum(axis=0))


def room_to_limits(
    unknowns: Float[Array, "windows n"],
    basis: Float[Array, "windows n n"],
    lower: Float[Array, "windows n"],
    upper: Float[Array, "windows n"],
) -> tuple[PerDirection, PerDirection]:
    """How far each window can go against and along each direction until an unknown reaches its limit."""
    moves = basis != 0
    to_lower, to_upper = ((limit - unknowns)[:, :, None] / jnp.where(moves, basis, 1.0) for limit in (lower, upper))
    above = jnp.where(moves, jnp.maximum(to_lower, to_upper), jnp.inf).min(axis=1)
    below = jnp.where(moves, -jnp.minimum(to_lower, to_upper), jnp.inf).min(axis=1)
    return jnp.maximum(below, 0.0), jnp.maximum(above, 0.0)


def open_lines(predicted: PerDirection, half_width: PerDirection, below: PerDirection, above: PerDirection) -> Lines:
    """Brackets of some half-width around the predicted steps, which go at most `below` backwards, `above` forwards.

    The first trial is the middle, and the expected rate of change is that of unit information.
    """
    predicted = jnp.clip(jnp.nan_to_num(predicted), -below, above)
    lower = jnp.maximum(predicted - half_width, -below)
    upper = jnp.minimum(predicted + half_width, above)
    middle, zero = (lower + upper) / 2, jnp.zeros_like(lower)
    return Lines(predicted, lower, upper, lower, upper, middle, middle, zero, jnp.ones_like(lower))


def narrow(lines: Lines, slope: PerDirection) -> Lines:
    """The lines after a shot at their trials.

    The sign of the slope decides which side of the trial holds the minimum. A secant proposes the next trial: the zero
    of a line through the last two slopes, at first with the expected rate of change. If that lies outside of the
    remaining bracket, the next trial is the middle.
    """
    low = jnp.where(slope <= 0, lines.trial, lines.low)
    high = jnp.where(slope >= 0, lines.trial, lines.high)
    secant = (slope - lines.value) / (lines.trial - lines.last)
    rate = jnp.where((secant > 0) & jnp.isfinite(secant), secant, lines.rate)
    zero = lines.trial - slope / rate
    narrowed_there = ((zero <= low) & (low > lines.lower)) | ((zero >= high) & (high < lines.upper))
    following = jnp.where(narrowed_there, (low + high) / 2, jnp.clip(zero, low, high))
    return lines._replace(low=low, high=high, trial=following, last=lines.trial, value=slope, rate=rate)


def bisected_in(sweep: Int[Array, ""], searched: Bool[Array, " unknowns"], count: int) -> Bool[Array, " n"]:
    """The one direction that a sweep along coordinates bisects: each searched unknown has its turn."""
    rank = jnp.cumsum(searched) - 1
    is_next = searched & (rank == sweep % jnp.maximum(searched.sum(), 1))
    return is_next[np.roll(np.arange(searched.shape[0]), -count)]


def record_bracket(
    state: State, around: Around, half_width: PerDirection
) -> Float[Array, "record 2 parameters"] | None:
    """The record with the bracket of each parameter in one more sweep; sweeps beyond its length are dropped."""
    if state.record is None:
        return None
    count, skip = state.record.shape[-1], around.near | around.spent | (state.sweeps < 0)
    widest = jnp.abs(around.basis * half_width[:, None, :]).max(axis=(0, 2))[:count]
    bracket = state.unknowns[0, :count] + jnp.stack([-widest, widest])
    place = jnp.where(skip, state.record.shape[0], state.earlier + state.sweeps)
    return state.record.at[place].set(bracket, mode="drop")


def prior_std(problem: AbstractProblem) -> WindowUnknowns:
    """Standard deviation of each unknown without the flight: half of how far off the unknown may be."""
    return problem.join(problem.unknowns.usable.half_width, problem.first_state()[1]) / 2


def no_worse(shot: Shot, before: Shot) -> Bool[Array, ""]:
    """The cost of a flight that fails means nothing."""
    sound, was_sound = shot.sound.all(), before.sound.all()
    return ~was_sound | (sound & (shot.cost.sum() <= before.cost.sum() + _CHANCE))
