"""Output error: nonlinear least squares of the simulated against the measured trajectory.

This is the prediction-error method for a model without process noise; for white measurement noise it is maximum
likelihood.

References: Ljung, System Identification, ch. 7; Jategaonkar, Flight Vehicle System Identification, ch. 4.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._custom_types import Count, Scalar, as_float, as_int
from .._xla import quick_jit
from ..bracket import NO_PRIOR, Bracket
from ..estimate import REACH, AbstractEstimator, Estimate, as_estimate, check_dynamic_count, check_positive
from ..linalg import covariance_of_shared
from ..shooting import ShootingProblem, in_blocks
from .newton import newton

_FIRST_DAMPING = 1.0  # in units of the bracket: it hardly changes the first step of a flight with information
_COARSE = 1e-3  # tolerance of the problems before the last


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
    needs_network: ClassVar[bool] = False

    tolerance: Scalar = eqx.field(converter=as_float, default=1e-5)
    max_steps: Count = eqx.field(converter=as_int, default=100)

    def __check_init__(self):
        check_positive("tolerance", self.tolerance)
        check_dynamic_count("max_steps", self.max_steps, 1)

    @quick_jit
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
            search = newton(
                stage, reach=REACH, damping=_FIRST_DAMPING, scale=scale[:, :own], tolerance=tolerance
            ).minimum(unknowns[:, :own], self.max_steps)
            unknowns = unknowns.at[:, :own].set(search.best)
            searches.append(search)
            steps = steps + search.steps
            rollouts = rollouts + (search.steps + 1) * (1 + count + problem.windows * stage.free_size)
        curvature = searches[-1].curvature
        return as_estimate(
            problem,
            parameters=unknowns[0, :count],
            covariance=covariance_of_shared(curvature.information, count),
            initial_state=unknowns[:, count:].ravel() if problem.free_size else first,
            cost=curvature.shot.cost.sum(),
            rollouts=rollouts,
            sweeps=steps,
            sound=curvature.shot.sound.all(),
            done=searches[-1].done,
        )
