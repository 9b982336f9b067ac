"""Iterative Bi-Section Shooting (IBSS): narrow brackets by the sign of the slope of the cost.

The paper names the method but does not give its steps; the steps here are our choice (docs/method/ibss.md). They are
the five calls in `IBSS.sweep`.
"""

import functools
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Count, InitialStates, Parameters, Scalar, integer, setting
from ..bracket import Bracket
from ..estimate import REACH, AbstractEstimator, Estimate, estimate_at, from_starts
from ..linalg import gram, joint_factor, movable, room_to_limits, slopes_along
from ..shooting import AbstractProblem, Curvature, Stages, in_blocks
from ..shooting.abstract import WindowUnknowns
from .bisection import Brackets, Directions, Flag, PerDirection, Stage, prior_std

_COARSE = 0.5  # every stage but the last ends when the minimum is at most this many standard deviations away
# The first sweep of a stage: its longest step in standard deviations of the stage's start, and the half-width of its
# brackets as a share of that.
_OPENING, _FIRST = 4.0, 0.05
# Later: half-width / longest step = _SAFETY times the relative error of the last predictions, from _NARROWEST to 1.
_SAFETY, _NARROWEST = 2.0, 0.01
# If the last shot was at an end of its bracket, its growth is multiplied by _GROWTH, up to _WIDEST.
_GROWTH, _WIDEST = 4.0, 256.0
_CHANCE = 1.0  # a sweep may raise the cost by this much and is still kept
# A sweep has stalled if its predicted steps are at most _SHORT, and it lowers the cost by no more than _GAIN.
_SHORT, _GAIN = 0.3, 1e-4
# The trust is multiplied by _RETREAT after a rejected sweep, and by _ADVANCE after any other.
_RETREAT, _ADVANCE = 0.25, 1.4


class State(NamedTuple):
    """The search after a sweep.

    - `unknowns`, `curvature`: where it is, and the curvature of the cost there.
    - `spread`: the covariance of the unknowns, which sizes the first brackets of a stage.
    - `relative_width`: the half-width of the next brackets, as a share of the longest step. `growth`: how many times as
      wide each direction's bracket is.
    - `trust`: the share of the longest predicted step that a sweep may go; 1: no limit.
    - `number_in_stage`: the number of the next sweep in this stage; -1: only a shot at the start.
    - `sweeps`: the number of sweeps with at least one shot. `rollouts`: see `Estimate.rollouts`. Both count all stages.
    - `done`: whether the stage ended by itself. `record`: see `Estimate.brackets`.
    """

    unknowns: WindowUnknowns
    curvature: Curvature
    spread: Float[Array, "windows unknowns unknowns"]
    relative_width: Scalar
    growth: PerDirection
    trust: Scalar
    number_in_stage: Count
    sweeps: Count
    rollouts: Count
    done: Flag
    record: Float[Array, "record 2 parameters"]


_KEPT = ("unknowns", "curvature", "spread", "sweeps", "rollouts", "record")  # from stage to stage
# What a sweep found: the brackets after its shots, the last shot's unknowns and curvature, and how many shots it took.
Bisected = tuple[Brackets, WindowUnknowns, Curvature, Count]


class IBSS(AbstractEstimator):
    """Iterative Bi-Section Shooting.

    A *shot* simulates the flight at trial unknowns, and gives the cost with its gradient and information. **The sign of
    the cost's slope along a direction decides** which side of the trial holds the minimum, and so which part of the
    bracket is dropped. The quadratic model and the secant through the last slopes **propose** where to shoot. The size
    of the slopes decides when to stop, and the cost whether a point is kept. A *sweep* is one iteration. A *stage*
    repeats sweeps on some of the data until the minimum is near; the last stage fits all of them. The directions of a
    sweep are the columns of L^-T, with L L^T the Fisher information at the current estimate: the cost is nearly
    separable along them, so a sweep bisects all together. Parameters are bisected on the sum of all windows' slopes,
    initial states on those of their own window.

    **Arguments:**

    - `halvings`: the shots of a sweep that narrow the brackets.
    - `max_sweeps`: the most sweeps of a stage.
    - `tolerance`: the search ends once the minimum is at most this many standard deviations away along each
      direction. These are scaled by the `misfit` of the residuals, so noise-free data are fitted to rounding errors.
    - `reach`: the search does not go further than this many half-widths from the bracket's center.
    - `record`: how many sweeps' brackets the estimate keeps.
    """

    shoots: ClassVar[bool] = True
    in_closed_loop: ClassVar[bool] = True

    halvings: int = eqx.field(static=True, converter=integer("halvings", 2, static=True), default=2)
    max_sweeps: Count = eqx.field(converter=integer("max_sweeps", 1), default=60)
    tolerance: Scalar = eqx.field(converter=setting("tolerance", positive=True), default=0.005)
    reach: Scalar = eqx.field(converter=setting("reach", positive=True), default=REACH)
    record: int = eqx.field(static=True, converter=integer("record", 0, static=True), default=0)

    @eqx.filter_jit
    def __call__(
        self,
        problem: AbstractProblem,
        bracket: Bracket | None = None,
        *,
        start: Float[Array, " unknowns"] | None = None,
    ) -> Estimate:
        """Identifies one flight.

        **Arguments:**

        - `problem`, `bracket`: see `AbstractEstimator`. The parameters may turn out to lie outside of the bracket.
        - `start`: where the search begins, unless it is NaN; by default the problem's `starts`.

        **Raises:** `ValueError` for a bracket or a start of another length than the unknowns.
        """
        return in_blocks(self.search, problem.within(bracket), start)

    def search(
        self,
        problem: AbstractProblem,
        start: Float[Array, " unknowns"] | None = None,
        spread: Float[Array, "given given"] | None = None,
        *,
        initial_state: InitialStates | None = None,
        cascade: Flag | bool = True,
        skip: Flag | bool = False,
    ) -> Estimate:
        """Identifies one flight, inside the program of another estimator.

        **Arguments:** as of a call, and

        - `spread`: the covariance of the parameters of `start`, which sizes the first brackets; by default that of the
          bracket, with its half-width as two standard deviations.
        - `initial_state`: where the search for a free initial state begins; by default the first measurements.
        - `cascade`: whether to go through all stages. A `start` that is close needs the last one only.
        - `skip`: whether to return no answer, without a shot. Other lanes of the batch do not wait for this one.
        """
        initial = problem.first_state()[0] if initial_state is None else initial_state
        stages = problem.stages(cascade=True)
        stages = stages._replace(evaluate=jax.jit(stages.evaluate, inline=True))  # traced once, although called twice

        def from_one(start: Parameters) -> Estimate:
            first = self.init(problem, stages, problem.join(start, initial), spread, skip)

            def fit(number: Count, state: State) -> State:
                """One stage: sweeps from where the last stage ended."""
                stage = Stage.of(problem, stages, number, self.reach)
                sweep = functools.partial(self.sweep, stage)
                begin = first._replace(**{name: getattr(state, name) for name in _KEPT})
                return jax.lax.while_loop(lambda state: ~self.terminate(state), sweep, begin)

            # One loop, so that the search is compiled once for all stages.
            begin = jnp.where(cascade, 0, stages.number - 1).astype(int)
            end = jax.lax.fori_loop(begin, stages.number, fit, first)
            more = {"reach": self.reach, "brackets": end.record if self.record else None}
            return estimate_at(problem, end.unknowns, end.curvature, end.rollouts, end.sweeps, done=end.done, **more)

        return from_starts(problem, start, from_one)

    def init(
        self, problem: AbstractProblem, stages: Stages, start: WindowUnknowns, spread: Array | None, skip: Flag | bool
    ) -> State:
        """The search before its first shot."""
        unknowns = jnp.clip(start, *problem.limits(self.reach))
        covariance = jax.vmap(jnp.diag)(jnp.square(prior_std(problem)))
        if spread is not None:
            size = spread.shape[0]
            # A search that is skipped may have no finite spread.
            covariance = covariance.at[:, :size, :size].set(jnp.where(skip, covariance[:, :size, :size], spread))
        zero = jnp.zeros((), dtype=int)
        shapes = jax.eval_shape(stages.evaluate, zero, unknowns)
        return State(
            unknowns=unknowns,
            curvature=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes),
            spread=covariance,
            relative_width=jnp.zeros((), dtype=float),
            growth=jnp.ones_like(unknowns),
            trust=jnp.ones((), dtype=float),
            number_in_stage=zero - 1,
            sweeps=zero,
            rollouts=zero,
            done=jnp.asarray(skip),
            record=jnp.full((self.record, 2, problem.unknowns.count), jnp.nan),
        )

    def sweep(self, stage: Stage, state: State) -> State:
        """One iteration, in the five steps of docs/method/ibss.md."""
        directions = self._look_around(stage, state)
        predicted, near = self._predict(stage, state, directions)
        brackets = self._open(stage, state, directions, predicted)
        found = self._bisect(stage, state, directions, near, brackets)
        return self._judge(stage, state, directions, predicted, near, found)

    def terminate(self, state: State) -> Flag:
        """Whether the stage has ended. One more call after the last sweep does not shoot: is the minimum near?"""
        return state.done | (state.number_in_stage > self.max_sweeps)

    def _look_around(self, stage: Stage, state: State) -> Directions:
        """1. Choose directions in which the cost is nearly separable, from its curvature where the sweep begins."""
        unknowns, curvature, count = state.unknowns, state.curvature, stage.problem.unknowns.count
        moves = movable(unknowns, curvature.gradient, stage.limits, count)
        information = jnp.where(moves[:, :, None] & moves[:, None, :], curvature.information, 0.0)
        factor, basis = joint_factor(information + stage.added_information, count)
        lower, upper = (jnp.where(moves, limit, unknowns) for limit in stage.limits)
        return Directions(factor, basis, moves, *room_to_limits(unknowns, basis, (lower, upper)))

    def _predict(self, stage: Stage, state: State, directions: Directions) -> tuple[PerDirection, Flag]:
        """2. Predict the step to the quadratic model's minimum: minus the slope. If it is near, the stage ends."""
        steps = jnp.clip(-self._slopes(stage, directions, state.curvature), -directions.below, directions.above)
        return steps, (state.number_in_stage >= 0) & self._is_near(stage, state.curvature, steps)

    def _open(self, stage: Stage, state: State, directions: Directions, predicted: PerDirection) -> Brackets:
        """3. Open a bracket around the predicted step in each direction."""
        longest = jnp.abs(predicted).max()
        opening = _OPENING * jnp.sqrt(jnp.einsum("wud,wuv,wvd->wd", directions.factor, state.spread, directions.factor))
        later = jnp.maximum(state.relative_width * longest, stage.smallest_step) * state.growth
        half_width = jnp.where(state.number_in_stage == 0, _FIRST * opening, later)
        number, restricted = state.number_in_stage, jnp.where(state.trust < 1, state.trust * longest, jnp.inf)
        # The first shot is at the start.
        furthest = jnp.where(number < 0, 0.0, jnp.where(number == 0, opening, restricted))
        below, above = jnp.minimum(directions.below, furthest), jnp.minimum(directions.above, furthest)
        return Brackets.around(predicted, half_width, below, above)

    def _bisect(self, stage: Stage, state: State, directions: Directions, near: Flag, brackets: Brackets) -> Bisected:
        """4. Shoot at the trials of all brackets at once, and drop the side that the sign of each slope excludes.

        The last shot is at what the others found. There is none if the minimum is near, or after the last sweep.
        """
        over = near | (state.number_in_stage >= self.max_sweeps)
        shots = jnp.where(state.number_in_stage < 0, 1, jnp.where(over, 0, self.halvings + 1))

        def shoot(carry):
            brackets, _, _, taken, _ = carry
            step = jnp.einsum("wud,wd->wu", directions.basis, brackets.trial)
            unknowns = jnp.clip(state.unknowns + step, *stage.limits)
            curvature = stage.evaluate(unknowns)
            slope = self._slopes(stage, directions, curvature)
            close = curvature.shot.feasible.all() & self._is_near(stage, curvature, slope)
            # A slope that is not finite becomes the trial: with unit information this puts the minimum at step 0.
            brackets = brackets.narrowed(jnp.where(jnp.isfinite(slope), slope, brackets.trial))
            return brackets, unknowns, curvature, taken + 1, close

        first = brackets, state.unknowns, state.curvature, jnp.zeros((), dtype=int), jnp.zeros((), dtype=bool)
        return jax.lax.while_loop(lambda carry: (carry[3] < shots) & ~carry[4], shoot, first)[:4]

    def _judge(
        self,
        stage: Stage,
        state: State,
        directions: Directions,
        predicted: PerDirection,
        near: Flag,
        found: Bisected,
    ) -> State:
        """5. Keep the new point, or go back and stay closer if the sweep made things worse."""
        brackets, unknowns, curvature, shots = found
        shot, before = curvature.shot, state.curvature.shot
        first = state.number_in_stage < 0
        swept = ~first & (shots > 0)
        gain = before.cost.sum() - shot.cost.sum()
        stalled = swept & (gain <= _GAIN) & self._may_stall(stage, state, predicted, curvature)
        numbers = (unknowns, shot.cost, curvature.gradient, curvature.information)
        finite = jnp.stack([jnp.isfinite(each).all() for each in numbers]).all()
        # The cost of a trajectory that is not feasible means nothing.
        not_worse = shot.feasible.all() & (shot.cost.sum() <= before.cost.sum() + _CHANCE)
        bad = ~finite | (before.feasible.all() & ~not_worse)
        rejected = (~first & bad) | (stalled & (gain < 0))
        new, old = (unknowns, curvature), (state.unknowns, state.curvature)
        unknowns, curvature = jax.tree.map(lambda new, old: jnp.where(rejected, old, new), new, old)
        covariance = jnp.square(jnp.maximum(stage.misfit(before.cost.sum()), 1.0)) * gram(directions.basis)
        relative_width, growth = _next_widths(stage, state, brackets)
        return State(
            unknowns=unknowns,
            curvature=curvature,
            spread=jnp.where(stage.searched & stage.searched[:, None] & ~first, covariance, state.spread),
            relative_width=relative_width,
            growth=growth,
            trust=jnp.where(rejected, state.trust * _RETREAT, jnp.minimum(state.trust * _ADVANCE, 1.0)),
            number_in_stage=state.number_in_stage + 1,
            sweeps=state.sweeps + swept,
            rollouts=state.rollouts + shots * stage.searched.sum(),
            done=near | stalled | (first & ~finite),
            record=_recorded(stage, state, directions, brackets, swept) if self.record else state.record,
        )

    def _slopes(self, stage: Stage, directions: Directions, curvature: Curvature) -> PerDirection:
        """The slope of the cost along each direction, of the unknowns that move."""
        gradient = jnp.where(directions.moves, curvature.gradient, 0.0)
        return slopes_along(directions.basis, gradient, stage.problem.unknowns.count)

    def _is_near(self, stage: Stage, curvature: Curvature, steps: PerDirection) -> Flag:
        """Whether steps, or slopes, which are as long, are short enough to end the stage: the last one ends finely."""
        misfit = stage.misfit(curvature.shot.cost.sum())
        fine = jnp.maximum(self.tolerance * misfit, stage.smallest_step)
        return jnp.abs(steps).max() <= jnp.where(stage.last, fine, _COARSE * jnp.maximum(misfit, 1.0))

    def _may_stall(self, stage: Stage, state: State, predicted: PerDirection, curvature: Curvature) -> Flag:
        """Whether a short sweep may end the stage: only if an unknown has a stride, as its slopes are inexact."""
        feasible = curvature.shot.feasible.all() & state.curvature.shot.feasible.all()
        short = jnp.isfinite(stage.problem.unknowns.stride).any() & (jnp.abs(predicted).max() <= _SHORT)
        return feasible & short


def _next_widths(stage: Stage, state: State, brackets: Brackets) -> tuple[Scalar, PerDirection]:
    """`State.relative_width` and `State.growth` of the next sweep, from the errors of this sweep's predictions."""
    steps = brackets.last
    error = jnp.abs(steps - brackets.predicted).max()
    longest = jnp.maximum(jnp.abs(steps).max(), stage.smallest_step)
    at_end, was_open = (steps == brackets.lowest) | (steps == brackets.highest), brackets.highest > brackets.lowest
    growth = jnp.where(at_end, jnp.minimum(_GROWTH * state.growth, _WIDEST), 1.0)
    return jnp.clip(_SAFETY * error / longest, _NARROWEST, 1.0), jnp.where(was_open, growth, state.growth)


def _recorded(stage: Stage, state: State, directions: Directions, brackets: Brackets, swept: Flag) -> Array:
    """The record with one more row: the lowest and the highest value of each parameter in the opened brackets."""
    length, _, count = state.record.shape
    basis = jnp.where(stage.searched[:count, None], directions.basis[0, :count], 0.0)
    spans = basis * jnp.stack([brackets.lowest, brackets.highest])[:, 0, None]
    bracket = state.unknowns[0, :count] + jnp.stack([spans.min(axis=0), spans.max(axis=0)]).sum(axis=-1)
    return state.record.at[jnp.where(swept, state.sweeps, length)].set(bracket, mode="drop")
