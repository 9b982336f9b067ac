"""What every estimator returns, and what makes it one."""

import abc
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._custom_types import Parameters, Scalar
from ..bracket import Bracket
from ..results import RESULTS
from ..shooting import ShootingProblem


class Calibration(eqx.Module):
    """How many standard deviations an interval needs to hold the truth as often as its level says.

    - `levels`: rising, between 0 and 1.
    - `factors`: for each level and parameter, the half-width in standard deviations.
    """

    levels: Float[Array, " levels"]
    factors: Float[Array, "levels parameters"]


class Estimate(eqx.Module):
    """Parameters with their uncertainty, and how they were found.

    - `parameters`: the estimate; where `result` says that there is none, the bracket's center, or 0 without one.
    - `covariance`: of `parameters`. Shooting takes it from the Fisher information at the estimate and the problem's
      `sigma`, a network from its errors on simulated flights.
    - `initial_state`: the estimated, or known, state at the first sample, in cascade order.
    - `cost`: 1/2 |W (y - x)|^2 there; NaN where the estimator does not simulate.
    - `rollouts`: simulated flights that it took, whatever their channels: one for a shot with its slope, one for each
      unknown of a Fisher information.
    - `sweeps`: iterations over all directions, summed over the stages.
    - `result`: how it ended.
    - `calibration`: of the intervals, where they were calibrated on simulated flights; `None`: Gaussian.
    - `seed`: the bracket that the search began from, where another estimator gave one.
    """

    parameters: Parameters
    covariance: Float[Array, "parameters parameters"]
    initial_state: Float[Array, " size"]
    cost: Scalar
    rollouts: Int[Array, ""]
    sweeps: Int[Array, ""]
    result: RESULTS
    calibration: Calibration | None = None
    seed: Bracket | None = None

    @property
    def std(self) -> Float[Array, "*batch parameters"]:
        """Standard deviation of each parameter, of one estimate or of a batch of them."""
        return jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))

    def half_width(self, level: float) -> Float[Array, "*batch parameters"]:
        """Half the width of an interval around each parameter that holds the truth in a share `level` of all flights.

        **Raises:** `ValueError` for a level that is not between 0 and 1, or beyond what was calibrated.
        """
        if not 0 < level < 1:
            raise ValueError(f"`level` must lie between 0 and 1, got {level}.")
        quantile = _deviations(jnp.asarray(level, dtype=float))
        if self.calibration is None:
            return quantile * self.std
        knots, factors = _deviations(self.calibration.levels), self.calibration.factors

        @functools.partial(jnp.vectorize, signature="(l),(l,p)->(p)")
        def at_level(knots, factors):
            return jax.vmap(lambda f: jnp.interp(quantile, knots, f), in_axes=1)(factors)

        return at_level(knots, factors) * self.std


def _deviations(level: Float[Array, "*levels"]) -> Float[Array, "*levels"]:
    """How many standard deviations to either side hold a share `level` of a Gaussian."""
    return jax.scipy.special.ndtri((1 + level) / 2)


class AbstractEstimator(eqx.Module):
    """An algorithm that identifies parameters; its fields are its settings."""

    @abc.abstractmethod
    def __call__(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        """Identifies one flight. Batches are made by `eqx.filter_vmap`; a failing lane leaves the others alone."""
