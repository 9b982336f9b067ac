"""Output error and filter error: maximum likelihood by damped Gauss-Newton steps (Levenberg-Marquardt).

The search minimises any problem's cost. Output error is the prediction-error method for a model without process noise:
nonlinear least squares of the simulated against the measured trajectory. Filter error allows for disturbances that the
model does not contain: its likelihood is that of `InnovationsProblem`.

References: Marquardt 1963, SIAM J. Appl. Math. 11(2), on the damping; Ljung, System Identification, ch. 7 and 13;
Jategaonkar, Flight Vehicle System Identification, ch. 4 and 5.
"""

import functools
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._custom_types import Count, Scalar, integer, setting
from ..bracket import GAUSSIAN_PRIOR, NO_PRIOR, Bracket
from ..estimate import REACH, AbstractEstimator, Estimate, as_estimate, estimate_at, fit_start, from_starts
from ..linalg import joint_factor, movable, slopes_along
from ..results import RESULTS
from ..shooting import AbstractProblem, Curvature, InnovationsProblem, ShootingProblem, in_blocks
from ..shooting.abstract import WindowUnknowns

_DAMPING_FACTOR = 10.0  # how much more, or less, is damped after a step that failed, or succeeded
# A search ends here too: steps with less than this damping failed, although they promised some of the gain.
_STALLED, _FLAT = 1.0, 0.05
# The information of an unknown with a stride misjudges the curvature, so this much is added to it, per squared stride.
_LEAST = 0.3
_COARSE = 1e-3  # the tolerance of output error on the problems before the last


class Search(NamedTuple):
    """The state of a search.

    - `best`, `curvature`: the best unknowns so far, and the curvature of the cost there.
    - `trial`: the next unknowns to try.
    - `damping`: of the next step.
    - `steps`: the number of steps so far; -1 before the first trial, which is the start itself.
    - `done`: whether the search ended by itself.
    """

    best: WindowUnknowns
    curvature: Curvature
    trial: WindowUnknowns
    damping: Scalar
    steps: Count
    done: Bool[Array, ""]


class Newton(NamedTuple):
    """A search for the minimum of a problem's cost.

    - `damping`: of the first step; `least_damping`: of any other.
    - `scale`: the unit of each unknown, in which damping and tolerance treat all alike. `None`: the standard deviation
      of each unknown, if the others were known.
    - `tolerance`: a search with a `scale` ends with a step that changes no unknown by more.
    - `gain`: a search without one ends if hardly damped steps promise to lower the cost by less.
    """

    problem: AbstractProblem
    damping: float
    least_damping: float = 0.0
    scale: WindowUnknowns | None = None
    tolerance: Scalar | float = 0.0
    gain: Scalar | float = 0.0

    @property
    def stride(self) -> WindowUnknowns:
        """The longest step of each unknown."""
        return self.problem.each_window(self.problem.unknowns.stride, jnp.inf)

    @property
    def least(self) -> WindowUnknowns:
        """The information that damps each unknown in any case."""
        return _LEAST / jnp.square(self.stride)

    def minimum(self, start: WindowUnknowns, max_steps: Count) -> Search:
        """The best unknowns after at most `max_steps` steps from the start."""
        problem, count = self.problem, self.problem.unknowns.count
        at, known = problem.evaluator(), problem.first_state()[0]

        @jax.jit  # traced once, although it is called twice
        def evaluate(unknowns: WindowUnknowns) -> Curvature:
            return at(unknowns[0, :count], unknowns[:, count:].ravel() if problem.free_size else known)

        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(evaluate, start))
        damping = jnp.full((), self.damping, dtype=float)
        first = Search(start, nothing, start, damping, -jnp.ones((), dtype=int), jnp.zeros((), dtype=bool))
        step = functools.partial(self.step, evaluate)
        return jax.lax.while_loop(lambda search: ~search.done & (search.steps < max_steps), step, first)

    def step(self, evaluate: Callable[[WindowUnknowns], Curvature], search: Search) -> Search:
        """Try, keep the better, and propose the next trial. The first trial is the start, so it is always better."""
        now, first = evaluate(search.trial), search.steps < 0
        better = first | (_cost(now) < _cost(search.curvature))
        best, curvature = jax.tree.map(
            lambda new, old: jnp.where(better, new, old), (search.trial, now), (search.best, search.curvature)
        )
        factor = jnp.where(first, 1.0, jnp.where(better, 1 / _DAMPING_FACTOR, _DAMPING_FACTOR))
        damping = jnp.maximum(search.damping * factor, self.least_damping)
        step = jnp.clip(self._step(best, curvature, damping), -self.stride, self.stride)
        trial = jnp.clip(best + step, *self.problem.limits(REACH))
        step = trial - best
        small = self._is_small(step, curvature, damping)
        done = small | ~jnp.isfinite(step).all()
        return Search(jnp.where(small, trial, best), curvature, trial, damping, search.steps + 1, done)

    def _is_small(self, step: WindowUnknowns, curvature: Curvature, damping: Scalar) -> Bool[Array, ""]:
        """Whether a step ends the search."""
        if self.scale is not None:
            return (jnp.abs(step) <= self.tolerance * self.scale).all()
        unit = self._unit(curvature.information)
        # By how much the step should lower the cost, as if it were hardly damped.
        eased = (jnp.maximum(damping, 1.0) * unit + self.least) / (unit + self.least)
        left = -(eased * curvature.gradient * step).sum()
        return (left < self.gain) | ((damping > _STALLED) & (left < _FLAT))

    def _step(self, best: WindowUnknowns, curvature: Curvature, damping: Scalar) -> WindowUnknowns:
        """The damped Gauss-Newton step of each window's unknowns; 0 for those that are held or at their limit."""
        count, free = self.problem.unknowns.count, self.problem.unknowns.free
        moves = movable(best, curvature.gradient, self.problem.limits(REACH), count)
        moves = moves.at[:, :count].set(moves[:, :count] & free)
        information = jnp.where(moves[:, :, None] & moves[:, None, :], curvature.information, 0.0)
        added = damping * self._unit(information) + self.least
        basis = joint_factor(information + jax.vmap(jnp.diag)(added), count).basis
        slopes = slopes_along(basis, jnp.where(moves, curvature.gradient, 0.0), count)
        return -(basis * slopes[:, None, :]).sum(axis=-1)

    def _unit(self, information: Float[Array, "windows n n"]) -> WindowUnknowns:
        """The information that a damping of 1 adds; about a parameter once, as all windows share it."""
        if self.scale is not None:
            shared, windows = self.problem.unknowns.count, self.problem.windows
            return 1 / jnp.square(self.scale).at[:, :shared].multiply(windows)
        diagonal = jnp.diagonal(information, axis1=1, axis2=2)
        return jnp.where(diagonal > 0, diagonal, 1.0)


def _cost(curvature: Curvature) -> Scalar:
    """The cost of all windows; infinite for a trajectory that fails."""
    cost, feasible = curvature.shot
    return jnp.where(feasible.all() & jnp.isfinite(cost).all(), cost.sum(), jnp.inf)


class OutputError(AbstractEstimator):
    """Levenberg-Marquardt on the weighted residuals, from the bracket's center.

    The rates are fitted first, and then all channels with them: from a wide bracket, a direct fit of all channels can
    end in another minimum.

    **Arguments:**

    - `tolerance`: the search ends with a step that changes no unknown by more, in half-widths of the bracket. Cost and
      covariance are those before this step.
    - `max_steps`: for each stage.
    """

    looks_at: ClassVar[str] = "all"
    shoots: ClassVar[bool] = True
    prior: ClassVar[float] = NO_PRIOR

    tolerance: Scalar = eqx.field(converter=setting("tolerance", positive=True), default=1e-5)
    max_steps: Count = eqx.field(converter=integer("max_steps", 1), default=100)

    @eqx.filter_jit
    def __call__(self, problem: ShootingProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight.

        The estimate's `rollouts` count each trial and each of its tangents; `sweeps` are the steps of all stages.

        **Raises:** `ValueError` for a bracket of another length than the model's parameters.
        """
        return in_blocks(self._identify, problem.within(bracket))

    def _identify(self, problem: ShootingProblem) -> Estimate:
        """One flight, or a block of flights."""
        first, off = problem.first_state()
        unknowns, count = problem.join(problem.unknowns.usable.center, first), problem.unknowns.count
        scale = problem.join(problem.unknowns.usable.half_width, off)
        steps, rollouts, searches = jnp.zeros((), dtype=int), jnp.zeros((), dtype=int), []
        for stage in problem.cascade():
            own = count + stage.free_size
            tolerance = self.tolerance if stage is problem else jnp.maximum(self.tolerance, _COARSE)
            # A damping in units of the bracket hardly changes the first step of a flight with information.
            method = Newton(stage, damping=1.0, scale=scale[:, :own], tolerance=tolerance)
            search = method.minimum(unknowns[:, :own], self.max_steps)
            searches.append(search)
            unknowns, steps = unknowns.at[:, :own].set(search.best), steps + search.steps
            rollouts = rollouts + (search.steps + 1) * (1 + count + problem.windows * stage.free_size)
        return estimate_at(problem, unknowns, searches[-1].curvature, rollouts, steps, done=searches[-1].done)


class FilterError(AbstractEstimator):
    """Maximum likelihood of the innovations of Kalman filters, by Gauss-Newton steps from the bracket's center.

    It compares the body rates, and specific force if the model predicts it. The disturbance and the sensor's noise of
    each channel are estimated too, see `InnovationsProblem`. The bracket is a Gaussian prior, whose standard deviation
    is the bracket's half-width.

    **Arguments:**

    - `tolerance`: the search ends with a step that promises to lower the cost by less. An error of one standard
      deviation costs 0.5.
    - `max_steps`: of the search from one time constant of the disturbance.
    """

    looks_at: ClassVar[str] = "rates"
    shoots: ClassVar[bool] = False
    prior: ClassVar[float] = GAUSSIAN_PRIOR
    in_closed_loop: ClassVar[bool] = True

    tolerance: Scalar = eqx.field(converter=setting("tolerance", positive=True), default=3e-3)
    max_steps: Count = eqx.field(converter=integer("max_steps", 1), default=200)

    @eqx.filter_jit
    def __call__(self, problem: ShootingProblem | InnovationsProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight.

        The estimate of a shooting problem has the model's parameters alone, and the cost of a simulation, as that of
        any other estimator. The estimate of a problem of innovations has all its unknowns and the cost of these.

        **Raises:** `ValueError` for a bracket of another length than the model's parameters.
        """
        return in_blocks(self._identify, problem.within(bracket))

    def _identify(self, problem: ShootingProblem | InnovationsProblem) -> Estimate:
        """One flight, or a block of flights."""
        if isinstance(problem, InnovationsProblem):
            return self._search(problem)
        found, count = self._search(InnovationsProblem(problem)), problem.unknowns.count
        parameters = found.parameters[:count]
        first, cost, feasible, rollouts = fit_start(problem, parameters)
        return as_estimate(
            problem,
            parameters=parameters,
            covariance=found.covariance[:count, :count],
            initial_state=first,
            cost=cost,
            rollouts=rollouts + found.rollouts,
            sweeps=found.sweeps,
            feasible=feasible & jnp.isfinite(found.cost),
            done=found.result != RESULTS.max_sweeps,
            prior=self.prior,
        )

    def _search(self, problem: InnovationsProblem) -> Estimate:
        """The estimate of all unknowns of the innovations."""
        method = Newton(problem, damping=1e-2, least_damping=1e-4, gain=self.tolerance)

        def search(first: Float[Array, " unknowns"]) -> Estimate:
            best, curvature, _, _, steps, done = method.minimum(first[None], self.max_steps)
            return estimate_at(problem, best, curvature, (steps + 1) * (1 + first.shape[0]), steps, done=done)

        return from_starts(problem, None, search)
