"""What every estimator returns, and what makes it one."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._custom_types import Parameters, Scalar
from ..bracket import Bracket
from ..results import RESULTS
from ..shooting import ShootingProblem


class Estimate(eqx.Module):
    """Parameters with their uncertainty, and how they were found.

    - `parameters`: the estimate; where `result` says that there is none, the bracket's center, or 0 without one.
    - `covariance`: of `parameters`, from the Fisher information at the estimate and the problem's `sigma`.
    - `initial_state`: the estimated, or known, state at the first sample, in cascade order.
    - `cost`: 1/2 |W (y - x)|^2 there.
    - `rollouts`: simulated flights that it took, whatever their channels; a tangent carried along counts as one.
    - `sweeps`: iterations over all directions, summed over the stages.
    - `result`: how it ended.
    """

    parameters: Parameters
    covariance: Float[Array, "parameters parameters"]
    initial_state: Float[Array, " size"]
    cost: Scalar
    rollouts: Int[Array, ""]
    sweeps: Int[Array, ""]
    result: RESULTS

    @property
    def std(self) -> Float[Array, "*batch parameters"]:
        """Standard deviation of each parameter, of one estimate or of a batch of them."""
        return jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))


class AbstractEstimator(eqx.Module):
    """An algorithm that identifies parameters; its fields are its settings."""

    @abc.abstractmethod
    def __call__(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        """Identifies one flight. Batches are made by `eqx.filter_vmap`; a failing lane leaves the others alone."""
