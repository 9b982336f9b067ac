"""Recursive least squares: equation error sample by sample, with exponential forgetting."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from .._custom_types import Count, Scalar, as_float, as_int
from .._xla import quick_jit
from ..bracket import NO_PRIOR, Bracket
from ..estimate import AbstractEstimator, Estimate, check_recursive
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


class RecursiveLeastSquares(AbstractEstimator):
    """The regression of `EquationError`, updated at every sample with one row for each of p, q and r.

    The recursion carries the normal matrix and its right-hand side: unlike a covariance, they stay symmetric and
    positive in single precision. A diffuse prior (a million half-widths) is added only to solve and is not forgotten.
    A parameter stays at the bracket's center until it is excited.

    **Arguments:**

    - `forgetting`: the weight of a sample relative to its successor, above 0 and up to 1. The estimate describes the
      last 1 / (1 - forgetting) samples or so, and follows parameters that change within this time. With the default of
      1 nothing is forgotten, and the last estimate is that of `EquationError` with the same settings.
    - `memory`, `bridge`: as in `EquationError`. A `forgetting` below 1 also forgets the means, and a known initial
      state then counts like one sample.

    The estimate's `history` holds the parameters after each sample; its last row is `parameters`. A bridged gap needs
    the sample at its end, so rows inside a gap are known only after the gap. The covariance is that of the last
    estimate: the noise of the measured rates, to first order, without the lag behind parameters that change.

    Reference: Ljung, System Identification, section 11.2, with exponential forgetting.
    """

    looks_at: ClassVar[str] = "rates"
    shoots: ClassVar[bool] = False
    prior: ClassVar[float] = NO_PRIOR
    needs_network: ClassVar[bool] = False

    forgetting: Scalar = eqx.field(converter=as_float, default=1.0)
    memory: Scalar = eqx.field(converter=as_float, default=1.0)
    bridge: Count = eqx.field(converter=as_int, default=4)

    def __check_init__(self):
        check_settings(self.memory, self.bridge, self.forgetting)

    def __call__(self, problem: ShootingProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight.

        **Raises:** `ValueError` for a bracket of another length than the model's parameters, a model that is not linear
        in those that are not held, or a flight that is cut into windows.
        """
        check_recursive(problem)
        check_linear(problem)
        return self._blocks(problem.within(bracket))

    @quick_jit
    def _blocks(self, problem: ShootingProblem) -> Estimate:
        return in_blocks(self._identify, problem)

    def _identify(self, problem: ShootingProblem) -> Estimate:
        """One flight, or a block of flights."""
        count = problem.unknowns.count
        data = regression(problem, memory=self.memory, forgetting=self.forgetting, bridge=self.bridge)
        rows, back = data.rows()

        def update(carry, row):
            information, moment, _ = carry
            added = normal_equations(row)
            carry = self.forgetting * information + added[0], self.forgetting * moment + added[1]
            steps, inverse = solve(*carry)
            return (*carry, inverse), steps

        zero = jnp.zeros((count, count), dtype=float)
        (*_, inverse), steps = jax.lax.scan(update, (zero, jnp.zeros(count, dtype=float), zero), rows)
        covariance = propagated_covariance(data, rows, back, steps[-1], inverse)
        return answer(data, steps[-1], covariance, history=data.center + data.half_width * steps)
