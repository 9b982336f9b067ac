"""Equation error: the parameters for which the measured rates satisfy the rate equations best, by least squares."""

from typing import ClassVar

import equinox as eqx

from .._custom_types import Count, Parameters, Scalar, as_float, as_int
from .._xla import quick_jit
from ..bracket import NO_PRIOR, Bracket
from ..estimate import AbstractEstimator, Estimate
from ..shooting import ShootingProblem, in_blocks
from ._regression import (
    answer,
    check_linear,
    check_settings,
    normal_equations,
    propagated_covariance,
    regression,
    solve,
)


class EquationError(AbstractEstimator):
    """Least squares of differentiated body rates on the regressors of the rate equations, in one step.

    The rate equations must be linear in the parameters. Their derivatives with respect to the parameters, at the
    measured rates, are the regressors. Only the body rates are used, but the estimate's cost counts all of the
    problem's channels. A free initial state is fitted to the parameters afterwards.

    **Arguments:**

    - `memory`: how the rates are differentiated, from 0 to 1. The mean of the earlier samples is subtracted, in which
      each sample weighs `memory` times its successor. 0 gives plain forward differences (ordinary least squares); 1
      gives the integrated regression, generalised least squares for white noise of the rates. 1 has the smallest
      errors on the standard flight.
    - `bridge`: a gap of up to this many samples in a rate is bridged by a straight line in the regressors. A longer gap
      splits the integration in two.

    A known initial state is exact for a `memory` of 1, and one more sample for a smaller one. Without noise the answer
    is exact for forward Euler; for another `method` the trapezoidal rule leaves a small error.

    The covariance contains the white noise of the problem's `sigma` in regressors and outputs, to first order, but
    neither the bias nor forces that the model lacks. Without measurements of a rate the result is `unidentifiable`.

    References: Klein and Morelli, Aircraft System Identification, ch. 5; Jategaonkar, Flight Vehicle System
    Identification, ch. 6; Ljung, System Identification, section 7.3.
    """

    looks_at: ClassVar[str] = "rates"
    shoots: ClassVar[bool] = False
    prior: ClassVar[float] = NO_PRIOR
    needs_network: ClassVar[bool] = False

    memory: Scalar = eqx.field(converter=as_float, default=1.0)
    bridge: Count = eqx.field(converter=as_int, default=4)

    def __check_init__(self):
        check_settings(self.memory, self.bridge)

    def __call__(self, problem: ShootingProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight.

        **Raises:** `ValueError` for a bracket of another length than the model's parameters, or a model that is not
        linear in those that are not held.
        """
        check_linear(problem)
        return self._blocks(problem.within(bracket))

    @quick_jit
    def _blocks(self, problem: ShootingProblem) -> Estimate:
        return in_blocks(self._identify, problem)

    def _identify(self, problem: ShootingProblem) -> Estimate:
        """One flight, or a block of flights."""
        data = regression(problem, memory=self.memory, bridge=self.bridge)
        rows, back = data.rows()
        steps, inverse = solve(*normal_equations(rows))
        return answer(data, steps, propagated_covariance(data, rows, back, steps, inverse))

    @quick_jit
    def solution(self, problem: ShootingProblem, bracket: Bracket | None = None) -> Parameters:
        """The least-squares solution alone, without its covariance and without a simulation.

        Parameters in which the rate equations are not linear stay at the center of their bracket.
        """
        data = regression(problem.within(bracket), memory=self.memory, bridge=self.bridge)
        return data.center + data.half_width * solve(*normal_equations(data.rows()[0]))[0]
