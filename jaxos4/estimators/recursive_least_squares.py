"""Recursive least squares: equation error sample by sample, with the past forgotten at a chosen pace."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from .._custom_types import Scalar, as_float
from ..bracket import NO_PRIOR, Bracket
from ..estimate import AbstractEstimator, Estimate, check_bracket, check_one_window
from ..shooting import ShootingProblem
from ._regression import (
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


class RecursiveLeastSquares(AbstractEstimator):
    """The regression of `EquationError`, updated at every sample with three rows: one each for p, q and r.

    What is carried is the information form: the normal matrix and its right-hand side, forgotten and added to. It needs
    no initial covariance and cannot lose its symmetry or sign as the covariance form does in single precision: rows are
    in units of the noise, parameters in half-widths off the bracket's center, and the matrix is scaled to unit diagonal
    before it is solved, with a floor on its pivots. In single precision the standard flight is recovered within 0.001
    of its Cramer-Rao bound. The prior, a million half-widths wide, is added only to solve and is not forgotten: without
    excitation nothing winds up or overflows. A parameter is at the center until a sample tells of it.

    **Arguments:**

    - `forgetting`: the weight of a sample relative to its successor, above 0 and up to 1. The estimate is that of the
      last 1 / (1 - forgetting) samples or so, and follows parameters that change, within this time. 1: nothing is
      forgotten, and the last estimate is that of `EquationError` with the same settings.
    - `memory`, `bridge`: as in `EquationError`. Below 1, `forgetting` forgets the means as well, and a known initial
      state counts like a sample: it says nothing about a flight whose parameters have changed since.

    The estimate's `history` holds the parameters after each sample; `parameters` are its last row. A bridged gap is
    crossed with the sample at its end, so that rows within a gap are not known before it ends. The covariance is that
    of the last estimate: it carries the noise of the measured rates through the weights, to first order, and holds no
    lag behind parameters that change. With constant parameters, 64 standard flights, free initial state, a `forgetting`
    of 0.995 gives 1.0 to 1.6 times the Cramer-Rao bound, 0.98 gives 2.2 to 5.2.

    Reference: Ljung, System Identification, section 11.2, with exponential forgetting.
    """

    looks_at: ClassVar[str] = "rates"
    shoots: ClassVar[bool] = False
    prior: ClassVar[float] = NO_PRIOR
    needs_network: ClassVar[bool] = False

    forgetting: Scalar = eqx.field(converter=as_float, default=1.0)
    memory: Scalar = eqx.field(converter=as_float, default=1.0)
    bridge: int = eqx.field(static=True, default=4)

    def __check_init__(self):
        check_share("forgetting", self.forgetting, open_below=True)
        check_share("memory", self.memory, open_below=False)
        check_bridge(self.bridge)

    @eqx.filter_jit
    def __call__(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        """Identifies one flight.

        **Raises:** `ValueError` for a bracket of another length than the model's parameters, a model that is not linear
        in them, or a flight that is cut into windows.
        """
        check_bracket(problem, bracket)
        check_one_window(problem)
        usable = bracket.usable
        data = regression(problem, usable, memory=self.memory, forgetting=self.forgetting, bridge=self.bridge)
        rows = data.rows(data.rates)

        def update(carry, row):
            information, moment = carry
            added = normal_equations(row)
            carry = self.forgetting * information + added[0], self.forgetting * moment + added[1]
            return carry, solve(*carry)[0]

        count = usable.center.shape[0]
        nothing = jnp.zeros((count, count), dtype=float), jnp.zeros(count, dtype=float)
        (information, moment), history = jax.lax.scan(update, nothing, rows)
        steps, inverse = solve(information, moment)
        history = parameters_of(usable, history)
        parameters = history[-1]
        covariance = covariance_of(usable, propagated_covariance(data, steps, inverse))
        return answer(problem, bracket, parameters, covariance, history=history)
