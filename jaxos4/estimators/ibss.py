"""Iterative Bi-Section Shooting (IBSS): halve brackets on the slope of the trajectory mismatch.

The paper names the method but does not give its steps; the steps here are our choice (docs/method/ibss.md). They are
the five brackets of `IBSS.sweep`.
"""

import functools
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Count, InitialStates, Parameters, Scalar, integer, setting
from .._xla import quick_jit
from ..bracket import NO_PRIOR, Bracket
from ..estimate import REACH, AbstractEstimator, Estimate, estimate_at, from_starts
from ..linalg import coordinate_directions, gram, joint_factor, movable, room_to_limits, slopes_along
from ..shooting import AbstractProblem, Curvature, Stages, in_blocks
from ..shooting.abstract import WindowUnknowns
from .bisection import Brackets, Directions, Flag, PerDirection, Stage, prior_std

FACTORS = {"whitened": joint_factor, "coordinate": coordinate_directions}

_COARSE = 0.5  # a stage that is not the last ends once no direction has more than this many standard deviations to go
# The first brackets reach this many of the start's standard deviations, in brackets of this share of them.
_OPENING, _FIRST = 4.0, 0.05
# A later bracket is the last relative error of the predictions, at least the second number, times the first.
_SAFETY, _LEAST = 2.0, 0.01
_GROWTH, _WIDEST = 4.0, 256.0  # of a bracket whose search ended at one of its ends, and of all together
_CHANCE = 1.0  # a sweep that raises the cost by no more may have done so by chance
# A vehicle's cost has kinks, at which no slope is small. A sweep of at most so many standard deviations that lowers the
# cost by no more than the second number has found the minimum.
_SHORT, _GAIN = 0.3, 1e-4
# After a sweep that raised the cost, the next may go this share as far, and after any other this many times as far.
_RETREAT, _ADVANCE = 0.25, 1.4


class State(NamedTuple):
    """The search after a sweep.

    - `unknowns`, `curvature`: where it is, and the curvature of the cost there.
    - `spread`: the covariance of the unknowns, which sizes the first brackets of a stage.
    - `error`: how far the last predictions were off, as a share of the longest step. `growth`: by how much each
      direction's bracket is wider than this error asks for.
    - `trust`: the share of the longest predicted step that a sweep may go.
    - `sweep`: the number of the next sweep in its stage; -1 for the first shot, which is at the start.
    - `sweeps`, `rollouts`: how many sweeps bisected, and how many flights were simulated, in all stages.
    - `done`: whether the stage ended by itself. `record`: the bracket of each parameter in each sweep.
    """

    unknowns: WindowUnknowns
    curvature: Curvature
    spread: Float[Array, "windows unknowns unknowns"]
    error: Scalar
    growth: PerDirection
    trust: Scalar
    sweep: Count
    sweeps: Count
    rollouts: Count
    done: Flag
    record: Float[Array, "record 2 parameters"]


# The narrowed brackets, the unknowns of the last shot and its curvature, and how many shots were made.
Bisected = tuple[Brackets, WindowUnknowns, Curvature, Count]


class IBSS(AbstractEstimator):
    """Iterative Bi-Section Shooting.

    A *shot* simulates the flight at trial unknowns, with its derivatives. **The sign of the cost's slope along a
    direction decides** which side of the trial holds the minimum, and so which part of the bracket is dropped. The
    quadratic model of the cost and the secant through the last slopes only **propose** where to shoot. A *sweep* is one
    iteration. A *stage* repeats sweeps on some of the data until the minimum is near; the last stage fits all of them.
    Parameters are bisected on the sum of all windows' slopes, initial states on those of their own window.

    **Arguments:**

    - `directions`: `"whitened"`: the columns of L^-T, with L L^T the Fisher information at the current estimate; the
      cost is nearly separable along them, so a sweep bisects all together. The rates are fitted first, then all
      channels. `"coordinate"`: the unknowns, one in each sweep, on all channels at once: good on the rates only.
    - `halvings`: the shots of a sweep that narrow the brackets.
    - `max_sweeps`: the most sweeps of each stage; along coordinates, for each of them.
    - `tolerance`: the search ends once the minimum is at most this many standard deviations away along each
      direction. They follow from the actual residuals, so the fit of noise-free data ends at rounding errors.
    - `reach`: the search does not go further than this many half-widths from the bracket's center.
    - `record`: how many sweeps' brackets the estimate keeps, to show how the search went.
    """

    looks_at: ClassVar[str] = "all"
    shoots: ClassVar[bool] = True
    prior: ClassVar[float] = NO_PRIOR
    in_closed_loop: ClassVar[bool] = True

    directions: str = eqx.field(static=True, default="whitened")
    halvings: int = eqx.field(static=True, converter=integer("halvings", 2, static=True), default=2)
    max_sweeps: Count = eqx.field(converter=integer("max_sweeps", 1), default=60)
    tolerance: Scalar = eqx.field(converter=setting("tolerance", positive=True), default=0.005)
    reach: Scalar = eqx.field(converter=setting("reach", positive=True), default=REACH)
    record: int = eqx.field(static=True, converter=integer("record", 0, static=True), default=0)

    def __check_init__(self):
        if self.directions not in FACTORS:
            raise ValueError(f"`directions` must be one of {', '.join(FACTORS)}, got {self.directions!r}.")

    @quick_jit
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
        spread: Float[Array, "known known"] | None = None,
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
        - `skip`: whether to return the start without a search. Other lanes of the batch do not wait for this one.
        """
        known = problem.first_state()[0] if initial_state is None else initial_state
        stages = problem.stages(cascade=self.directions == "whitened")

        def from_one(start: Parameters) -> Estimate:
            first = self.init(problem, stages, problem.join(start, known), spread, skip)

            def fit(number: Count, state: State) -> State:
                """One stage: sweeps from where the last stage ended."""
                stage = Stage.of(problem, stages, number, self.reach)
                anew = {name: getattr(first, name) for name in ("error", "growth", "trust", "sweep", "done")}
                ongoing, sweep = lambda state: ~self.terminate(stage, state), functools.partial(self.sweep, stage)
                return jax.lax.while_loop(ongoing, sweep, state._replace(**anew))

            # One loop, so that the search is compiled once for all stages.
            end = jax.lax.fori_loop(jnp.where(cascade, 0, stages.number - 1), stages.number, fit, first)
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
            known = np.s_[:, : spread.shape[0], : spread.shape[0]]
            # A search that is skipped may have no finite spread.
            covariance = covariance.at[known].set(jnp.where(skip, covariance[known], spread))
        none = jnp.zeros((), dtype=int)
        shapes = jax.eval_shape(stages.evaluate, none, unknowns)
        return State(
            unknowns=unknowns,
            curvature=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes),
            spread=covariance,
            error=jnp.zeros((), dtype=float),
            growth=jnp.ones_like(unknowns),
            trust=jnp.ones((), dtype=float),
            sweep=none - 1,
            sweeps=none,
            rollouts=none,
            done=jnp.asarray(skip),
            record=jnp.full((self.record, 2, problem.unknowns.count), jnp.nan),
        )

    def sweep(self, stage: Stage, state: State) -> State:
        """One iteration, in the five steps of docs/method/ibss.md."""
        directions = self._look_around(stage, state)
        predicted, near = self._predict(stage, state, directions)
        brackets = self._open(stage, state, directions, predicted)
        found = self._bisect(stage, state, directions, near, brackets)
        return self._judge(stage, state, directions, near, found)

    def terminate(self, stage: Stage, state: State) -> Flag:
        """Whether the stage has ended. After its last sweep it looks once more whether the minimum is near."""
        return state.done | (state.sweep > self._most_sweeps(stage))

    def _look_around(self, stage: Stage, state: State) -> Directions:
        """1. Choose directions in which the cost is nearly separable, from its curvature where the sweep begins."""
        unknowns, curvature, count = state.unknowns, state.curvature, stage.problem.unknowns.count
        moves = movable(unknowns, curvature.gradient, stage.limits, count)
        information = jnp.where(moves[:, :, None] & moves[:, None, :], curvature.information, 0.0)
        factor, basis = FACTORS[self.directions](information + stage.prior, count)
        lower, upper = (jnp.where(moves, limit, unknowns) for limit in stage.limits)
        return Directions(factor, basis, moves, *room_to_limits(unknowns, basis, (lower, upper)))

    def _predict(self, stage: Stage, state: State, directions: Directions) -> tuple[PerDirection, Flag]:
        """2. The step to the minimum of the quadratic model, and whether all steps are so short that the stage ends.

        The information along each direction is 1, so the step is minus the slope.
        """
        steps = jnp.clip(-self._slopes(stage, directions, state.curvature), -directions.below, directions.above)
        return steps, (state.sweep >= 0) & self._is_near(stage, state.curvature, steps)

    def _open(self, stage: Stage, state: State, directions: Directions, predicted: PerDirection) -> Brackets:
        """3. Open a bracket around the predicted step in each direction."""
        opening = _OPENING * jnp.sqrt(jnp.einsum("wud,wuv,wvd->wd", directions.factor, state.spread, directions.factor))
        longest, is_first = jnp.abs(predicted).max(), state.sweep == 0
        later = jnp.maximum(state.error * longest, stage.smallest_step) * state.growth
        half_width = jnp.where(is_first, _FIRST * opening, later)
        # How far this sweep may go. Before the first shot, which is at the start: nowhere.
        furthest = jnp.where(is_first, opening, jnp.inf)
        furthest = jnp.where(state.trust < 1, state.trust * longest, furthest)
        furthest = jnp.where(state.sweep < 0, 0.0, furthest)
        if self.directions == "coordinate":  # each searched unknown has its turn
            rank, searched = jnp.cumsum(stage.searched) - 1, stage.searched
            turn = searched & (rank == state.sweep % jnp.maximum(searched.sum(), 1))
            furthest = jnp.where(jnp.roll(turn, -stage.problem.unknowns.count), furthest, 0.0)
        return Brackets.around(
            predicted, half_width, jnp.minimum(directions.below, furthest), jnp.minimum(directions.above, furthest)
        )

    def _bisect(self, stage: Stage, state: State, directions: Directions, near: Flag, brackets: Brackets) -> Bisected:
        """4. Shoot at the trials of all brackets at once, and drop the side that the sign of each slope excludes.

        The last shot is at what the others found. There is none if the minimum is near, or after the last sweep.
        """
        over = near | (state.sweep >= self._most_sweeps(stage))
        shots = jnp.where(state.sweep < 0, 1, jnp.where(over, 0, self.halvings + 1))

        def shoot(carry):
            brackets, _, _, taken, _ = carry
            unknowns = jnp.clip(
                state.unknowns + jnp.einsum("wud,wd->wu", directions.basis, brackets.trial), *stage.limits
            )
            curvature = stage.evaluate(unknowns)
            slope = self._slopes(stage, directions, curvature)
            close = curvature.shot.sound.all() & self._is_near(stage, curvature, slope)
            # A failed shot points back to the beginning.
            brackets = brackets.halved(jnp.where(jnp.isfinite(slope), slope, brackets.trial))
            return brackets, unknowns, curvature, taken + 1, close

        first = brackets, state.unknowns, state.curvature, jnp.zeros((), dtype=int), jnp.zeros((), dtype=bool)
        return jax.lax.while_loop(lambda carry: (carry[3] < shots) & ~carry[4], shoot, first)[:4]

    def _judge(self, stage: Stage, state: State, directions: Directions, near: Flag, found: Bisected) -> State:
        """5. Keep the new point, or go back and stay closer if the sweep made things worse."""
        (brackets, unknowns, curvature, shots), first = found, state.sweep < 0
        shot, before = curvature.shot, state.curvature.shot
        finite = jnp.isfinite(unknowns).all() & jnp.isfinite(shot.cost).all()
        # The cost of a flight that fails means nothing.
        lower = shot.sound.all() & (shot.cost.sum() <= before.cost.sum() + _CHANCE)
        gain, has_kinks = before.cost.sum() - shot.cost.sum(), jnp.isfinite(stage.problem.unknowns.stride).any()
        short = shot.sound.all() & before.sound.all() & (jnp.abs(brackets.predicted).max() <= _SHORT)
        stalled = has_kinks & ~first & (shots > 0) & short & (gain <= _GAIN)
        failed = ~first & ~(finite & (~before.sound.all() | lower)) | (stalled & (gain < 0))
        unknowns, curvature = jax.tree.map(
            lambda new, old: jnp.where(failed, old, new), (unknowns, curvature), (state.unknowns, state.curvature)
        )
        steps, bisected = brackets.last, brackets.highest > brackets.lowest
        off = _SAFETY * jnp.abs(steps - brackets.predicted).max()
        at_end = (steps == brackets.lowest) | (steps == brackets.highest)
        growth = jnp.where(at_end, jnp.minimum(_GROWTH * state.growth, _WIDEST), 1.0)
        covariance = jnp.square(jnp.maximum(stage.misfit(before.cost.sum()), 1.0)) * gram(directions.basis)
        searched, counts = stage.searched & stage.searched[:, None] & ~first, ~first & (shots > 0)
        return State(
            unknowns=unknowns,
            curvature=curvature,
            spread=jnp.where(searched, covariance, state.spread),
            error=jnp.clip(off / jnp.maximum(jnp.abs(steps).max(), stage.smallest_step), _LEAST, 1.0),
            growth=jnp.where(bisected, growth, state.growth),
            trust=jnp.where(failed, state.trust * _RETREAT, jnp.minimum(state.trust * _ADVANCE, 1.0)),
            sweep=state.sweep + 1,
            sweeps=state.sweeps + counts,
            rollouts=state.rollouts + shots * stage.searched.sum(),
            done=near | stalled | (first & ~finite),
            record=_recorded(state, directions, brackets, counts) if self.record else state.record,
        )

    def _slopes(self, stage: Stage, directions: Directions, curvature: Curvature) -> PerDirection:
        """The slope of the cost along each direction, of the unknowns that move."""
        gradient = jnp.where(directions.moves, curvature.gradient, 0.0)
        return slopes_along(directions.basis, gradient, stage.problem.unknowns.count)

    def _is_near(self, stage: Stage, curvature: Curvature, steps: PerDirection) -> Flag:
        """Whether so short steps to the minimum end a stage: the last stage is searched finely, the others coarsely."""
        noise = stage.misfit(curvature.shot.cost.sum())
        fine = jnp.maximum(self.tolerance * noise, stage.smallest_step)
        return jnp.abs(steps).max() <= jnp.where(stage.last, fine, _COARSE * jnp.maximum(noise, 1.0))

    def _most_sweeps(self, stage: Stage) -> Count:
        return self.max_sweeps * (1 if self.directions == "whitened" else stage.searched.sum())


def _recorded(
    state: State, directions: Directions, brackets: Brackets, counts: Flag
) -> Float[Array, "record 2 parameters"]:
    """The record with the bracket of each parameter in one more sweep; sweeps beyond its length are dropped."""
    length, _, count = state.record.shape
    widest = jnp.abs(directions.basis * ((brackets.highest - brackets.lowest) / 2)[:, None, :]).max(axis=(0, 2))[:count]
    bracket = state.unknowns[0, :count] + jnp.stack([-widest, widest])
    return state.record.at[jnp.where(counts, state.sweeps, length)].set(bracket, mode="drop")
