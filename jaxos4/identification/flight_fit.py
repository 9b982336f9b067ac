"""The fit of one flight: the parameters of an OS4, with the noise levels of the sensors."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from .._custom_types import as_float
from ..analysis.diagnostics import Diagnostics
from ..analysis.evaluation import Evaluation
from ..analysis.sandwich import robust_covariance_of
from ..bracket import Bracket
from ..estimate import AbstractEstimator, Estimate
from ..results import RESULTS
from ..shooting import ShootingProblem, padded
from .noise_levels import evaluate_estimate, refine
from .quality import COLOURED, diagnose
from .results import has_answer

# Noise levels are computed at most this often before the last estimate.
_PASSES = 3


class FlightFit(NamedTuple):
    """One flight's estimate.

    - `problem`: with the noise levels that were found.
    - `estimate`: with its cost and covariance at these noise levels.
    - `bound`: standard deviations of the Cramer-Rao bound at these noise levels.
    - `rollouts`: of all searches together.
    - `diagnostics`: of the residuals; `evaluation`: the flight simulated at the estimate. `None` without an answer.
    """

    problem: ShootingProblem
    estimate: Estimate
    bound: Float[np.ndarray, " parameters"]
    rollouts: int
    diagnostics: Diagnostics | None = None
    evaluation: Evaluation | None = None


def fit_flight(
    estimator: AbstractEstimator,
    problem: ShootingProblem,
    bracket: Bracket,
    *,
    progress: Callable[[str], None] = lambda stage: None,
) -> FlightFit:
    """Estimate the parameters and the noise levels of one flight.

    The covariance of an estimator that shoots is the Cramer-Rao bound, or `robust_covariance` if residuals are
    coloured. The other estimators have their own, and estimate once more with the last noise levels.
    """
    passes = 0

    def search(weighted: ShootingProblem, previous: Estimate | None, colour: float) -> Estimate:
        nonlocal passes
        del colour
        progress("compiling and fitting" if previous is None else f"fitting with the noise levels of pass {passes}")
        passes += 1
        shared = padded(weighted) if estimator.shoots and not estimator.needs_network else weighted
        return jax.block_until_ready(estimator(shared, bracket))

    def failed(estimate: Estimate) -> bool:
        return estimator.shoots and bool(estimate.result != RESULTS.successful)

    refined = refine(problem, search, passes=_PASSES, stop=failed)
    problem, estimate, rollouts = refined.problem, refined.estimate, refined.rollouts
    if has_answer(estimate):
        if not refined.settled:
            problem = problem.reweighted(evaluate_estimate(problem, estimate).errors)
        if not estimator.shoots:
            estimate = search(problem, estimate, refined.colour)
            rollouts += int(estimate.rollouts)
    if not has_answer(estimate):
        return FlightFit(problem, estimate, np.full(len(problem.model.parameter_names), np.inf), rollouts)
    evaluation = evaluate_estimate(problem, estimate)
    bound, covariance = evaluation.covariance, estimate.covariance
    diagnostics = diagnose(evaluation, fitted=True)
    if estimator.shoots:
        coloured = (diagnostics.colour > COLOURED).any()
        covariance = robust_covariance_of(evaluation) if coloured else bound
    estimate = eqx.tree_at(
        lambda e: (e.covariance, e.cost), estimate, (as_float(covariance), as_float(evaluation.cost))
    )
    return FlightFit(problem, estimate, np.sqrt(np.diagonal(bound)), rollouts, diagnostics, evaluation)
