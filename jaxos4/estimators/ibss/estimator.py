"""Iterative Bi-Section Shooting: the settings, the stages, and one sweep.

A *shot* simulates the flight at trial unknowns, with its derivatives. The sign of the cost's slope along a direction
says which side of the trial holds the minimum. A *sweep* looks around, opens a bracket along each direction around the
step that the cost's quadratic model predicts, and narrows the brackets. A *stage* repeats sweeps on some channels until
the minimum is near.

A sweep has turns: in each turn some directions are bisected together. Whitened directions hardly change each other's
minimum and take one turn; coordinates take a turn each.

If the flight is cut into windows, each window has its own initial state. Parameters are bisected on the sum of the
windows' slopes, initial states on their own window's.
"""

import functools
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..._custom_types import Count, InitialStates, Parameters, Scalar, as_float, as_int
from ...bracket import NO_PRIOR, Bracket
from ...estimate import (
    REACH,
    AbstractEstimator,
    Estimate,
    check_bracket,
    check_count,
    check_dynamic_count,
    check_positive,
    conclude,
)
from ...linalg import covariance_of_shared, covariances, gram, joint_factor
from ...shooting import Curvature, ShootingProblem, Shot, in_blocks
from .bisection import Lines, narrow, open_lines
from .brackets import GROWTH, Brackets, open_brackets, relative_error, rooms
from .directions import coordinate_directions
from .progress import Progress, Search, record_brackets
from .stage import Limits, Stage, join, misfit, prior_std, stages
from .view import View

DIRECTIONS = ("whitened", "coordinate")

# The rates are first fitted to these shares of the flight. Errors grow with time, so the cost of a long flight has
# other minima: without these stages CorrectedOS4 falls into one in a fifth of all cases.
_HORIZONS = (0.1, 0.3)
# A stage that is not the last ends once no direction has more than this many standard deviations to go.
_COARSE = 0.5
# After a sweep that raised the cost by more than chance does, the next goes at most this share of the predicted steps.
_CHANCE, _RETREAT = 1.0, 0.25
# After a sweep that did not, the next may go this many times as far. If the share were back at 1 at once, every second
# sweep of a strongly nonlinear search would fail.
_ADVANCE = 1.4


class IBSS(AbstractEstimator):
    """Iterative Bi-Section Shooting.

    **Arguments:**

    - `directions`: `"whitened"`: the columns of L^-T, with L L^T the Fisher information at the current estimate; the
      cost is nearly separable along them. The rates are fitted first, then all channels.
      `"coordinate"`: the parameters themselves, against all of the problem's channels at once, in the manner of the
      paper; good on the rates, slow on more channels.
    - `halvings`: the shots of each turn of a sweep, each of which narrows the brackets.
    - `max_sweeps`: the most sweeps of each stage.
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

    @eqx.filter_jit
    def __call__(
        self,
        problem: ShootingProblem,
        bracket: Bracket,
        *,
        start: Parameters | None = None,
        spread: Float[Array, "parameters parameters"] | None = None,
        free: Bool[Array, " parameters"] | None = None,
    ) -> Estimate:
        """Identifies one flight.

        **Arguments:**

        - `bracket`: where to look for the parameters; they may turn out to lie outside.
        - `start`: where the search begins; the bracket's center by default.
        - `spread`: the covariance of `start`, which sizes the first brackets; by default that of `bracket`, with its
          half-width as two standard deviations.
        - `free`: which parameters to search; all by default. The others stay at `start`, which must lie
          within `reach`, with a variance of 0.

        **Raises:** `ValueError` for a bracket or a start of another length than the model's parameters.
        """

        def one(ibss: IBSS, problem: ShootingProblem, bracket: Bracket, start, spread, free) -> Estimate:
            return ibss.search(problem, bracket, start=start, spread=spread, free=free)

        return in_blocks(one, self, problem, bracket, start, spread, free)

    def search(
        self,
        problem: ShootingProblem,
        bracket: Bracket,
        *,
        start: Parameters | None = None,
        spread: Float[Array, "parameters parameters"] | None = None,
        free: Bool[Array, " parameters"] | None = None,
        initial_state: InitialStates | None = None,
        cascade: Bool[Array, ""] | bool = True,
        skip: Bool[Array, ""] | None = None,
    ) -> Estimate:
        """Identifies one flight, inside the program of another estimator.

        **Arguments:** as of a call, and

        - `initial_state`: where the search for a free initial state begins; by default the first measurements.
        - `cascade`: whether to fit the rates before the other channels. A `start` that is close needs no cascade.
        - `skip`: whether to return the start without a search. Other lanes of the batch do not wait for this one.
        """
        check_bracket(problem, bracket)
        count = len(problem.model.parameter_names)
        if start is not None and jnp.shape(start) != (count,):
            raise ValueError(f"`start` must hold {count} parameters, got shape {jnp.shape(start)}.")
        usable = bracket.usable
        start = usable.center if start is None else as_float(start)
        skip = jnp.zeros((), dtype=bool) if skip is None else skip
        free = jnp.ones(count, dtype=bool) if free is None else free
        plan, limits = self._plan(problem), self._limits(problem, usable)
        stage_of = stages(problem, usable, limits, plan, free)

        def fit(number: Int[Array, ""], carry: tuple[Progress, Curvature]) -> tuple[Progress, Curvature]:
            progress, _ = carry
            stage, last = stage_of(number), number == len(plan) - 1
            return self._fit_stage(stage, progress._replace(done=skip), last=last)

        initial_state = problem.first_state()[0] if initial_state is None else initial_state
        progress = self._begin(problem, usable, limits, join(problem, start, initial_state), spread, skip=skip)
        # One loop, so that the search is compiled once for all stages.
        first = jnp.where(cascade, 0, len(plan) - 1)
        progress, curvature = jax.lax.fori_loop(first, len(plan), fit, (progress, _no_curvature(progress)))
        return self._finish(problem, bracket, free, progress, curvature)

    def _plan(self, problem: ShootingProblem) -> tuple[tuple[str, float], ...]:
        """The channels of each stage, and the share of the flight that it fits."""
        everything = ((problem.channels, 1.0),)
        if self.directions == "coordinate":
            return everything
        # A window is short enough as it is.
        shares = (*_HORIZONS, 1.0) if problem.windows == 1 else (1.0,)
        rates = tuple(("rates", share) for share in shares)
        return rates if problem.channels == "rates" else rates + everything

    def _begin(
        self,
        problem: ShootingProblem,
        bracket: Bracket,
        limits: Limits,
        unknowns: Float[Array, "windows unknowns"],
        spread: Float[Array, "parameters parameters"] | None,
        *,
        skip: Bool[Array, ""],
    ) -> Progress:
        count = bracket.lower.shape[0]
        covariance = jax.vmap(jnp.diag)(jnp.square(prior_std(problem, bracket)))
        if spread is not None:
            known = jnp.where(skip, covariance[:, :count, :count], spread)
            covariance = covariance.at[:, :count, :count].set(known)
        none = jnp.zeros((), dtype=int)
        brackets = jnp.full((self.record, 2, count), jnp.nan) if self.record else None
        return Progress(jnp.clip(unknowns, *limits), covariance, none, none, skip, brackets)

    def _limits(self, problem: ShootingProblem, bracket: Bracket) -> Limits:
        """The least and the greatest value of each unknown: a free initial state has no limits."""
        reach, far = self.reach * bracket.half_width, jnp.full(problem.free_size, jnp.inf)
        return jnp.concatenate([bracket.center - reach, -far]), jnp.concatenate([bracket.center + reach, far])

    def _fit_stage(self, stage: Stage, progress: Progress, *, last: Bool[Array, ""]) -> tuple[Progress, Curvature]:
        """Sweeps until little is left to go; the last stage down to `tolerance`, the others coarsely."""
        none, zeros = jnp.zeros((), dtype=int), jnp.zeros_like(progress.unknowns)
        search = Search(
            view=View(progress.unknowns, _no_curvature(progress), jnp.zeros_like(progress.spread)),
            brackets=Brackets(zeros, zeros),
            lines=open_lines(zeros, zeros, zeros, zeros),
            turn=self._turns(stage),  # a sweep ends here, so that the first shot looks around
            shots=none,
            steps=zeros,
            errors=zeros,
            at_end=zeros > 0,
            growth=jnp.ones_like(zeros),
            sweeps=none,
            rollouts=none,
            trust=jnp.ones((), dtype=float),
            done=progress.done,
            ended=progress.done,
            record=progress.brackets,
        )
        shoot = functools.partial(self._shoot, stage, spread=progress.spread, before=progress.sweeps, last=last)
        search = jax.lax.while_loop(lambda search: ~search.ended, shoot, search)
        curvature = search.view.curvature
        if self.directions == "coordinate":
            covariance = covariances(curvature.information + stage.prior, stage.parameter_count)
        else:
            covariance = gram(search.view.basis)
        noise = jnp.maximum(misfit(curvature.shot.cost.sum(), stage.measurements), 1.0)
        searched = stage.searched
        return Progress(
            search.view.unknowns,
            jnp.where(searched & searched[:, None], jnp.square(noise) * covariance, progress.spread),
            progress.sweeps + search.sweeps,
            progress.rollouts + search.rollouts,
            search.done,
            search.record,
        ), curvature

    def _turns(self, stage: Stage) -> Int[Array, ""]:
        """How many turns a sweep has: one for all whitened directions together, or one for each coordinate."""
        return jnp.ones((), dtype=int) if self.directions == "whitened" else stage.size

    def _shoot(
        self,
        stage: Stage,
        search: Search,
        *,
        spread: Float[Array, "windows unknowns unknowns"],
        before: Int[Array, ""],
        last: Bool[Array, ""],
    ) -> Search:
        """One shot: it narrows the brackets of this turn, or looks around. `before`: sweeps of earlier stages."""
        whitened = self.directions == "whitened"
        bisected = stage.bisected(search.turn, together=whitened)
        steps = jnp.where(bisected, search.lines.trial, search.steps)
        unknowns = jnp.clip(search.view.after(steps), *stage.limits)
        curvature = stage.curvature(unknowns)
        slope = stage.along(search.view.basis, curvature.gradient)
        search = search._replace(rollouts=search.rollouts + stage.size)
        arrived = curvature.shot.sound.all() & (jnp.abs(slope).max() <= self._close_enough(stage, curvature, last))
        return jax.lax.cond(
            arrived | (search.turn == self._turns(stage)),
            lambda: self._look_around(stage, search, unknowns, curvature, spread, before, last),
            lambda: self._narrow(stage, search, bisected, slope),
        )

    def _close_enough(self, stage: Stage, curvature: Curvature, last: Bool[Array, ""]) -> Scalar:
        """The search of a stage ends if the minimum is at most so far away along each direction."""
        noise = misfit(curvature.shot.cost.sum(), stage.measurements)
        fine = jnp.maximum(self.tolerance * noise, stage.smallest_step)
        return jnp.where(last, fine, _COARSE * jnp.maximum(noise, 1.0))

    def _narrow(
        self, stage: Stage, search: Search, bisected: Bool[Array, " n"], slope: Float[Array, "windows n"]
    ) -> Search:
        """Narrows the brackets of this turn; after its last shot moves, and opens the brackets of the next turn."""
        view, lines = search.view, search.lines
        # A failed shot points back to the beginning.
        lines = narrow(lines, jnp.where(jnp.isfinite(slope), slope, lines.trial))
        over = search.shots + 1 == self.halvings
        found = over & bisected
        steps = jnp.where(found, lines.trial, search.steps)
        following = self._open(stage, view, search.brackets, steps)
        return search._replace(
            lines=jax.tree.map(lambda new, old: jnp.where(over, new, old), following, lines),
            turn=search.turn + over,
            shots=jnp.where(over, 0, search.shots + 1),
            steps=steps,
            errors=jnp.where(found, lines.trial - lines.predicted, search.errors),
            at_end=jnp.where(found, lines.at_end, search.at_end),
        )

    def _look_around(
        self,
        stage: Stage,
        search: Search,
        unknowns: Float[Array, "windows unknowns"],
        curvature: Curvature,
        spread: Float[Array, "windows unknowns unknowns"],
        before: Int[Array, ""],
        last: Bool[Array, ""],
    ) -> Search:
        """Chooses directions and opens brackets, unless the search ends here.

        If the sweep made things worse, the search goes back to where it began, and stays closer.
        """
        first, nothing, before_it = search.sweeps == 0, jnp.zeros_like(search.steps), search.view
        finite = jnp.isfinite(unknowns).all() & jnp.isfinite(curvature.shot.cost).all()
        failed = ~first & ~(finite & _no_worse(curvature.shot, before_it.curvature.shot))
        unknowns, curvature = jax.tree.map(
            lambda new, old: jnp.where(failed, old, new), (unknowns, curvature), before_it[:2]
        )
        choose = joint_factor if self.directions == "whitened" else coordinate_directions
        factor, basis = choose(curvature.information + stage.prior, stage.parameter_count)
        below, above = rooms(unknowns, basis, stage.limits)
        longest_step = jnp.abs(jnp.clip(-stage.along(basis, curvature.gradient), -below, above)).max()
        done = ~first & (longest_step <= self._close_enough(stage, curvature, last))
        hopeless = first & ~finite
        stay = done | hopeless | (search.sweeps >= self.max_sweeps)

        trust = jnp.where(failed, search.trust * _RETREAT, jnp.minimum(search.trust * _ADVANCE, 1.0))
        growth = jnp.where(search.at_end, GROWTH * search.growth, 1.0)
        share = relative_error(search.errors, search.steps, stage.smallest_step)
        later = jnp.maximum(share * longest_step, stage.smallest_step) * growth
        brackets = open_brackets(factor, spread, later=later, first=first)
        brackets = brackets._replace(longest=jnp.where(trust < 1, trust * longest_step, brackets.longest))
        view = View(unknowns, curvature, basis)
        return Search(
            view=view,
            brackets=brackets,
            lines=self._open(stage, view, brackets, nothing),
            turn=jnp.zeros((), dtype=int),
            shots=jnp.zeros((), dtype=int),
            steps=nothing,
            errors=nothing,
            at_end=nothing > 0,
            growth=growth,
            sweeps=search.sweeps + jnp.where(stay, 0, 1),
            rollouts=search.rollouts,
            trust=trust,
            done=done | hopeless,
            ended=stay,
            record=record_brackets(search.record, before + search.sweeps, view, brackets.half_width, skip=stay),
        )

    def _open(self, stage: Stage, view: View, brackets: Brackets, steps: Float[Array, "windows n"]) -> Lines:
        """The lines along all directions, after these steps."""
        below, above = (
            jnp.minimum(room, brackets.longest) for room in rooms(view.after(steps), view.basis, stage.limits)
        )
        return open_lines(view.predicted(stage, steps), brackets.half_width, below, above)

    def _finish(
        self,
        problem: ShootingProblem,
        bracket: Bracket,
        free: Bool[Array, " parameters"],
        progress: Progress,
        curvature: Curvature,
    ) -> Estimate:
        count = bracket.lower.shape[0]
        initial_state = progress.unknowns[:, count:].ravel() if problem.free_size else problem.first_state()[0]
        estimate = conclude(
            bracket,
            parameters=progress.unknowns[0, :count],
            covariance=jnp.where(free & free[:, None], covariance_of_shared(curvature.information, count), 0.0),
            initial_state=initial_state,
            cost=curvature.shot.cost.sum(),
            rollouts=progress.rollouts,
            sweeps=progress.sweeps,
            sound=curvature.shot.sound.all(),
            done=progress.done,
            reach=self.reach,
        )
        return eqx.tree_at(lambda e: e.brackets, estimate, progress.brackets, is_leaf=lambda leaf: leaf is None)


def _no_curvature(progress: Progress) -> Curvature:
    zero = jnp.zeros(progress.unknowns.shape[:1], dtype=float)
    return Curvature(Shot(zero, zero > 0), jnp.zeros_like(progress.unknowns), jnp.zeros_like(progress.spread))


def _no_worse(shot: Shot, before: Shot) -> Bool[Array, ""]:
    """The cost of a flight that fails means nothing."""
    sound, was_sound = shot.sound.all(), before.sound.all()
    return ~was_sound | (sound & (shot.cost.sum() <= before.cost.sum() + _CHANCE))
