"""The search for the best input within an envelope, by a quadratic penalty.

A stage minimises criterion + penalty by BFGS. The penalty grows from stage to stage, so that the limits hold better and
better. They hold exactly only after the caller has measured how much of them is used, and has reduced the amplitude.

Reference: Nocedal and Wright, Numerical Optimization, ch. 6 (BFGS) and 17 (penalty).
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Scalar
from .envelope import Uses

Coefficients = Float[Array, " coefficients"]

# The penalty of each stage.
PENALTIES = (10.0, 50.0, 250.0, 1250.0, 6000.0)
_TRIALS = 40
# No step changes the coefficients by more than this. A step is shortened by this factor until it helps.
_LONGEST, _SHORTER = 1.0, 0.3
# Below this step the approximation of the second derivative is given up.
_SHORTEST = 1e-5
# The least gain of a step, as a share of what its slope promises.
_GAIN = 1e-4


class AbstractTask(eqx.Module):
    """An input to be designed."""

    @abc.abstractmethod
    def criterion(self, coefficients: Coefficients) -> Scalar:
        """What is to be small."""

    @abc.abstractmethod
    def uses(self, coefficients: Coefficients) -> Uses:
        """The shares of the limits at each sample, which are to be at most 1."""


class Climb(NamedTuple):
    """Where a search is.

    - `at`: the coefficients, with the cost and its gradient there.
    - `inverse`: the approximate inverse of the cost's second derivative.
    - `direction`, `step`: the next trial is at + step x direction.
    """

    at: Coefficients
    cost: Scalar
    gradient: Coefficients
    inverse: Float[Array, "coefficients coefficients"]
    direction: Coefficients
    step: Scalar


@jax.jit
def begin(coefficients: Float[Array, "starts coefficients"]) -> Climb:
    """A batch of searches that have not moved."""
    starts, size = coefficients.shape
    zero, one = jnp.zeros_like(coefficients), jnp.ones(starts, dtype=float)
    return Climb(coefficients, one, zero, jnp.tile(jnp.eye(size, dtype=float), (starts, 1, 1)), zero, one)


@eqx.filter_jit
def minimise(task: AbstractTask, searches: Climb, penalty: Scalar) -> Climb:
    """The next stage of a batch of searches."""
    return jax.vmap(lambda search: _minimise(task, search, penalty))(searches)


def _minimise(task: AbstractTask, search: Climb, penalty: Scalar) -> Climb:
    def cost(coefficients: Coefficients) -> Scalar:
        uses = jax.tree.leaves(task.uses(coefficients))
        excess = sum(jnp.square(jnp.maximum(jnp.square(use) - 1, 0)).sum() / use.shape[0] for use in uses)
        return task.criterion(coefficients) + penalty / 2 * excess

    def move(search: Climb, _: None) -> tuple[Climb, None]:
        trial = search.at + search.step * search.direction
        value, gradient = jax.value_and_grad(cost)(trial)
        promised = search.step * (search.gradient @ search.direction)
        usable = jnp.isfinite(value) & jnp.isfinite(gradient).all()
        better = usable & (value <= search.cost + _GAIN * promised)
        change = jnp.where(better & jnp.isfinite(search.cost), gradient - search.gradient, 0.0)
        inverse = _updated(search.inverse, trial - search.at, change)
        at, value, gradient = jax.tree.map(
            lambda new, old: jnp.where(better, new, old),
            (trial, value, gradient),
            (search.at, search.cost, search.gradient),
        )
        lost = search.step < _SHORTEST
        inverse = jnp.where(lost, jnp.eye(at.shape[0], dtype=float), inverse)
        downhill = -(inverse @ gradient)
        longest = jnp.minimum(1.0, _LONGEST / jnp.sqrt(jnp.square(downhill).sum() + 1e-12))
        direction = jnp.where(better | lost, downhill, search.direction)
        step = jnp.where(better | lost, longest, _SHORTER * search.step)
        return Climb(at, value, gradient, inverse, direction, step), None

    # The first trial is where the last stage ended: the cost there has changed.
    nothing = jnp.zeros_like(search.at)
    first = search._replace(cost=jnp.full_like(search.cost, jnp.inf), gradient=nothing, direction=nothing)
    return jax.lax.scan(move, first, length=_TRIALS)[0]


def _updated(inverse: Float[Array, "n n"], step: Float[Array, " n"], change: Float[Array, " n"]) -> Float[Array, "n n"]:
    """The update of BFGS with a change of the gradient. No update if the curvature is not positive."""
    curvature = step @ change
    usable = curvature > 1e-10 * jnp.sqrt((step @ step) * (change @ change))
    share = jnp.where(usable, 1 / jnp.where(usable, curvature, 1.0), 0.0)
    image = inverse @ change
    outer = jnp.outer(step, image)
    return inverse - share * (outer + outer.T) + share * (1 + share * (change @ image)) * jnp.outer(step, step)
