"""Residuals and their Jacobian in vectorised NumPy, for minimisers that ask for both: SciPy and pyPESTO."""

from collections.abc import Callable

import numpy as np

from experiments.benchmarks.case import Case, trajectories

_TINY = 1e-30  # a complex step this small has no truncation error
_DIVERGED = 1e6  # a residual in place of one that is not finite


class Residuals:
    """W (x - y) of one flight in scaled unknowns: offsets from the start in half-widths, and states in sigma."""

    def __init__(self, case: Case, which: int):
        self.case, self.which = case, which
        self.unknowns = 8 if case.known else 20

    def parameters(self, scaled: np.ndarray) -> np.ndarray:
        """The parameters at scaled unknowns; leading axes are a batch."""
        return self.case.starts[self.which] + scaled[..., :8] * self.case.half_width

    def first(self, scaled: np.ndarray) -> np.ndarray:
        """The initial state at scaled unknowns."""
        begin = np.broadcast_to(self.case.first_states()[self.which], (*scaled.shape[:-1], 12))
        return begin if self.case.known else begin + scaled[..., 8:] * self.case.sigma

    def __call__(self, scaled: np.ndarray) -> np.ndarray:
        """The residuals."""
        return np.nan_to_num(self._errors(scaled[None])[0], nan=_DIVERGED, posinf=_DIVERGED, neginf=-_DIVERGED)

    def jacobian(self, scaled: np.ndarray) -> np.ndarray:
        """The derivative of the residuals by complex steps; all columns in one vectorised simulation."""
        stepped = scaled + 1j * _TINY * np.eye(self.unknowns)
        return np.nan_to_num(self._errors(stepped).imag.T / _TINY, nan=0.0, posinf=0.0, neginf=0.0)

    def _errors(self, scaled: np.ndarray) -> np.ndarray:
        states = trajectories(self.case, self.parameters(scaled), self.first(scaled))
        errors = (states - self.case.measured[self.which]) / self.case.sigma
        return errors[:, self.case.begin :].reshape(len(scaled), -1)


def each_flight(case: Case, solve: Callable[[Residuals], np.ndarray]) -> dict:
    """The answers of `solve`, flight by flight."""
    parameters, first = [], []
    for which in range(case.flights):
        residuals = Residuals(case, which)
        scaled = solve(residuals)
        parameters.append(residuals.parameters(scaled))
        first.append(residuals.first(scaled))
    return {"parameters": np.array(parameters), "first": np.array(first)}
