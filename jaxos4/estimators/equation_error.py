"""Equation error: the parameters for which the measured rates satisfy the rate equations best, by least squares.

`EquationError` uses all samples in one step, `RecursiveLeastSquares` one sample after the other, with forgetting.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .._custom_types import Count, Parameters, Scalar, as_float, integer, setting
from .._xla import quick_jit
from ..bracket import NO_PRIOR, Bracket
from ..estimate import AbstractEstimator, AbstractRecursion, Estimate, in_one_program
from ..shooting import ShootingProblem
from .regression import Regression, normal_equations, solve


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

    memory: Scalar = eqx.field(converter=setting("memory", high=1.0), default=1.0)
    bridge: Count = eqx.field(converter=integer("bridge", 0), default=4)

    def __call__(self, problem: ShootingProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight.

        **Raises:** `ValueError` for a bracket of another length than the model's parameters, or a model that is not
        linear in those that are not held. Inside `jit`, where it is not known which are held, all must be linear.
        """
        mask, parameters = problem.unknowns.free, problem.model.parameters
        free = np.ones(len(parameters), dtype=bool) if isinstance(mask, Tracer) else np.asarray(mask)
        if any(each.in_forcing for each, searched in zip(parameters, free, strict=True) if searched):
            raise ValueError(
                "`problem.model` must have rate equations that are linear in its parameters for a regression: hold the "
                "others, or use an estimator that shoots."
            )
        return in_one_program(self._identify, problem, bracket)

    def _identify(self, problem: ShootingProblem) -> Estimate:
        """One flight, or a block of flights."""
        data = self._regression(problem)
        rows, back = data.rows()
        steps, inverse = solve(*normal_equations(rows))
        return data.answer(steps, data.covariance(rows, back, steps, inverse))

    @quick_jit
    def solution(self, problem: ShootingProblem, bracket: Bracket | None = None) -> Parameters:
        """The least-squares solution alone, without its covariance and without a simulation.

        Parameters in which the rate equations are not linear stay at the center of their bracket.
        """
        data = self._regression(problem.within(bracket))
        return data.center + data.half_width * solve(*normal_equations(data.rows()[0]))[0]

    def _regression(self, problem: ShootingProblem) -> Regression:
        return Regression.of(problem, self.memory, self.bridge, as_float(1.0))


class RecursiveLeastSquares(AbstractRecursion):
    """The regression of `EquationError`, updated at every sample with one row for each of p, q and r.

    The recursion carries the normal matrix and its right-hand side, which stay symmetric and positive in single
    precision. A parameter stays at the bracket's center until it is excited.

    **Arguments:**

    - `forgetting`: the weight of a sample relative to its successor, above 0 and up to 1. The estimate describes the
      last 1 / (1 - forgetting) samples or so, and follows parameters that change within this time. With the default of
      1 nothing is forgotten, and the last estimate is that of `EquationError` with the same settings.
    - `memory`, `bridge`: as in `EquationError`. A `forgetting` below 1 also forgets the means, and a known initial
      state then counts like one sample.

    The estimate's `history` holds the parameters after each sample; its last row is `parameters`. Rows inside a bridged
    gap are known only after the gap. The covariance is that of the last estimate, without its lag behind parameters
    that change.

    Reference: Ljung, System Identification, section 11.2, with exponential forgetting.
    """

    looks_at: ClassVar[str] = "rates"
    prior: ClassVar[float] = NO_PRIOR

    forgetting: Scalar = eqx.field(converter=setting("forgetting", high=1.0, positive=True), default=1.0)
    memory: Scalar = eqx.field(converter=setting("memory", high=1.0), default=1.0)
    bridge: Count = eqx.field(converter=integer("bridge", 0), default=4)

    def identify(self, problem: ShootingProblem) -> Estimate:
        """See `AbstractRecursion`."""
        count, data = problem.unknowns.count, Regression.of(problem, self.memory, self.bridge, self.forgetting)
        rows, back = data.rows()

        def update(carry, row):
            added, (information, moment, _) = normal_equations(row), carry
            carry = self.forgetting * information + added[0], self.forgetting * moment + added[1]
            steps, inverse = solve(*carry)
            return (*carry, inverse), steps

        zero = jnp.zeros((count, count), dtype=float)
        (*_, inverse), steps = jax.lax.scan(update, (zero, jnp.zeros(count, dtype=float), zero), rows)
        return data.answer(steps[-1], data.covariance(rows, back, steps[-1], inverse), steps)
