"""Equation error: the parameters for which the measured rates satisfy the rate equations best, by least squares."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from .._custom_types import Parameters, Scalar, as_float
from ..bracket import NO_PRIOR, Bracket
from ..estimate import AbstractEstimator, Estimate, check_bracket
from ..shooting import ShootingProblem
from ._regression import (
    Regression,
    answer,
    check_bridge,
    check_share,
    covariance_of,
    normal_equations,
    parameters_of,
    propagated_covariance,
    regression,
    solve,
)


class EquationError(AbstractEstimator):
    """Least squares of differentiated body rates on the regressors of the rate equations, in one step.

    The regressors are the derivatives of the rate equations with respect to the parameters, at the measured rates. The
    rate equations of the model must be linear in its parameters. Only the body rates are used, but the estimate's cost
    counts all of the problem's channels. There is no iteration; one simulated flight gives the cost, and a free initial
    state is then fitted to the parameters.

    **Arguments:**

    - `memory`: how the rates are differentiated, from 0 to 1. A weighted mean of the earlier samples is
      subtracted. In this mean, each sample has `memory` times the weight of the next one. 0 gives plain forward
      differences (ordinary least squares). 1 gives the integrated regression, which is generalised least squares for
      white noise of the rates. The default of 1 has the
      smallest errors of all values on the standard flight.
    - `bridge`: a gap of up to this many samples in a rate is bridged by a straight line in the regressors. A longer gap
      splits the integration in two.

    A known initial state is exact for a `memory` of 1, and one more sample for a smaller one. Without noise the answer
    is exact for flights simulated by forward Euler. For another `method` the trapezoidal rule leaves errors of a tenth
    of the Cramer-Rao bound on the standard flight.

    The covariance contains the white noise of the problem's `sigma` in regressors and outputs, to first order. It does
    not contain the bias, nor forces that the model lacks. If a rate was never measured, its parameters stay at the
    bracket's center with a huge variance, and the result is `unidentifiable`.

    References: Klein and Morelli, Aircraft System Identification, ch. 5; Jategaonkar, Flight Vehicle System
    Identification, ch. 6; Ljung, System Identification, section 7.3.
    """

    looks_at: ClassVar[str] = "rates"
    shoots: ClassVar[bool] = False
    prior: ClassVar[float] = NO_PRIOR
    needs_network: ClassVar[bool] = False

    memory: Scalar = eqx.field(converter=as_float, default=1.0)
    bridge: int = eqx.field(static=True, default=4)

    def __check_init__(self):
        check_share("memory", self.memory, open_below=False)
        check_bridge(self.bridge)

    @eqx.filter_jit
    def __call__(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        """Identifies one flight.

        **Raises:** `ValueError` for a bracket of another length than the model's parameters, or a model that is not
        linear in them.
        """
        data, steps, inverse = self._solved(problem, bracket)
        usable = bracket.usable
        parameters = parameters_of(usable, steps)
        covariance = covariance_of(usable, propagated_covariance(data, steps, inverse))
        return answer(problem, bracket, parameters, covariance)

    @eqx.filter_jit
    def solution(self, problem: ShootingProblem, bracket: Bracket) -> Parameters:
        """The least-squares solution alone, without its covariance and without a simulation.

        **Raises:** as a call does.
        """
        return parameters_of(bracket.usable, self._solved(problem, bracket)[1])

    def _solved(
        self, problem: ShootingProblem, bracket: Bracket
    ) -> tuple[Regression, Parameters, Float[Array, "parameters parameters"]]:
        check_bracket(problem, bracket)
        data = regression(problem, bracket.usable, memory=self.memory, forgetting=1.0, bridge=self.bridge)
        return data, *solve(*normal_equations(data.rows(data.rates)))
