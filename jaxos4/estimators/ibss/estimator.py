"""Iterative Bi-Section Shooting: the settings, the stages, and one sweep.

A *shot* simulates the flight at trial unknowns and returns the slope of the cost along one direction. The sign of the
slope says which half of a bracket holds the minimum. A *sweep* bisects along every direction once, each time around the
step that the cost's quadratic model predicts. A *stage* repeats sweeps on some channels until the minimum is near.

If the flight is cut into windows, each window has its own initial state. Parameters are bisected on the sum of the
windows' slopes; initial states are bisected in all windows in parallel.
"""

import functools
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from ..._custom_types import Parameters, Scalar, as_float
from ...bracket import NO_PRIOR, Bracket
from ...estimate import REACH, AbstractEstimator, Estimate, check_bracket, conclude
from ...linalg import covariance_of_shared, covariances, gram
from ...shooting import Curvature, ShootingProblem, Shot
from .bisection import move_along_all
from .brackets import GROWTH, open_brackets, relative_error
from .progress import Progress, Search, record_brackets
from .stage import Limits, Stage, join, misfit, prior_std, stages
from .view import look_around

DIRECTIONS = ("whitened", "coordinate")

# The rates are first fitted to these shares of the flight. Errors grow with time, so the cost of a long flight has
# other minima: without these stages CorrectedOS4 falls into one in a fifth of all cases.
_HORIZONS = (0.1, 0.3)
# A stage that is not the last ends once no direction has more than this many standard deviations to go.
_COARSE = 0.5


class IBSS(AbstractEstimator):
    """Iterative Bi-Section Shooting.

    **Arguments:**

    - `directions`: `"whitened"`: the columns of L^-T, with L L^T the Fisher information at the current estimate; the
      cost is nearly separable along them. The rates are fitted first, then all channels.
      `"coordinate"`: the parameters themselves, against all of the problem's channels at once, in the manner of the
      paper; good on the rates, slow on more channels.
    - `halvings`: the shots along each direction in a sweep, each of which narrows the bracket.
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
    max_sweeps: int = eqx.field(static=True, default=60)
    tolerance: Scalar = eqx.field(converter=as_float, default=0.02)
    reach: Scalar = eqx.field(converter=as_float, default=REACH)
    record: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        if self.directions not in DIRECTIONS:
            raise ValueError(f"`directions` must be one of {', '.join(DIRECTIONS)}, got {self.directions!r}.")
        for name, least in (("halvings", 2), ("max_sweeps", 1), ("record", 0)):
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise ValueError(f"`{name}` must be an integer of at least {least}, got {value!r}.")
        for name in ("tolerance", "reach"):
            value = getattr(self, name)
            if not isinstance(value, Tracer) and not np.asarray(value) > 0:
                raise ValueError(f"`{name}` must be positive, got {value}.")

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
        return self.search(problem, bracket, start=start, spread=spread, free=free)

    def search(
        self,
        problem: ShootingProblem,
        bracket: Bracket,
        *,
        start: Parameters | None = None,
        spread: Float[Array, "parameters parameters"] | None = None,
        free: Bool[Array, " parameters"] | None = None,
        cascade: Bool[Array, ""] | bool = True,
        skip: Bool[Array, ""] | None = None,
    ) -> Estimate:
        """Identifies one flight, inside the program of another estimator.

        **Arguments:** as of a call, and

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

        progress = self._begin(problem, usable, limits, start, spread, skip=skip)
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
        start: Parameters,
        spread: Float[Array, "parameters parameters"] | None,
        *,
        skip: Bool[Array, ""],
    ) -> Progress:
        unknowns, count = join(problem, start, problem.first_state()[0]), start.shape[0]
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
        search = Search(
            unknowns=progress.unknowns,
            curvature=_no_curvature(progress),
            basis=jnp.zeros_like(progress.spread),
            relative_error=jnp.ones((), dtype=float),
            growth=jnp.ones_like(progress.unknowns),
            sweeps=jnp.zeros((), dtype=int),
            done=progress.done,
            ended=progress.done,
            brackets=progress.brackets,
        )
        sweep = functools.partial(self._sweep, stage, spread=progress.spread, before=progress.sweeps, last=last)
        search = jax.lax.while_loop(lambda search: ~search.ended, sweep, search)
        if self.directions == "coordinate":
            covariance = covariances(search.curvature.information + stage.prior, stage.parameter_count)
        else:
            covariance = gram(search.basis)
        noise = jnp.maximum(misfit(search.curvature.shot.cost.sum(), stage.measurements), 1.0)
        searched = stage.searched
        rollouts = jnp.where(progress.done, 0, stage.size * (1 + search.sweeps * (self.halvings + 1)))
        return Progress(
            search.unknowns,
            jnp.where(searched & searched[:, None], jnp.square(noise) * covariance, progress.spread),
            progress.sweeps + search.sweeps,
            progress.rollouts + rollouts,
            search.done,
            search.brackets,
        ), search.curvature

    def _sweep(
        self,
        stage: Stage,
        search: Search,
        *,
        spread: Float[Array, "windows unknowns unknowns"],
        before: Int[Array, ""],
        last: Bool[Array, ""],
    ) -> Search:
        """Looks around, and unless the search ends here moves along each direction. `before`: sweeps so far."""
        whitened, first = self.directions == "whitened", search.sweeps == 0
        view = look_around(stage, search.unknowns, whitened=whitened)
        fine = jnp.maximum(self.tolerance * view.misfit, stage.smallest_step)
        close_enough = jnp.where(last, fine, _COARSE * jnp.maximum(view.misfit, 1.0))
        done = ~first & (view.longest_step <= close_enough)
        finite = jnp.isfinite(view.curvature.shot.cost).all()
        stay = done | ~finite | (search.sweeps >= self.max_sweeps)

        later = jnp.maximum(search.relative_error * view.longest_step, stage.smallest_step) * search.growth
        brackets = open_brackets(view.factor, spread, later=later, first=first)
        moves = move_along_all(stage, view, brackets, halvings=self.halvings, stay=stay)

        sound = finite & jnp.isfinite(moves.unknowns).all()
        cost, trusted = view.curvature.shot
        return Search(
            unknowns=jnp.where(sound, moves.unknowns, search.unknowns),
            curvature=view.curvature._replace(shot=Shot(cost, trusted & sound)),
            basis=view.basis,
            relative_error=relative_error(moves.errors, moves.steps, stage.smallest_step),
            growth=jnp.where(moves.at_end, GROWTH * search.growth, 1.0),
            sweeps=search.sweeps + jnp.where(stay, 0, 1),
            done=done | ~sound,
            ended=stay | ~sound,
            brackets=record_brackets(search.brackets, before + search.sweeps, view, brackets.half_width, skip=stay),
        )

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
