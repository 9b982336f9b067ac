"""SciPy: `least_squares` by MINPACK's Levenberg-Marquardt, its method for small problems without bounds."""

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from experiments.benchmarks.case import Case
from experiments.benchmarks.opponents.residuals import Residuals, each_flight


def levenberg_marquardt(case: Case) -> Callable[[], dict]:
    """One flight after another."""

    def solve(residuals: Residuals) -> np.ndarray:
        return least_squares(residuals, np.zeros(residuals.unknowns), jac=residuals.jacobian, method="lm").x

    return lambda: each_flight(case, solve)
