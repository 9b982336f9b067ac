"""The Gauss-Newton search of output error and of filter error: Levenberg-Marquardt on any problem.

References: Marquardt 1963, SIAM J. Appl. Math. 11(2), on the damping.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Scalar
from ..linalg import joint_factor
from ..shooting import AbstractProblem, Curvature
from ..shooting.abstract import WindowUnknowns

_DAMPING_FACTOR = 10.0  # how much more, or less, is damped after a step that failed, or succeeded
# A search ends here too: steps with less than this damping failed, although they promised some of the gain.
_STALLED, _FLAT = 1.0, 0.05
# The share of a gain that counts if an unknown with a stride promises it: its gradient is approximate.
_ROUGH = 0.1


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
    steps: Int[Array, ""]
    done: Bool[Array, ""]


class Newton(NamedTuple):
    """A search for the minimum of a problem's cost.

    - `problem`: the likelihood.
    - `scale`: the unit of each unknown, in which damping and tolerance treat all alike. `None`: the standard deviation
      of each unknown, if the others were known.
    - `damping`: of the first step; `least_damping`: of any other.
    - `lower`, `upper`: the limits of the unknowns. `stride`: their longest steps.
    - `tolerance`: the search ends with a step that changes no unknown by more.
    - `gain`: it also ends if hardly damped steps promise to lower the cost by less.
    """

    problem: AbstractProblem
    scale: WindowUnknowns | None
    damping: float
    least_damping: float
    lower: WindowUnknowns
    upper: WindowUnknowns
    stride: WindowUnknowns
    tolerance: Scalar | float
    gain: Scalar | float

    def minimum(self, start: WindowUnknowns, max_steps: Int[Array, ""]) -> Search:
        """The best unknowns after at most `max_steps` steps from the start."""
        evaluate = self._evaluator()
        first = self.init(start, jax.eval_shape(evaluate, start))
        return jax.lax.while_loop(
            lambda search: ~search.done & (search.steps < max_steps), lambda search: self.step(evaluate, search), first
        )

    def init(self, start: WindowUnknowns, curvature: Curvature) -> Search:
        """The search before its first trial. `curvature`: its shapes."""
        nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), curvature)
        damping = jnp.full((), self.damping, dtype=float)
        return Search(start, nothing, start, damping, -jnp.ones((), dtype=int), jnp.zeros((), dtype=bool))

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
        trial = jnp.clip(best + step, self.lower, self.upper)
        step = trial - best
        small = self._is_small(step, curvature, damping)
        done = small | ~jnp.isfinite(step).all()
        return Search(jnp.where(small, trial, best), curvature, trial, damping, search.steps + 1, done)

    def _evaluator(self) -> Callable[[WindowUnknowns], Curvature]:
        problem, count = self.problem, self.problem.unknowns.count
        at, known = problem.evaluator(), problem.first_state()[0]

        def evaluate(unknowns: WindowUnknowns) -> Curvature:
            return at(unknowns[0, :count], unknowns[:, count:].ravel() if problem.free_size else known)

        return evaluate

    def _is_small(self, step: WindowUnknowns, curvature: Curvature, damping: Scalar) -> Bool[Array, ""]:
        """Whether a step ends the search."""
        if self.scale is not None:
            return (jnp.abs(step) <= self.tolerance * self.scale).all()
        unit, least = self._unit(curvature.information, self.problem.unknowns.count), 1 / jnp.square(self.stride)
        # By how much the step should lower the cost, as if it were hardly damped.
        eased = (jnp.maximum(damping, 1.0) * unit + least) / (unit + least)
        counts = jnp.where(jnp.isfinite(self.stride), _ROUGH, 1.0)
        left = -(counts * eased * curvature.gradient * step).sum()
        return (left < self.gain) | ((damping > _STALLED) & (left < _FLAT))

    def _step(self, best: WindowUnknowns, curvature: Curvature, damping: Scalar) -> WindowUnknowns:
        """The damped Gauss-Newton step of each window's unknowns; 0 for held ones, and for those that must not move.

        An unknown at its limit, which the gradient pushes beyond it, must not move.
        """
        count = self.problem.unknowns.count
        gradient = curvature.gradient.at[:, :count].set(curvature.gradient[:, :count].sum(axis=0))
        beyond = ((best <= self.lower) & (gradient > 0)) | ((best >= self.upper) & (gradient < 0))
        moves = ~beyond & jnp.ones_like(beyond).at[:, :count].set(self.problem.unknowns.free)
        information = jnp.where(moves[:, :, None] & moves[:, None, :], curvature.information, 0.0)
        # The information misjudges the curvature along an unknown with a stride: damp it in any case.
        added = damping * self._unit(information, count) + 1 / jnp.square(self.stride)
        basis = joint_factor(information + jax.vmap(jnp.diag)(added), count).basis
        slopes = (basis * jnp.where(moves, curvature.gradient, 0.0)[:, :, None]).sum(axis=1)
        shared = jnp.arange(slopes.shape[1]) >= slopes.shape[1] - count
        slopes = jnp.where(shared, slopes.sum(axis=0), slopes)
        return -(basis * slopes[:, None, :]).sum(axis=-1)

    def _unit(self, information: Float[Array, "windows n n"], count: int) -> WindowUnknowns:
        """The information that a damping of 1 adds; about a parameter once, as all windows share it."""
        if self.scale is not None:
            return 1 / jnp.square(self.scale).at[:, :count].multiply(self.problem.windows)
        diagonal = jnp.diagonal(information, axis1=1, axis2=2)
        return jnp.where(diagonal > 0, diagonal, 1.0)


def newton(
    problem: AbstractProblem,
    *,
    reach: Scalar | float,
    damping: float,
    least_damping: float = 0.0,
    scale: WindowUnknowns | None = None,
    tolerance: Scalar | float = 0.0,
    gain: Scalar | float = 0.0,
) -> Newton:
    """The search of a problem in units of `scale`, at most `reach` half-widths from the center of the bracket."""
    lower, upper = problem.limits(reach)
    stride = problem.each_window(problem.unknowns.stride, jnp.inf)
    return Newton(problem, scale, damping, least_damping, lower, upper, stride, tolerance, gain)


def _cost(curvature: Curvature) -> Scalar:
    """The cost of all windows; infinite for a trajectory that fails."""
    cost, sound = curvature.shot
    return jnp.where(sound.all() & jnp.isfinite(cost).all(), cost.sum(), jnp.inf)
