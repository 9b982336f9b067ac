"""Huber's robust loss: limits the influence of outliers on a fit."""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._custom_types import InitialStates, Parameters, as_float
from ..flight import STATE_NAMES
from ..shooting import ShootingProblem
from .evaluation import Evaluation, evaluate

# Residuals are limited to this many standard deviations. With Gaussian noise the estimate keeps 95 % efficiency.
CUT = 1.345
# The median magnitude of Gaussian noise, in standard deviations.
_MEDIAN = 0.6745


class Winsorised(NamedTuple):
    """A problem whose outliers were moved towards the fit.

    - `problem`: to be fitted by least squares. Its noise levels come from the medians of the residuals.
    - `share`: the fraction of the measurements that did not move.
    - `residuals`: the limited residuals, in the new noise levels; 0 for missing measurements.
    """

    problem: ShootingProblem
    share: float
    residuals: Float[np.ndarray, "samples columns"]


def winsorised(problem: ShootingProblem, parameters: Parameters, initial_state: InitialStates) -> Winsorised:
    """Move each measurement whose residual exceeds 1.345 standard deviations to 1.345 standard deviations.

    Repeat this and a least-squares fit until the parameters no longer change. The result is Huber's estimate by the
    method of modified residuals (Huber, Robust Statistics, section 7.8). NumPy computes it, for one flight.

    **Arguments:** `parameters` and `initial_state` of a fit.
    """
    return winsorised_of(evaluate(problem, parameters, initial_state))


def winsorised_of(evaluation: Evaluation) -> Winsorised:
    """`winsorised` where the flight was simulated already."""
    problem, sigma = evaluation.problem, evaluation.sigma
    measured, errors = ~np.isnan(evaluation.measured), evaluation.errors * sigma
    medians = np.array(
        [np.median(np.abs(e[m])) if m.sum() > 1 else 0.0 for e, m in zip(errors.T, measured.T, strict=True)]
    )
    scale = np.where((medians > 0) & np.isfinite(medians), medians / _MEDIAN, sigma)
    cut = np.clip(errors, -CUT * scale, CUT * scale)
    moved, levels = np.where(measured, cut - errors, 0.0), np.array(problem.sigma)
    levels[problem.columns] = scale
    states, flight = np.array(problem.flight.states), problem.flight
    of_state = problem.columns < len(STATE_NAMES)
    states[:, problem.columns[of_state]] += moved[:, of_state]
    changed = eqx.tree_at(lambda p: (p.sigma, p.flight.states), problem, (as_float(levels), as_float(states)))
    if flight.specific_force is not None:
        force = np.array(flight.specific_force)
        force[:, problem.columns[~of_state] - len(STATE_NAMES)] += moved[:, ~of_state]
        changed = eqx.tree_at(lambda p: p.flight.specific_force, changed, as_float(force))
    share = float((measured & (cut == errors)).sum() / max(measured.sum(), 1))
    return Winsorised(changed, share, np.where(measured, cut / scale, 0.0))
