"""pyPESTO: multi-start optimisation by a least-squares trust-region method, inside of the bracket."""

import logging
from collections.abc import Callable

import numpy as np
import pypesto
import pypesto.optimize

from experiments.benchmarks.case import Case
from experiments.benchmarks.opponents.residuals import Residuals, each_flight

_STATE_BOUND = 10.0  # of a free initial state, in sigma
_TOLERANCE = 1e-10  # with SciPy's default of 1e-8, a free initial state ends short of the optimum


def multi_start(case: Case, *, starts: int = 4) -> Callable[[], dict]:
    """One flight after another: a search from the flight's start, and others from random points of the bracket."""
    logging.getLogger("pypesto").setLevel(logging.ERROR)
    optimizer = pypesto.optimize.ScipyOptimizer(method="ls_trf", tol=_TOLERANCE)

    def solve(residuals: Residuals) -> np.ndarray:
        bound = np.concatenate([np.ones(8), np.full(residuals.unknowns - 8, _STATE_BOUND)])

        def gradient(scaled: np.ndarray) -> np.ndarray:
            return residuals.jacobian(scaled).T @ residuals(scaled)

        objective = pypesto.Objective(
            fun=lambda scaled: 0.5 * np.square(residuals(scaled)).sum(),
            grad=gradient,
            res=residuals,
            sres=residuals.jacobian,
        )
        problem = pypesto.Problem(objective, lb=-bound, ub=bound, x_guesses=[np.zeros(residuals.unknowns)])
        result = pypesto.optimize.minimize(problem, optimizer=optimizer, n_starts=starts, progress_bar=False)
        return np.asarray(result.optimize_result.list[0].x)

    return lambda: each_flight(case, solve)
