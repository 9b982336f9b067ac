"""Filter error: maximum likelihood with disturbances that the model does not contain, by Newton's method.

The likelihood is that of `InnovationsProblem`; any search of the package can minimise it.

References: Jategaonkar, Flight Vehicle System Identification, ch. 5; Ljung, System Identification, ch. 7 and 13.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Count, Scalar, as_float, as_int
from .._xla import quick_jit
from ..bracket import GAUSSIAN_PRIOR, Bracket
from ..estimate import (
    REACH,
    AbstractEstimator,
    Estimate,
    as_estimate,
    check_dynamic_count,
    check_positive,
    fit_start,
    from_starts,
)
from ..linalg import covariance_of_shared
from ..results import RESULTS
from ..shooting import InnovationsProblem, ShootingProblem
from .newton import newton

# Of the first step and of any other, in standard deviations.
_FIRST_DAMPING, _LEAST_DAMPING = 1e-2, 1e-4


class FilterError(AbstractEstimator):
    """Maximum likelihood of the innovations of Kalman filters, by Gauss-Newton steps from the bracket's center.

    It compares the body rates, and specific force if the model predicts it. The disturbance and the sensor's noise of
    each channel are estimated too, see `InnovationsProblem`. The bracket is a Gaussian prior, whose standard deviation
    is the bracket's half-width.

    **Arguments:**

    - `tolerance`: the search ends with a step that promises to lower the cost by less. An error of one standard
      deviation costs 0.5. A promise of the noise levels counts a tenth.
    - `max_steps`: of the search from one time constant of the disturbance.
    """

    looks_at: ClassVar[str] = "rates"
    shoots: ClassVar[bool] = False
    prior: ClassVar[float] = GAUSSIAN_PRIOR
    needs_network: ClassVar[bool] = False
    in_closed_loop: ClassVar[bool] = True

    tolerance: Scalar = eqx.field(converter=as_float, default=3e-3)
    max_steps: Count = eqx.field(converter=as_int, default=200)

    def __check_init__(self):
        check_positive("tolerance", self.tolerance)
        check_dynamic_count("max_steps", self.max_steps, 1)

    @quick_jit
    def __call__(self, problem: ShootingProblem | InnovationsProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight.

        The estimate of a shooting problem has the model's parameters alone, and the cost of a simulation, as that of
        any other estimator. The estimate of a problem of innovations has all its unknowns and the cost of these.

        **Raises:** `ValueError` for a bracket of another length than the model's parameters.
        """
        problem = problem.within(bracket)
        if isinstance(problem, InnovationsProblem):
            return self._search(problem)
        found, count = self._search(InnovationsProblem(problem)), problem.unknowns.count
        parameters = found.parameters[:count]
        first, cost, sound, rollouts = fit_start(problem, parameters)
        return as_estimate(
            problem,
            parameters=parameters,
            covariance=found.covariance[:count, :count],
            initial_state=first,
            cost=cost,
            rollouts=rollouts + found.rollouts,
            sweeps=found.sweeps,
            sound=sound & jnp.isfinite(found.cost),
            done=found.result != RESULTS.max_sweeps,
            prior=GAUSSIAN_PRIOR,
        )

    def _search(self, problem: InnovationsProblem) -> Estimate:
        """The estimate of all unknowns of the innovations."""

        def search(first: Float[Array, " unknowns"]) -> Estimate:
            method = newton(
                problem, reach=REACH, damping=_FIRST_DAMPING, least_damping=_LEAST_DAMPING, gain=self.tolerance
            )
            found = method.minimum(first[None], self.max_steps)
            return as_estimate(
                problem,
                parameters=found.best[0],
                covariance=covariance_of_shared(found.curvature.information, first.shape[0]),
                initial_state=problem.first_state()[0],
                cost=found.curvature.shot.cost.sum(),
                rollouts=(found.steps + 1) * (1 + first.shape[0]),
                sweeps=found.steps,
                sound=found.curvature.shot.sound.all(),
                done=found.done,
                parts=found.curvature.parts,
            )

        return from_starts(problem, None, search)
