"""Iterative Bi-Section Shooting (IBSS): halve brackets on the slope of the trajectory mismatch.

The paper names the method but does not give its steps; the steps here are our choice (docs/method/ibss.md).

A *shot* simulates the flight at trial unknowns, with its derivatives. **The sign of the cost's slope along a direction
decides** which side of the trial holds the minimum, and so which part of the bracket is dropped. The quadratic model of
the cost and the secant through the last slopes only **propose** where to shoot. A *sweep* is one iteration: look
around, predict, open, bisect, judge. A *stage* repeats sweeps on some of the data until the minimum is near; the last
stage fits all of them.

If the flight is cut into windows, each window has its own initial state. Parameters are bisected on the sum of the
windows' slopes, initial states on their own window's.
"""

import functools
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Count, InitialStates, Parameters, Scalar, as_float, as_int
from .._xla import quick_jit
from ..bracket import NO_PRIOR, Bracket
from ..estimate import (
    REACH,
    AbstractEstimator,
    Estimate,
    as_estimate,
    check_count,
    check_dynamic_count,
    check_positive,
    from_starts,
)
from ..linalg import covariance_of_shared, gram, joint_factor
from ..shooting import AbstractProblem, Curvature, Stages, in_blocks
from ..shooting.abstract import WindowUnknowns
from .bisection import (
    Around,
    Lines,
    PerDirection,
    Stage,
    State,
    bisected_in,
    coordinate_directions,
    narrow,
    no_worse,
    open_lines,
    prior_std,
    record_bracket,
    room_to_limits,
)

DIRECTIONS = ("whitened", "coordinate")

# A stage that is not the last ends once no direction has more than this many standard deviations to go.
_COARSE = 0.5
# The first brackets reach this many of the start's standard deviations, in brackets of this share of them.
_OPENING, _FIRST = 4.0, 0.05
# A later bracket is the last relative error of the predictions, at least the second number, times the first.
_SAFETY, _LEAST = 2.0, 0.01
_GROWTH, _WIDEST = 4.0, 256.0  # of a bracket whose search ended at one of its ends, and of all together
# After a sweep that raised the cost, the next goes at most this share of the predicted steps.
_RETREAT = 0.25
# After a sweep that did not, the next may go this many times as far. If the share were back at 1 at once, every second
# sweep of a strongly nonlinear search would fail.
_ADVANCE = 1.4


class IBSS(AbstractEstimator):
    """Iterative Bi-Section Shooting.

    **Arguments:**

    - `directions`: `"whitened"`: the columns of L^-T, with L L^T the Fisher information at the current estimate; the
      cost is nearly separable along them, so a sweep bisects all together. The rates are fitted first, then all
      channels. `"coordinate"`: the unknowns themselves, one in each sweep, against all of the problem's channels, in
      the manner of the paper; good on the rates, slow on more channels.
    - `halvings`: the shots of a sweep that narrow the brackets.
    - `max_sweeps`: the most sweeps of each stage; along coordinates, for each of them.
    - `tolerance`: the search ends once the minimum is at most this many standard deviations away along each
      direction. The standard deviation follows from the actual residuals, so the fit of noise-free data ends at
      rounding errors.
    - `reach`: the search does not go further than this many half-widths from the bracket's center.
    - `record`: how many sweeps' brackets the estimate keeps, to show how the search went.

    A free initial state is searched like the parameters, from the first measurement of each channel.
    """

    looks_at: ClassVar[str] = "all"
    shoots: ClassVar[bool] = True
    prior: ClassVar[float] = NO_PRIOR
    needs_network: ClassVar[bool] = False
    in_closed_loop: ClassVar[bool] = True

    directions: str = eqx.field(static=True, default="whitened")
    halvings: int = eqx.field(static=True, default=2)
    max_sweeps: Count = eqx.field(converter=as_int, default=60)
    tolerance: Scalar = eqx.field(converter=as_float, default=0.005)
    reach: Scalar = eqx.field(converter=as_float, default=REACH)
    record: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        if self.directions not in DIRECTIONS:
            raise ValueError(f"`directions` must be one of {', '.join(DIRECTIONS)}, got {self.directions!r}.")
        check_count("halvings", self.halvings, 2)
        check_count("record", self.record, 0)
        check_dynamic_count("max_sweeps", self.max_sweeps, 1)
        check_positive("tolerance", self.tolerance)
        check_positive("reach", self.reach)

    @quick_jit
    def __call__(
        self,
        problem: AbstractProblem,
        bracket: Bracket | None = None,
        *,
        start: Float[Array, " unknowns"] | None = None,
        spread: Float[Array, "known known"] | None = None,
    ) -> Estimate:
        """Identifies one flight.

        **Arguments:**

        - `problem`: any likelihood: a `ShootingProblem`, or an `InnovationsProblem` for a vehicle in closed loop.
        - `bracket`: where to look for the parameters, which may turn out to lie outside; by default the problem's own.
        - `start`: where the search begins, unless it is NaN; by default the problem's `starts`.
        - `spread`: the covariance of the parameters of `start`, which sizes the first brackets; by default that of the
          bracket, with its half-width as two standard deviations.

        **Raises:** `ValueError` for a bracket or a start of another length than the unknowns.
        """

        def one(ibss: IBSS, problem: AbstractProblem, start, spread) -> Estimate:
            return ibss.search(problem, start=start, spread=spread)

        return in_blocks(one, self, problem.within(bracket), start, spread)

    def search(
        self,
        problem: AbstractProblem,
        *,
        start: Float[Array, " unknowns"] | None = None,
        spread: Float[Array, "known known"] | None = None,
        initial_state: InitialStates | None = None,
        cascade: Bool[Array, ""] | bool = True,
        skip: Bool[Array, ""] | bool = False,
    ) -> Estimate:
        """Identifies one flight, inside the program of another estimator.

        **Arguments:** as of a call, and

        - `initial_state`: where the search for a free initial state begins; by default the first measurements.
        - `cascade`: whether to go through all stages. A `start` that is close needs the last one only.
        - `skip`: whether to return the start without a search. Other lanes of the batch do not wait for this one.
        """
        count = problem.unknowns.count
        if start is not None and jnp.shape(start) != (count,):
            raise ValueError(f"`start` must hold {count} unknowns, got shape {jnp.shape(start)}.")
        known = problem.first_state()[0] if initial_state is None else initial_state
        stages = problem.stages(cascade=self.directions == "whitened")
        first = jnp.where(cascade, 0, stages.number - 1)

        def from_one(start: Parameters) -> Estimate:
            state = self.init(problem, stages, start, known, spread, skip)

            def fit(number: Int[Array, ""], state: State) -> State:
                return self._fit_stage(Stage.of(problem, stages, number, self.reach), state, skip)

            # One loop, so that the search is compiled once for all stages.
            return self._estimate(problem, known, jax.lax.fori_loop(first, stages.number, fit, state))

        return from_starts(problem, start, from_one)

    def init(
        self,
        problem: AbstractProblem,
        stages: Stages,
        start: Float[Array, " unknowns"],
        initial_state: InitialStates,
        spread: Float[Array, "known known"] | None,
        skip: Bool[Array, ""] | bool,
    ) -> State:
        """The search before its first shot."""
        unknowns = jnp.clip(problem.join(start, initial_state), *problem.limits(self.reach))
        covariance = jax.vmap(jnp.diag)(jnp.square(prior_std(problem)))
        if spread is not None:
            known = spread.shape[0]
            own = jnp.where(skip, covariance[:, :known, :known], spread)
            covariance = covariance.at[:, :known, :known].set(own)
        count, none = problem.unknowns.count, jnp.zeros((), dtype=int)
        shapes = jax.eval_shape(stages.evaluate, none, unknowns)
        return State(
            unknowns=unknowns,
            curvature=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes),
            spread=covariance,
            error=jnp.zeros((), dtype=float),
            growth=jnp.ones_like(unknowns),
            trust=jnp.ones((), dtype=float),
            sweeps=none,
            earlier=none,
            rollouts=none,
            done=jnp.asarray(skip),
            record=jnp.full((self.record, 2, count), jnp.nan) if self.record else None,
        )

    def sweep(self, stage: Stage, state: State) -> State:
        """One iteration."""
        around = self._look_around(stage, state)
        predicted = -stage.along(around.basis, state.curvature.gradient, around.moves)
        lines = self._open(stage, state, around, predicted)
        lines, unknowns, curvature, shots = self._bisect(stage, state, around, lines)
        return self._judge(stage, state, around, lines, unknowns, curvature, shots)

    def terminate(self, stage: Stage, state: State) -> Bool[Array, ""]:
        """Whether the stage has ended."""
        return state.done | (state.sweeps > self._most_sweeps(stage))

    def _look_around(self, stage: Stage, state: State) -> Around:
        """Choose directions in which the cost is nearly separable, from its curvature where the sweep begins."""
        choose = joint_factor if self.directions == "whitened" else coordinate_directions
        problem, unknowns, (lower, upper) = stage.problem, state.unknowns, stage.limits
        count, gradient = problem.unknowns.count, state.curvature.gradient
        total = gradient.at[:, :count].set(gradient[:, :count].sum(axis=0))
        moves = ~(((unknowns <= lower) & (total > 0)) | ((unknowns >= upper) & (total < 0)))
        information = jnp.where(moves[:, :, None] & moves[:, None, :], state.curvature.information, 0.0)
        factor, basis = choose(information + stage.prior, count)
        nearest = (jnp.where(moves, limit, unknowns) for limit in stage.limits)
        below, above = room_to_limits(unknowns, basis, *nearest)
        steps = jnp.clip(-stage.along(basis, gradient, moves), -below, above)
        longest = jnp.abs(steps).max()
        near = (state.sweeps >= 0) & (stage.distance(steps) <= self._close_enough(stage, state.curvature))
        spent = state.sweeps >= self._most_sweeps(stage)
        return Around(factor, basis, moves, below, above, longest, near, spent)

    def _open(self, stage: Stage, state: State, around: Around, predicted: PerDirection) -> Lines:
        """Open a bracket around the predicted step in each direction."""
        opening = _OPENING * jnp.sqrt(jnp.einsum("wud,wuv,wvd->wd", around.factor, state.spread, around.factor))
        later = jnp.maximum(state.error * around.longest, stage.smallest_step) * state.growth
        is_first = state.sweeps == 0
        half_width = jnp.where(is_first, _FIRST * opening, later)
        longest = jnp.where(is_first, opening, jnp.inf)
        longest = jnp.where(state.trust < 1, state.trust * around.longest, longest)
        # Nothing is known before the first shot, which is at the start.
        longest = jnp.where(state.sweeps < 0, 0.0, longest)
        if self.directions == "coordinate":
            is_next = bisected_in(state.sweeps, stage.searched, stage.problem.unknowns.count)
            longest = jnp.where(is_next, longest, 0.0)
        below, above = jnp.minimum(around.below, longest), jnp.minimum(around.above, longest)
        return open_lines(predicted, half_width, below, above)

    def _bisect(
        self, stage: Stage, state: State, around: Around, lines: Lines
    ) -> tuple[Lines, WindowUnknowns, Curvature, Int[Array, ""]]:
        """Shoot at the trials of all brackets at once, and drop the side that the sign of each slope excludes.

        The last shot does not narrow brackets: it is at what the others found. No shot is left if the minimum is near,
        or after the last sweep.
        """
        shots = jnp.where(state.sweeps < 0, 1, jnp.where(around.near | around.spent, 0, self.halvings + 1))

        def shoot(carry):
            lines, _, _, taken, _ = carry
            unknowns = jnp.clip(state.unknowns + jnp.einsum("wud,wd->wu", around.basis, lines.trial), *stage.limits)
            curvature = stage.stages.evaluate(stage.number, unknowns)
            slope = stage.along(around.basis, curvature.gradient, around.moves)
            close = stage.distance(slope) <= self._close_enough(stage, curvature)
            # A failed shot points back to the beginning.
            lines = narrow(lines, jnp.where(jnp.isfinite(slope), slope, lines.trial))
            return lines, unknowns, curvature, taken + 1, curvature.shot.sound.all() & close

        first = lines, state.unknowns, state.curvature, jnp.zeros((), dtype=int), jnp.zeros((), dtype=bool)
        lines, unknowns, curvature, taken, _ = jax.lax.while_loop(lambda x: (x[3] < shots) & ~x[4], shoot, first)
        return lines, unknowns, curvature, taken

    def _judge(
        self,
        stage: Stage,
        state: State,
        around: Around,
        lines: Lines,
        unknowns: WindowUnknowns,
        curvature: Curvature,
        shots: Int[Array, ""],
    ) -> State:
        """Keep the new point, or go back and stay closer if the sweep made things worse."""
        first = state.sweeps < 0
        finite = jnp.isfinite(unknowns).all() & jnp.isfinite(curvature.shot.cost).all()
        failed = ~first & ~(finite & no_worse(curvature.shot, state.curvature.shot))
        kept, there = jax.tree.map(
            lambda new, old: jnp.where(failed, old, new), (unknowns, curvature), (state.unknowns, state.curvature)
        )
        steps, bisected = lines.last, lines.upper > lines.lower
        share = _SAFETY * jnp.abs(steps - lines.predicted).max()
        error = jnp.clip(share / jnp.maximum(jnp.abs(steps).max(), stage.smallest_step), _LEAST, 1.0)
        at_end = (steps == lines.lower) | (steps == lines.upper)
        growth = jnp.where(bisected, jnp.where(at_end, jnp.minimum(_GROWTH * state.growth, _WIDEST), 1.0), state.growth)
        trust = jnp.where(failed, state.trust * _RETREAT, jnp.minimum(state.trust * _ADVANCE, 1.0))
        known = jnp.square(jnp.maximum(stage.misfit(state.curvature), 1.0)) * gram(around.basis)
        searched = stage.searched & stage.searched[:, None] & ~first
        return State(
            unknowns=kept,
            curvature=there,
            spread=jnp.where(searched, known, state.spread),
            error=error,
            growth=growth,
            trust=trust,
            sweeps=state.sweeps + jnp.where(around.near, 0, 1),
            earlier=state.earlier,
            rollouts=state.rollouts + shots * stage.searched.sum(),
            done=around.near | (first & ~finite),
            record=record_bracket(state, around, (lines.upper - lines.lower) / 2),
        )

    def _most_sweeps(self, stage: Stage) -> Int[Array, ""]:
        return self.max_sweeps * (1 if self.directions == "whitened" else stage.searched.sum())

    def _close_enough(self, stage: Stage, curvature: Curvature) -> Scalar:
        """The search of a stage ends if the minimum is at most so far away along each direction."""
        noise, last = stage.misfit(curvature), stage.number == stage.stages.number - 1
        fine = jnp.maximum(self.tolerance * noise, stage.smallest_step)
        return jnp.where(last, fine, _COARSE * jnp.maximum(noise, 1.0))

    def _fit_stage(self, stage: Stage, state: State, skip: Bool[Array, ""] | bool) -> State:
        """Sweeps until little is left to go; the last stage down to `tolerance`, the others coarsely."""
        state = state._replace(
            error=jnp.zeros((), dtype=float),
            growth=jnp.ones_like(state.growth),
            trust=jnp.ones((), dtype=float),
            sweeps=-jnp.ones((), dtype=int),
            earlier=state.earlier + jnp.maximum(state.sweeps, 0),
            done=jnp.asarray(skip),
        )
        state = jax.lax.while_loop(
            lambda state: ~self.terminate(stage, state), functools.partial(self.sweep, stage), state
        )
        return state._replace(sweeps=jnp.minimum(state.sweeps, self._most_sweeps(stage)))

    def _estimate(self, problem: AbstractProblem, initial_state: InitialStates, state: State) -> Estimate:
        count, curvature = problem.unknowns.count, state.curvature
        return as_estimate(
            problem,
            parameters=state.unknowns[0, :count],
            covariance=covariance_of_shared(curvature.information, count),
            initial_state=state.unknowns[:, count:].ravel() if problem.free_size else initial_state,
            cost=curvature.shot.cost.sum(),
            rollouts=state.rollouts,
            sweeps=state.earlier + jnp.maximum(state.sweeps, 0),
            sound=curvature.shot.sound.all(),
            done=state.done,
            reach=self.reach,
            brackets=state.record,
            parts=curvature.parts,
        )
