"""The parts of IBSS: a stage, the directions of a sweep, and the brackets along them.

All steps are in standard deviations. The unknowns of a window are the shared ones, then its own initial state.
The directions of its initial state come first. Along each shared direction, the initial states move too, to where they
fit best.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._custom_types import Count, Scalar
from ..shooting import AbstractProblem, Curvature, Stages
from ..shooting.abstract import WindowUnknowns

Flag = Bool[Array, ""]
PerDirection = Float[Array, "windows n"]

# Added information, in units of 1/stride^2: that of unknowns with a stride misjudges the curvature.
_STRIDE_INFORMATION = 0.1


class Stage(NamedTuple):
    """A stage of a problem, see `Stages`.

    - `evaluate`, `misfit`, `searched`, `smallest_step`: those of `Stages` for this stage. `limits`: of all unknowns.
    - `added_information`: added before directions are chosen; the cost does not contain it. For an unknown without a
      prior it is that of the bracket; for any other it keeps steps within the stride.
    """

    problem: AbstractProblem
    last: Flag
    evaluate: Callable[[WindowUnknowns], Curvature]
    misfit: Callable[[Scalar], Scalar]
    searched: Bool[Array, " unknowns"]
    smallest_step: Scalar
    added_information: Float[Array, "windows unknowns unknowns"]
    limits: tuple[WindowUnknowns, WindowUnknowns]

    @classmethod
    def of(cls, problem: AbstractProblem, stages: Stages, number: Count, reach: Scalar) -> "Stage":
        """The stage of this number, whose search goes at most `reach` half-widths from the bracket's center."""
        unknowns, prior = problem.unknowns, 1 / jnp.square(prior_std(problem))
        of_stride = _STRIDE_INFORMATION / jnp.square(unknowns.stride)
        shared = jnp.where(unknowns.precision > 0, of_stride, prior[:, : unknowns.count] / problem.windows)
        return cls(
            problem=problem,
            last=number == stages.number - 1,
            evaluate=functools.partial(stages.evaluate, number),
            misfit=functools.partial(stages.misfit, number),
            searched=stages.searched[number],
            smallest_step=stages.smallest_step[number],
            added_information=prior.at[:, : unknowns.count].set(shared)[:, :, None] * np.eye(prior.shape[1]),
            limits=problem.limits(reach),
        )


class Directions(NamedTuple):
    """The directions of a sweep, and the room along them from where it begins.

    - `factor`, `basis`: see `JointFactor`. A direction is a column of `basis`.
    - `moves`: the unknowns that may move: all but those at a limit beyond which the cost falls.
    - `below`, `above`: the way to the limits, against and along each direction.
    """

    factor: Float[Array, "windows unknowns n"]
    basis: Float[Array, "windows unknowns n"]
    moves: Bool[Array, "windows unknowns"]
    below: PerDirection
    above: PerDirection


class Brackets(NamedTuple):
    """The bracket along each direction, as steps from where the sweep began.

    - `predicted`: the predicted step to the minimum.
    - `lowest`, `highest`: the ends of the bracket as it was opened. `lower`, `upper`: those of the part that no slope
      has excluded. If the minimum lies beyond an opened end, both are at that end.
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
    def around(cls, predicted: PerDirection, half_width: PerDirection, below: PerDirection, above: PerDirection):
        """Brackets around predicted steps. The first trials are their middles; the rates are 1, as the information."""
        predicted = jnp.clip(jnp.nan_to_num(predicted), -below, above)
        lowest, highest = jnp.maximum(predicted - half_width, -below), jnp.minimum(predicted + half_width, above)
        middle, zero = (lowest + highest) / 2, jnp.zeros_like(lowest)
        return cls(predicted, lowest, highest, lowest, highest, middle, middle, zero, jnp.ones_like(lowest))

    def narrowed(self, slope: PerDirection) -> "Brackets":
        """The brackets after a shot at their trials: **the sign of the slope decides**, the secant proposes.

        The next trial is where a line through the last two slopes is zero. If that lies outside of the bracket, it is
        the end there, or the middle if a shot has moved that end.
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


def prior_std(problem: AbstractProblem) -> WindowUnknowns:
    """Standard deviation of each unknown before the flight is seen: half of how far off it may be."""
    return problem.join(problem.unknowns.usable.half_width, problem.first_state()[1]) / 2
