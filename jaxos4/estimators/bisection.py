"""The parts of IBSS: the directions of a sweep, and the brackets along them.

All steps are in standard deviations. The unknowns of a window are the shared ones, then the window's initial state. The
directions of the initial state come first. Along each shared direction, the initial states move too, to where they fit
best.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._custom_types import Scalar
from ..linalg import joint_factor, movable, room_to_limits, slopes_along
from ..shooting import LocalModel, WindowUnknowns

Flag = Bool[Array, ""]
PerDirection = Float[Array, "windows n"]


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
    def at(
        cls,
        unknowns: WindowUnknowns,
        model: LocalModel,
        limits: tuple[WindowUnknowns, WindowUnknowns],
        added: WindowUnknowns,
        count: int,
    ) -> "Directions":
        """The directions at some unknowns, of which `count` are shared. `added`: information added to the cost's."""
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
    """The bracket along each direction, as steps from where the sweep began.

    - `predicted`: the predicted step to the minimum.
    - `lowest`, `highest`: the ends of the bracket as it was opened. `lower`, `upper`: the ends of the part that no
      slope has excluded. If every slope points beyond the bracket, both are at that end.
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
        """Intervals around predicted steps. First trials are in the middle; rates are 1, like the information."""
        predicted = jnp.clip(jnp.nan_to_num(predicted), -below, above)
        lowest, highest = jnp.maximum(predicted - half_width, -below), jnp.minimum(predicted + half_width, above)
        middle, zero = (lowest + highest) / 2, jnp.zeros_like(lowest)
        return cls(predicted, lowest, highest, lowest, highest, middle, middle, zero, jnp.ones_like(lowest))

    def narrowed(self, slope: PerDirection) -> "SearchIntervals":
        """The brackets after a shot at their trials: **the sign of the slope decides**, the secant proposes.

        The next trial is where a line through the last two slopes is zero. If this point lies outside of the bracket,
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
