"""Output error and filter error: maximum likelihood by the steps of Levenberg-Marquardt.

Output error models sensor noise only, filter error disturbances too (`InnovationsProblem`).

References: Ljung, System Identification, ch. 7 and 13; Jategaonkar, Flight Vehicle System Identification, ch. 4 and 5.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax.core import Tracer

from .._custom_types import Count, Scalar, integer, setting
from ..batching import in_blocks
from ..bracket import GAUSSIAN_PRIOR, Bracket
from ..estimate import AbstractEstimator, Estimate, as_estimate, fit_start
from ..results import RESULTS
from ..shooting import AbstractProblem, InnovationsProblem, ShootingProblem
from .levenberg_marquardt import LevenbergMarquardt
from .solver import solve


class OutputError(AbstractEstimator):
    """Levenberg-Marquardt on the weighted residuals, from the bracket's center: first the rates, then all channels.

    - `tolerance`: the search ends with a step that moves no unknown by more than this share of its half-width.
    - `max_steps`: for each stage.
    - `long`: in a flight of this many samples or more, the rates are first fitted to its first 10 %. Errors grow with
      time, so a search on the whole flight from a wide bracket takes many short steps. Padding counts only if the
      problem's `length` is traced.
    """

    looks_at: ClassVar[str] = "all"
    shoots: ClassVar[bool] = True

    tolerance: Scalar = eqx.field(converter=setting("tolerance", positive=True), default=1e-5)
    max_steps: Count = eqx.field(converter=integer("max_steps", 1), default=100)
    long: int = eqx.field(converter=integer("long", 1, static=True), static=True, default=2000)

    def __call__(self, problem: ShootingProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight; `rollouts` counts shots and derivatives. Raises `ValueError` for a wrong bracket."""
        length = problem.length
        samples = problem.flight.time.size if length is None or isinstance(length, Tracer) else int(length)
        shares = (1.0,) if samples < self.long else (0.1, 1.0)
        solver = LevenbergMarquardt(step_tolerance=self.tolerance, max_steps=self.max_steps, shares=shares)
        return solver(problem, bracket)


class FilterError(AbstractEstimator):
    """Maximum likelihood of the innovations of Kalman filters, by damped Gauss-Newton steps from the bracket's center.

    It compares the body rates, and specific force if the model predicts it. The disturbance and the sensor noise of
    each channel are estimated too, see `InnovationsProblem`. The bracket is a Gaussian prior, whose standard deviation
    is the bracket's half-width.

    - `tolerance`: the search ends with a step that promises to lower the cost by less. An error of one standard
      deviation costs 0.5.
    - `max_steps`: the most steps of the search from one time constant of the disturbance.
    """

    looks_at: ClassVar[str] = "rates"
    shoots: ClassVar[bool] = False
    largest_std: ClassVar[float] = GAUSSIAN_PRIOR
    in_closed_loop: ClassVar[bool] = True

    tolerance: Scalar = eqx.field(converter=setting("tolerance", positive=True), default=3e-3)
    max_steps: Count = eqx.field(converter=integer("max_steps", 1), default=200)

    @property
    def solver(self) -> LevenbergMarquardt:
        """The solver. Its damping is relative, because the noise levels have no bracket."""
        return LevenbergMarquardt(
            step_tolerance=0.0,
            gain_tolerance=self.tolerance,
            flat=0.05,
            max_steps=self.max_steps,
            is_relative=True,
            damping=1e-2,
            least_damping=1e-4,
        )

    @eqx.filter_jit
    def __call__(self, problem: ShootingProblem | InnovationsProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight. Raises `ValueError` for a bracket of another length than the model's parameters.

        The estimate for a shooting problem has the model's parameters alone, and the cost of a simulation. The estimate
        for an `InnovationsProblem` has all unknowns, and their cost.
        """
        return in_blocks(self._identify, problem.within(bracket))

    def _identify(self, problem: AbstractProblem) -> Estimate:
        """One flight, or a block of flights."""
        if not isinstance(problem, ShootingProblem):
            return solve(self.solver, problem)
        found, count = solve(self.solver, InnovationsProblem(problem)), problem.unknowns.count
        parameters = found.parameters[:count]
        first, cost, feasible, rollouts = fit_start(problem, parameters)
        return as_estimate(
            problem,
            parameters=parameters,
            covariance=found.covariance[:count, :count],
            initial_state=first,
            cost=cost,
            rollouts=rollouts + found.rollouts,
            sweeps=found.sweeps,
            feasible=feasible & jnp.isfinite(found.cost),
            done=found.result != RESULTS.max_sweeps,
            largest_std=self.largest_std,
        )
