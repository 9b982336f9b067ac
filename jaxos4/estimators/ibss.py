"""Iterative Bi-Section Shooting (IBSS): search intervals are narrowed by the slope of the cost.

The paper gives the idea only; the steps in this file are our choice.

All lengths are in standard deviations at the given noise. Only the test for the end scales them by the misfit. The
unknowns of a window are the shared ones, then the window's initial state. The directions of the initial state come
first. Along each shared direction, the initial states move too, to where they fit best.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._custom_types import Count, Scalar, integer, setting
from ..estimate import REACH
from ..linalg import gram, joint_factor, movable, room_to_limits, slopes_along
from ..shooting import LocalModel, Stage, WindowUnknowns
from .solver import AbstractSolver, Found, before_shots, chosen

Flag = Bool[Array, ""]
PerDirection = Float[Array, "windows n"]

_COARSE = 0.5  # a stage other than the last ends once the minimum is this close
_OPENING = 4.0  # the longest step of a stage's first sweep, in standard deviations of the stage's start
_NARROW = 0.05  # half-width of a stage's first intervals, relative to that longest step
_SAFETY = 2.0  # half-width of later intervals, relative to the error of the last prediction
_MIN_WIDTH = 0.01  # smallest half-width of later intervals, as a share of the longest predicted step, the largest one
_WIDENING, _MAX_WIDENING = 4.0, 256.0  # growth of an interval each time its last shot was at an end, and in total
_KEPT_RISE = 1.0  # a sweep that raises the cost by more is undone
_RETREAT, _ADVANCE = 0.25, 1.4  # growth of the longest step after a sweep that was undone, and after any other
# Unknowns with a stride have inexact slopes. A search with such unknowns also ends after a sweep that lowered the cost
# by at most `_SMALL_GAIN`, if its predicted steps were at most `_SHORT_STEP`.
_SHORT_STEP, _SMALL_GAIN = 0.3, 1e-4
_DAMPING = 0.1  # information that is added for unknowns with a stride, in 1/stride^2: theirs is inexact too


class Directions(NamedTuple):
    """The directions of a sweep, along which the cost is nearly separable, and the distances along them.

    - `factor`, `basis`: see `JointFactor`. A direction is a column of `basis`.
    - `moves`: the unknowns that may move: all except those at a limit beyond which the cost falls.
    - `below`, `above`: the distance to the limits, against and along each direction.
    - `predicted`: the step to the minimum of the local model.
    """

    factor: Float[Array, "windows unknowns n"]
    basis: Float[Array, "windows unknowns n"]
    moves: Bool[Array, "windows unknowns"]
    below: PerDirection
    above: PerDirection
    predicted: PerDirection

    @classmethod
    def none(cls, unknowns: WindowUnknowns) -> "Directions":
        """Before anything is known of the cost: no unknown moves."""
        matrix, zero = jnp.zeros((*unknowns.shape, unknowns.shape[1])), jnp.zeros_like(unknowns)
        return cls(matrix, matrix, jnp.zeros(unknowns.shape, dtype=bool), zero, zero, zero)

    @classmethod
    def at(cls, stage: Stage, unknowns: WindowUnknowns, model: LocalModel, reach: Scalar) -> "Directions":
        """The directions at some unknowns, with limits `reach` half-widths from the center.

        Every direction needs some information. Where the cost has no prior, the bracket counts as a weak one.
        """
        limits, count, windows = stage.limits(reach), stage.unknowns.count, len(unknowns)
        of_bracket, of_stride = 1 / jnp.square(stage.off / 2), _DAMPING / jnp.square(stage.unknowns.stride)
        shared = jnp.where(stage.unknowns.precision > 0, of_stride, of_bracket[:, :count] / windows)
        added = of_bracket.at[:, :count].set(shared)
        moves = movable(unknowns, model.gradient, limits, count)
        information = jnp.where(moves[:, :, None] & moves[:, None, :], model.information, 0.0)
        factor, basis = joint_factor(information + jax.vmap(jnp.diag)(added), count)
        lower, upper = (jnp.where(moves, limit, unknowns) for limit in limits)
        below, above = room_to_limits(unknowns, basis, (lower, upper))
        # Along a direction, the information is 1: the step is minus the slope.
        slopes = slopes_along(basis, jnp.where(moves, model.gradient, 0.0), count)
        return cls(factor, basis, moves, below, above, jnp.clip(-slopes, -below, above))

    def slopes(self, gradient: WindowUnknowns, count: int) -> PerDirection:
        """The slope of the cost along each direction, of the unknowns that move."""
        return slopes_along(self.basis, jnp.where(self.moves, gradient, 0.0), count)

    def sizes(self, spread: Float[Array, "windows unknowns unknowns"]) -> PerDirection:
        """The standard deviation along each direction of unknowns with this covariance."""
        return jnp.sqrt(jnp.einsum("wud,wuv,wvd->wd", self.factor, spread, self.factor))

    @property
    def longest(self) -> Scalar:
        """The longest predicted step."""
        return jnp.abs(self.predicted).max()


class SearchIntervals(NamedTuple):
    """The part of each direction that is searched for the minimum, as steps from where the sweep began.

    - `predicted`: the predicted step to the minimum.
    - `lowest`, `highest`: the ends of the interval as it was opened. `lower`, `upper`: the ends of the part that no
      slope has excluded. If every slope points beyond the interval, both are at that end.
    - `trial`, `last`: the steps of the next and of the last shot. `slope`, `rate`: the slope at `last`, and how fast it
      changes.
    """

    predicted: PerDirection
    lowest: PerDirection
    highest: PerDirection
    lower: PerDirection
    upper: PerDirection
    trial: PerDirection
    last: PerDirection
    slope: PerDirection
    rate: PerDirection

    @classmethod
    def around(
        cls, directions: Directions, half_width: PerDirection, furthest: PerDirection | Scalar
    ) -> "SearchIntervals":
        """Intervals around predicted steps, none further away than `furthest`. First trials are in the middle.

        Rates are 1, like the information.
        """
        below, above = jnp.minimum(directions.below, furthest), jnp.minimum(directions.above, furthest)
        predicted = jnp.clip(jnp.nan_to_num(directions.predicted), -below, above)
        lowest, highest = jnp.maximum(predicted - half_width, -below), jnp.minimum(predicted + half_width, above)
        middle, zero = (lowest + highest) / 2, jnp.zeros_like(lowest)
        return cls(predicted, lowest, highest, lowest, highest, middle, middle, zero, jnp.ones_like(lowest))

    def narrowed(self, slope: PerDirection) -> "SearchIntervals":
        """The intervals after a shot at their trials: **the sign of the slope decides**, the secant proposes.

        The next trial is where a line through the last two slopes is zero. If this point lies outside of the interval,
        the next trial is the nearest end, or the middle if a shot has moved that end.
        """
        lower = jnp.where(slope <= 0, self.trial, self.lower)
        upper = jnp.where(slope >= 0, self.trial, self.upper)
        # After the first shot this is not finite, so the rate stays 1.
        secant = (slope - self.slope) / (self.trial - self.last)
        rate = jnp.where((secant > 0) & jnp.isfinite(secant), secant, self.rate)
        zero = self.trial - slope / rate
        outside = ((zero <= lower) & (lower > self.lowest)) | ((zero >= upper) & (upper < self.highest))
        following = jnp.where(outside, (lower + upper) / 2, jnp.clip(zero, lower, upper))
        return self._replace(lower=lower, upper=upper, trial=following, last=self.trial, slope=slope, rate=rate)


# The shots of a sweep: the intervals after them, unknowns and local model of the last one, their number, and whether
# the minimum is near.
Sweep = tuple[SearchIntervals, WindowUnknowns, LocalModel, Count, Flag]


class SearchState(NamedTuple):
    """The search of a stage before a sweep.

    - `unknowns`, `model`: the current point, and the local model of the cost there. Before the first shot, `model` is
      that of `before_shots`.
    - `directions`, `intervals`: of the next sweep.
    - `spread`: the covariance of the unknowns before the stage.
    - `growth`: the factor by which each direction's interval is widened.
    - `trust`: a sweep may go at most this share of the longest predicted step; 1: no limit.
    - `sweeps`, `shots`: their number in this stage. The first shot is at the start, before any sweep.
    - `done`: whether the stage ended by itself.
    """

    unknowns: WindowUnknowns
    model: LocalModel
    directions: Directions
    intervals: SearchIntervals
    spread: Float[Array, "windows unknowns unknowns"]
    growth: PerDirection
    trust: Scalar
    sweeps: Count
    shots: Count
    done: Flag


class IBSS(AbstractSolver[SearchState]):
    """Iterative Bi-Section Shooting.

    A *shot* evaluates the likelihood at trial unknowns: the cost with its gradient and information. **The sign of
    the cost's slope along a direction decides** which side of the trial holds the minimum, and so which part of the
    search interval is dropped. The quadratic model and the secant through the last slopes **propose** where to shoot.
    The size of the slopes decides when to stop, and the cost whether a point is kept. A *sweep* is one iteration. A
    *stage* repeats sweeps on some of the data until the minimum is near; the last stage fits all data. The directions
    of a sweep are the columns of L^-T, with L L^T the Fisher information at the current estimate. The cost is nearly
    separable along them, so a sweep bisects all directions in parallel. Parameters are bisected on the sum of all
    windows' slopes, initial states on the slope of their window.

    - `halvings`: the shots of a sweep that narrow the intervals. One more shot is at the trials that these found.
    - `max_sweeps`: the most sweeps of a stage.
    - `tolerance`: the search ends once the minimum is at most this many standard deviations away along each
      direction. The `misfit` of the residuals scales them, so noise-free data are fitted to rounding errors.
    - `reach`: the search does not go further than this many half-widths from the bracket's center.
    - `shares`: before the fit of all data, the body rates are fitted to these shares of the flight, because errors grow
      with time and give the cost of a long flight other minima.
    """

    halvings: int = eqx.field(static=True, converter=integer("halvings", 2, static=True), default=2)
    max_sweeps: Count = eqx.field(converter=integer("max_sweeps", 1), default=60)
    tolerance: Scalar = eqx.field(converter=setting("tolerance", positive=True), default=0.005)
    reach: Scalar = eqx.field(converter=setting("reach", positive=True), default=REACH)
    shares: tuple[float, ...] = eqx.field(static=True, default=(0.1, 0.3, 1.0))

    def init(self, stage: Stage, before: Found) -> SearchState:
        """The start, with intervals of width 0: the first step shoots there, so that the shot is compiled once."""
        unknowns, nothing = before.unknowns, jnp.zeros_like(before.unknowns)
        directions = Directions.none(unknowns)
        return SearchState(
            unknowns=unknowns,
            model=before_shots(before.model),
            directions=directions,
            intervals=SearchIntervals.around(directions, nothing, nothing),
            spread=before.spread,
            growth=jnp.ones_like(unknowns),
            trust=jnp.ones((), dtype=float),
            sweeps=jnp.zeros((), dtype=int),
            shots=jnp.zeros((), dtype=int),
            done=jnp.zeros((), dtype=bool),
        )

    def step(self, stage: Stage, state: SearchState) -> SearchState:
        """The shot at the start, or one sweep, see docs/method/ibss.md.

        A sweep bisects, keeps its last point unless the cost rises by more than `_KEPT_RISE`, looks for directions and
        slopes there, and opens new intervals around the steps that they predict.
        """
        is_start = state.shots == 0
        # One shot is enough if all intervals have a width of 0.
        most = jnp.where((state.intervals.highest > state.intervals.lowest).any(), self.halvings + 1, 1)
        intervals, unknowns, model, shots, _ = jax.lax.while_loop(
            lambda carry: (carry[3] < most) & ~carry[4],
            functools.partial(self._shoot, stage, state),
            (state.intervals, state.unknowns, state.model, jnp.zeros((), dtype=int), jnp.zeros((), dtype=bool)),
        )
        kept, stalled = self._judge(stage, state, unknowns, model)
        unknowns, model = chosen(kept, (unknowns, model), (state.unknowns, state.model))
        directions = Directions.at(stage, unknowns, model, self.reach)
        share, growth = self._next_widths(stage, state, intervals)
        trust = jnp.where(kept, jnp.minimum(state.trust * _ADVANCE, 1.0), state.trust * _RETREAT)
        later = jnp.maximum(share * directions.longest, stage.smallest_step) * growth
        restricted = jnp.where(trust < 1, trust * directions.longest, jnp.inf)
        opening = _OPENING * directions.sizes(state.spread)
        half_width = jnp.where(is_start, _NARROW * opening, later)
        furthest = jnp.where(is_start, opening, restricted)
        near = self._is_near(stage, model, directions.predicted)
        return SearchState(
            unknowns=unknowns,
            model=model,
            directions=directions,
            intervals=SearchIntervals.around(directions, half_width, furthest),
            spread=state.spread,
            growth=growth,
            trust=trust,
            sweeps=state.sweeps + ~is_start,
            shots=state.shots + shots,
            done=near | stalled | (is_start & ~kept),
        )

    def terminate(self, stage: Stage, state: SearchState) -> Flag:
        """Whether the minimum is near, or the search cannot go on."""
        return state.done | (state.sweeps >= self.max_sweeps)

    def postprocess(self, stage: Stage, state: SearchState, before: Found) -> Found:
        """The last point that was kept."""
        misfit = jnp.maximum(stage.misfit(state.model.cost.sum()), 1.0)
        covariance = jnp.square(misfit) * gram(state.directions.basis)
        known = stage.searched & stage.searched[:, None] & _finite(state.unknowns, state.model)
        spread = jnp.where(known, covariance, before.spread)
        rollouts = state.shots * stage.searched.sum()
        return Found(state.unknowns, state.model, spread, state.sweeps, rollouts, state.done)

    def _shoot(self, stage: Stage, state: SearchState, before: Sweep) -> Sweep:
        """Shoot at the trials of all intervals at once, and drop the side that the sign of each slope excludes."""
        intervals, _, _, shots, _ = before
        step = jnp.einsum("wud,wd->wu", state.directions.basis, intervals.trial)
        unknowns = jnp.clip(state.unknowns + step, *stage.limits(self.reach))
        model = stage.local_model(unknowns)
        slope = state.directions.slopes(model.gradient, stage.unknowns.count)
        near = model.feasible.all() & self._is_near(stage, model, slope)
        # A slope that is not finite is replaced by the trial: with unit information, the minimum is then at step 0.
        intervals = intervals.narrowed(jnp.where(jnp.isfinite(slope), slope, intervals.trial))
        return intervals, unknowns, model, shots + 1, near

    def _judge(
        self, stage: Stage, state: SearchState, unknowns: WindowUnknowns, model: LocalModel
    ) -> tuple[Flag, Flag]:
        """Whether the new point is kept, and whether the search has stalled. A clearly worse point is not kept."""
        before, gain = state.model, state.model.cost.sum() - model.cost.sum()
        feasible, was_feasible = model.feasible.all(), before.feasible.all()
        has_stride = jnp.isfinite(stage.unknowns.stride).any()
        is_short = has_stride & (state.directions.longest <= _SHORT_STEP)
        stalled = (gain <= _SMALL_GAIN) & feasible & was_feasible & is_short
        # The cost of a trajectory that is not feasible is meaningless.
        not_worse = feasible & (model.cost.sum() <= before.cost.sum() + _KEPT_RISE)
        bad = ~_finite(unknowns, model) | (was_feasible & ~not_worse)
        return ~(bad | (stalled & (gain < 0))), stalled

    def _is_near(self, stage: Stage, model: LocalModel, steps: PerDirection) -> Flag:
        """Whether steps, or slopes in the same units, are short enough to end the stage. The last ends finely."""
        misfit = stage.misfit(model.cost.sum())
        fine = jnp.maximum(self.tolerance * misfit, stage.smallest_step)
        return jnp.abs(steps).max() <= jnp.where(stage.last, fine, _COARSE * jnp.maximum(misfit, 1.0))

    def _next_widths(self, stage: Stage, state: SearchState, intervals: SearchIntervals) -> tuple[Scalar, PerDirection]:
        """The half-width of the next intervals as a share of the longest step, from its error; and their `growth`."""
        steps = intervals.last
        error = jnp.abs(steps - intervals.predicted).max()
        longest = jnp.maximum(jnp.abs(steps).max(), stage.smallest_step)
        at_end = (steps == intervals.lowest) | (steps == intervals.highest)
        was_open = intervals.highest > intervals.lowest
        growth = jnp.where(at_end, jnp.minimum(_WIDENING * state.growth, _MAX_WIDENING), 1.0)
        return jnp.clip(_SAFETY * error / longest, _MIN_WIDTH, 1.0), jnp.where(was_open, growth, state.growth)


def _finite(unknowns: WindowUnknowns, model: LocalModel) -> Flag:
    numbers = (unknowns, model.cost, model.gradient, model.information)
    return jnp.stack([jnp.isfinite(each).all() for each in numbers]).all()
