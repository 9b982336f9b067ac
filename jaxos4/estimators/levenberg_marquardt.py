"""Levenberg-Marquardt: damped Gauss-Newton steps on any likelihood, corrected by secants.

Gauss-Newton ignores the second derivatives of the residuals. So its steps are too long along some unknowns, such as a
delay, and damping shortens them along all unknowns. The change of the gradient over the last step, a secant, shows by
how much the information misjudges the curvature along that step.

References: Marquardt 1963, SIAM J. Appl. Math. 11(2); compare Dennis, Gay and Welsch 1981, ACM Trans. Math.
Softw. 7(3).
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._custom_types import Count, Scalar, integer, setting
from ..batching import where_needed
from ..estimate import REACH
from ..linalg import joint_factor, limited, movable, slopes_along
from ..shooting import LocalModel, Stage, WindowUnknowns
from .solver import AbstractSolver, Found, chosen, cost_of

_COARSE = 1e-3  # the smallest `step_tolerance` of all stages except the last
_FACTOR = 10.0  # by which the damping falls after a step that succeeded, and rises after one that failed
# Information in 1/stride^2 that is always added for unknowns with a stride, whose own information is inexact.
_STRIDE_INFORMATION = 0.3
# Secants with more, or less, than these multiples of the curvature of the information are ignored: rounding, or the
# distance to the minimum, would decide.
_STEEPEST, _FLATTEST = 1e3, 0.1
# The dampings of our solvers are powers of ten. Above the first of these, damping shortens steps; above the second,
# failures are blamed on the gradient, which may be approximate.
_SHORTENS, _HOPELESS = 3.0, 3e3
_NEAR = 1.0  # a minimum is near if less is left to gain
_SLOW = 0.05  # convergence is slow if a step leaves more than this part of what was left


class SearchState(NamedTuple):
    """The search of a stage before a shot.

    - `best`, `model`: the best unknowns so far, and the local model there. If a last step ends the stage, `best`
      includes this step, and `model` is that of the point before it.
    - `trial`: where the shot will be.
    - `damping`: of the last step; before the first shot, `_FACTOR` times that of the first step.
    - `failed`: whether the step before the trial failed. `is_steep`: whether the last secant showed more curvature than
      the information, and so corrected the trial.
    - `left`: the reduction of the cost that was still expected at the last shot.
    - `shots`: the number of shots so far.
    - `done`: whether the stage ended by itself.
    """

    best: WindowUnknowns
    model: LocalModel
    trial: WindowUnknowns
    damping: Scalar
    failed: Bool[Array, ""]
    is_steep: Bool[Array, ""]
    left: Scalar
    shots: Count
    done: Bool[Array, ""]


class LevenbergMarquardt(AbstractSolver[SearchState]):
    """The solver of output error and filter error.

    Gauss-Newton steps are damped more after a step that failed, and less after one that succeeded, unless the step
    before failed. Near a minimum, secants lengthen or shorten the next step. After a failure, and then as long as the
    cost curves more than the information says, they shorten it.

    - `step_tolerance`: a stage ends with a step that moves no unknown by more than this fraction of its initial
      uncertainty. Cost and covariance are those before this step. After a step that failed, it is not taken. In stages
      before the last, it is at least 0.001.
    - `gain_tolerance`: a stage ends if steps with little damping promise to lower the cost by less. An error of one
      standard deviation costs 0.5.
    - `flat`: with damping above 1, a stage also ends if a step with hardly any damping would promise less than this;
      with damping above 1000, less than ten times this.
    - `max_steps`: the most steps of a stage.
    - `is_relative`: whether damping is relative to the information about each unknown (Marquardt). Otherwise it is
      relative to the knowledge before the flight (Levenberg), and hardly changes the steps of a flight with much
      information.
    - `damping`: of the first step. `least_damping`: of any other.
    - `shares`: see `AbstractProblem.stages`. The rates are fitted first, then all channels, because a direct fit of all
      channels from a wide bracket can end in another minimum.
    - `reach`: the search does not go further than this many half-widths from the bracket's center.
    """

    step_tolerance: Scalar = eqx.field(converter=setting("step_tolerance"), default=1e-5)
    gain_tolerance: Scalar = eqx.field(converter=setting("gain_tolerance"), default=0.0)
    flat: float = eqx.field(static=True, default=0.0)
    max_steps: Count = eqx.field(converter=integer("max_steps", 1), default=100)
    is_relative: bool = eqx.field(static=True, default=False)
    damping: float = eqx.field(static=True, default=1.0)
    least_damping: float = eqx.field(static=True, default=0.0)
    shares: tuple[float, ...] = eqx.field(static=True, default=(1.0,))
    reach: Scalar = eqx.field(converter=setting("reach", positive=True), default=REACH)

    def init(self, stage: Stage, before: Found) -> SearchState:
        """The first trial is the start, and its shot counts as better than none."""
        damping = jnp.full((), _FACTOR * self.damping, dtype=float)
        left, none, no = jnp.full((), jnp.inf, dtype=float), jnp.zeros((), dtype=int), jnp.zeros((), dtype=bool)
        return SearchState(before.unknowns, before.model, before.unknowns, damping, no, no, left, none, no)

    def step(self, stage: Stage, state: SearchState) -> SearchState:
        """Shoot at the trial, keep the better, and propose the next trial."""
        found, before, count = stage.local_model(state.trial), state.model, stage.unknowns.count
        better = (state.shots == 0) | (cost_of(found) < cost_of(before))
        best, model = chosen(better, (state.trial, found), (state.best, before))
        # The step after a failure may succeed by its secant, or by its damping: keep the damping.
        eased = jnp.where(state.failed, 1.0, 1 / _FACTOR)
        damping = state.damping * jnp.where(better, eased, _FACTOR)
        damping = jnp.maximum(damping, self.least_damping)

        limits = stage.limits(self.reach)
        lower, upper = (limit - best for limit in limits)
        moves = movable(best, model.gradient, limits, count) & stage.searched
        slope = jnp.where(moves, model.gradient, 0.0)
        # Without `stage`, whose local model closes over the data of each lane.
        minimise = functools.partial(self._minimum, count)
        local = stage.off, stage.stride, moves, slope, damping
        minimum = minimise(*local, model.information)
        plain = limited(*minimum, (lower, upper), count)
        left = self._left(stage, plain, model, damping)
        # The last step is the plain one, without secant or stride. No shot confirms it, so a success must come before.
        last = self._is_small(stage, plain) | self._is_stalled(left, damping)
        end = jnp.where(last & better, jnp.clip(best + plain, *limits), best)

        change = jnp.where(found.feasible.all() & before.feasible.all(), found.gradient - before.gradient, jnp.nan)
        moved = state.trial - state.best
        predicted = jnp.einsum("wij,wj->wi", model.information, moved)
        is_more = (moved * change).sum() > (moved * predicted).sum()
        # Far from a minimum, the secant of a first success may mislead; where convergence is quick, none is needed.
        near = better & ~state.failed & (left < _NEAR) & (left > _SLOW * state.left)
        steeper = jax.vmap(_steeper)(model.information, moved, change, predicted)
        steeper = jnp.where((near | ~better | state.is_steep) & is_more, steeper, 0.0)
        flatter = jnp.where(near & ~is_more, jax.vmap(_flatter)(moved, change, predicted), 0.0)
        missing = steeper + flatter
        # A second factorisation is made only where a secant applies.
        step, basis = where_needed((missing != 0).any(), minimise, minimum, *local, model.information + missing)
        room = jnp.maximum(lower, -stage.stride), jnp.minimum(upper, stage.stride)
        trial = jnp.clip(best + limited(step, basis, room, count), *limits)
        done, is_steep = last | ~jnp.isfinite(trial).all(), (steeper != 0).any()
        return SearchState(end, model, trial, damping, ~better, is_steep, left, state.shots + 1, done)

    def terminate(self, stage: Stage, state: SearchState) -> Bool[Array, ""]:
        """Whether the stage ended by itself, has no next step, or had too many."""
        return state.done | (state.shots > self.max_steps)

    def postprocess(self, stage: Stage, state: SearchState, before: Found) -> Found:
        """The best unknowns. A shot counts as one rollout, and one more for each unknown that is searched."""
        steps = jnp.maximum(state.shots - 1, 0)  # a search that is skipped makes no shot
        done = state.done & jnp.isfinite(state.trial).all()  # without a finite next step, no minimum was found
        return Found(state.best, state.model, before.spread, steps, state.shots * (1 + stage.searched.sum()), done)

    def _is_small(self, stage: Stage, step: WindowUnknowns) -> Bool[Array, ""]:
        """Whether a step is so short that it ends the stage."""
        tolerance = jnp.where(stage.last, self.step_tolerance, jnp.maximum(self.step_tolerance, _COARSE))
        return (jnp.abs(step) <= tolerance * stage.off).all()

    def _is_stalled(self, left: Scalar, damping: Scalar) -> Bool[Array, ""]:
        """Whether so little is left to gain that the stage ends. A step uphill, possible at limits, ends nothing."""
        flat = self.flat * jnp.where(damping > _HOPELESS, 10.0, 1.0)
        tolerance = jnp.where(damping > _SHORTENS, jnp.maximum(self.gain_tolerance, flat), self.gain_tolerance)
        return (left >= 0) & (left < tolerance)

    def _left(self, stage: Stage, step: WindowUnknowns, model: LocalModel, damping: Scalar) -> Scalar:
        """The expected reduction of the cost: the larger of this step's and that of a step with hardly any damping.

        An undamped step lowers a quadratic by half of this, so searches end later than the tolerance says.
        """
        unit, least = self._unit(stage.unknowns.count, stage.off, model.information), _least(stage.stride)
        eased = (jnp.maximum(damping, 1.0) * unit + least) / (unit + least)
        promised = -model.gradient * step
        return jnp.maximum(promised.sum(), (eased * promised).sum())

    def _minimum(
        self,
        count: int,
        off: WindowUnknowns,
        stride: WindowUnknowns,
        moves: Bool[Array, "windows n"],
        slope: WindowUnknowns,
        damping: Scalar,
        information: Float[Array, "windows n n"],
    ) -> tuple[WindowUnknowns, Float[Array, "windows n n"]]:
        """The damped step to the minimum of a local model along the unknowns that move, and its basis.

        `count`, `off`, `stride`: of the stage. `slope`: the gradient, 0 for unknowns that do not move.
        """
        information = jnp.where(moves[:, :, None] & moves[:, None, :], information, 0.0)
        added = damping * self._unit(count, off, information) + _least(stride)
        basis = joint_factor(information + jax.vmap(jnp.diag)(added), count).basis
        return -(basis * slopes_along(basis, slope, count)[:, None, :]).sum(axis=-1), basis

    def _unit(self, count: int, off: WindowUnknowns, information: Float[Array, "windows n n"]) -> WindowUnknowns:
        """The information that a damping of 1 adds. For a parameter it is divided among the windows, which share it."""
        if self.is_relative:
            diagonal = jnp.diagonal(information, axis1=1, axis2=2)
            return jnp.where(diagonal > 0, diagonal, 1.0)
        return 1 / jnp.square(off).at[:, :count].multiply(off.shape[0])


def _least(stride: WindowUnknowns) -> WindowUnknowns:
    """The information that always damps each unknown."""
    return _STRIDE_INFORMATION / jnp.square(stride)


def _steeper(
    information: Float[Array, "n n"],
    step: Float[Array, " n"],
    change: Float[Array, " n"],
    predicted: Float[Array, " n"],
) -> Float[Array, "n n"]:
    """The rank-one correction with which the information predicts the `change` of the gradient over a step.

    It is positive semidefinite; 0 unless the cost curves more than `predicted` by the information, and not too steeply.
    """
    missing, diagonal = change - predicted, jnp.diagonal(information)
    steepness, more = (jnp.square(missing) / jnp.where(diagonal > 0, diagonal, 1.0)).sum(), missing @ step
    applies = steepness < _STEEPEST * more
    return jnp.where(applies, jnp.outer(missing, missing) / jnp.where(applies, more, 1.0), 0.0)


def _flatter(
    step: Float[Array, " n"], change: Float[Array, " n"], predicted: Float[Array, " n"]
) -> Float[Array, "n n"]:
    """The correction of Broyden, Fletcher, Goldfarb and Shanno for a step along which the cost curves less.

    The information stays positive definite. 0 if the cost curves more than it says, or hardly at all.
    """
    seen, expected = change @ step, predicted @ step
    applies = (seen < expected) & (seen > _FLATTEST * expected)
    new = jnp.outer(change, change) / jnp.where(applies, seen, 1.0)
    old = jnp.outer(predicted, predicted) / jnp.where(applies, expected, 1.0)
    return jnp.where(applies, new - old, 0.0)
