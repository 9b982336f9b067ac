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

    The regressors are the derivatives of the rate equations with respect to the parameters at the measured rates, so
    that any model with rate equations linear in its parameters will do. Only rates are looked at, whatever the
    problem's channels; all of these count in the estimate's cost. No iteration, no start, and one simulated flight,
    for the cost; where the initial state is free, two steps of Gauss-Newton find it to the parameters found.

    **Arguments:**

    - `memory`: how rates are differentiated: by subtracting the mean of the samples before, in which each weighs
      `memory` times its successor. 0: the sample before alone, so plain forward differences (ordinary least squares).
      1: all of them alike, which is the integrated regression, and generalised least squares of the differences for
      white noise of the rates. A known initial state is exact for 1, and one more sample below.
    - `bridge`: gaps of up to this many samples in a rate are crossed by a straight line where it is a regressor. As an
      output it has no weight there; a longer gap parts the integration in two.

    The default of `memory` is measured: on the standard flight, initial state known, 64 flights (Monte-Carlo error
    9 %), root mean square error in units of the Cramer-Rao bound of the rates, alpha1 to alpha8:

        memory 0        5.1  11.7  2.0   4.7  4.1  2.1   5.6  2.3     (noise of ten times that: 18  35  2.6  15 ...)
        memory 0.9      3.0   8.0  1.2   3.1  3.4  1.2   3.7  1.3
        memory 0.99     1.6   4.0  1.0   1.2  2.6  1.0   2.0  0.9
        memory 1        1.05  1.6  1.0   1.0  1.5  0.9   1.0  0.9     (the same at a tenth and ten times the noise)

    Smoothing first (Savitzky-Golay, cubic, the same filter on both sides) left plain differences above 4 times the
    bound in alpha1, 2, 4, 5 and 7, and the integrated form where it was up to 11 samples; longer windows biased it.
    Errors in variables, the noise that the regressors carry, swamp plain differences at ten times the noise. The
    integral averages them down and leaves a random walk: that is what alpha2 and alpha5 lose here, and what makes a
    `memory` of 0.995 better on flights of a minute with a free start (standard deviation of alpha5 1.6 times smaller).
    No bias of `memory` 1 was found on this flight up to ten times the noise: it is below 0.3 of the bound.

    Without noise the answer is exact where `method` is `"euler"` and the flight was. For another method the integral
    over a sample is taken by the trapezoidal rule: errors of a tenth of the bound on the standard flight. A bridged
    gap is such an error as well, one that less noise does not lessen.

    The covariance carries the white noise of the problem's `sigma` through regressors and outputs, to first order; it
    does not hold the bias, or forces that the model lacks. A parameter of which the rates tell nothing (a rate was
    never measured) stays at the bracket's center with a variance that is huge, and the result is `unidentifiable`.

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
        """The least-squares solution alone: no errors, and no look at how the flight goes with it.

        **Raises:** as a call does.
        """
        return parameters_of(bracket.usable, self._solved(problem, bracket)[1])

    def _solved(
        self, problem: ShootingProblem, bracket: Bracket
    ) -> tuple[Regression, Parameters, Float[Array, "parameters parameters"]]:
        check_bracket(problem, bracket)
        data = regression(problem, bracket.usable, memory=self.memory, forgetting=1.0, bridge=self.bridge)
        return data, *solve(*normal_equations(data.rows(data.rates)))
