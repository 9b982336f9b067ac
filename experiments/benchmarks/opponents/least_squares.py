"""SciPy and pyPESTO: minimisers that ask for the residuals of a flight and for their Jacobian, in vectorised NumPy."""

import logging
from collections.abc import Callable

import numpy as np
import scipy.optimize

from experiments.benchmarks.case import Case, trajectories

_TINY = 1e-30  # a complex step this small has no truncation error
_DIVERGED = 1e6  # a residual in place of one that is not finite
_STATE_BOUND = 10.0  # of a free initial state in pyPESTO, in sigma
_TOLERANCE = 1e-10  # of pyPESTO: with SciPy's default of 1e-8, a free initial state ends short of the optimum


def levenberg_marquardt(case: Case) -> Callable[[], dict]:
    """SciPy's `least_squares` by MINPACK, its method for small problems without bounds; one flight after another."""

    def solve(residuals: "Residuals") -> np.ndarray:
        start = np.zeros(residuals.unknowns)
        return scipy.optimize.least_squares(residuals, start, jac=residuals.jacobian, method="lm").x

    return lambda: _each_flight(case, solve)


def multi_start(case: Case, *, starts: int = 4) -> Callable[[], dict]:
    """A trust-region method of pyPESTO inside of the bracket, one flight after another.

    A search begins at the flight's start, and others at random points of the bracket.
    """
    import pypesto.optimize

    logging.getLogger("pypesto").setLevel(logging.ERROR)
    optimizer = pypesto.optimize.ScipyOptimizer(method="ls_trf", tol=_TOLERANCE)

    def solve(residuals: "Residuals") -> np.ndarray:
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

    return lambda: _each_flight(case, solve)


class Residuals:
    """W (x - y) of one flight in scaled unknowns: offsets from the start in half-widths, and states in sigma."""

    def __init__(self, case: Case, which: int):
        self.case, self.which = case, which
        self.unknowns = 8 if case.known else 20

    def __call__(self, scaled: np.ndarray) -> np.ndarray:
        """The residuals."""
        return np.nan_to_num(self._errors(scaled[None])[0], nan=_DIVERGED, posinf=_DIVERGED, neginf=-_DIVERGED)

    def jacobian(self, scaled: np.ndarray) -> np.ndarray:
        """The derivative of the residuals by complex steps; all columns in one vectorised simulation."""
        stepped = scaled + 1j * _TINY * np.eye(self.unknowns)
        return np.nan_to_num(self._errors(stepped).imag.T / _TINY, nan=0.0, posinf=0.0, neginf=0.0)

    def _errors(self, scaled: np.ndarray) -> np.ndarray:
        """The residuals at each row of unknowns."""
        case, which = self.case, self.which
        first = np.broadcast_to(case.first_states()[which], (len(scaled), 12))
        first = first if case.known else first + scaled[:, 8:] * case.sigma
        states = trajectories(case, case.starts[which] + scaled[:, :8] * case.half_width, first)
        return ((states - case.measured[which]) / case.sigma)[:, case.begin :].reshape(len(scaled), -1)


def _each_flight(case: Case, solve: Callable[[Residuals], np.ndarray]) -> dict:
    """The answers of `solve`, flight by flight."""
    return case.answer(np.array([solve(Residuals(case, which)) for which in range(case.flights)]))
