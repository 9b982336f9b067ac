"""The parts of IBSS: a stage, the directions of a sweep, and the brackets along them.

All steps are in standard deviations. The unknowns of a window are the shared ones, then its own initial state.
Its directions are those of the initial state, then the shared ones, which carry the initial state to where it fits.
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

_STRIDE_INFORMATION = 0.1  # in units of 1/stride^2: along a stride the information misjudges the curvature


class Stage(NamedTuple):
    """A stage of a problem, see `Stages`.

    - `evaluate`, `misfit`, `searched`, `smallest_step`: those of `Stages` for this stage. `limits`: of all unknowns.
    - `added_information`: of directions, not of the cost: for unknowns without a prior, and to keep strides short.
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
    - `moves`: the unknowns that move: not those at a limit, beyond which the cost falls.
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
      has excluded; both at one opened end if the minimum lies beyond it.
    - `trial`, `last`: the steps of the next and of the last shot. `slope`, `rate`: the slope there, and its change.
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
        """Brackets around predicted steps. The first trials are their middles, the rates those of unit information."""
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
        secant = (slope - self.slope) / (self.trial - self.last)
        rate = jnp.where((secant > 0) & jnp.isfinite(secant), secant, self.rate)
        zero = self.trial - slope / rate
        outside = ((zero <= lower) & (lower > self.lowest)) | ((zero >= upper) & (upper < self.highest))
        following = jnp.where(outside, (lower + upper) / 2, jnp.clip(zero, lower, upper))
        return self._replace(lower=lower, upper=upper, trial=following, last=self.trial, slope=slope, rate=rate)


def prior_std(problem: AbstractProblem) -> WindowUnknowns:
    """Standard deviation of each unknown without the flight: half of how far off the unknown may be."""
    return problem.join(problem.unknowns.usable.half_width, problem.first_state()[1]) / 2
