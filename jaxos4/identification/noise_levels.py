"""Where noise levels are estimated: from the residuals of an estimate, repeated until both settle."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .._custom_types import Numeric
from ..analysis.evaluation import Evaluation, evaluate
from ..analysis.huber import winsorised_of
from ..estimate import Estimate
from ..shooting import ShootingProblem
from .results import has_answer

# Noise levels have settled if none changes by more than this share. Weights this close to the right ones cost less
# than 1 % of the efficiency.
_SETTLED = 0.2
# With outliers, no parameter may move by more than this many of its standard deviations (for coloured noise) either.
_SETTLED_PARAMETERS = 0.2
# Beyond this correlation of neighbouring residuals, the number of independent ones cannot be estimated.
_MOST_CORRELATION = 0.98


class Refined(NamedTuple):
    """An estimate with the noise levels that belong to it.

    - `problem`: with the noise levels that were found, and outliers cut if asked.
    - `estimate`: the last one.
    - `rollouts`: of all searches together.
    - `settled`: whether the noise levels stopped changing, or `stop` ended the passes.
    - `colour`: by how much standard errors exceed those of white noise, see `_colour_factor`.
    - `kept`: the share of the measurements that were not cut.
    """

    problem: ShootingProblem
    estimate: Estimate
    rollouts: int
    settled: bool
    colour: float
    kept: float


def evaluate_estimate(problem: ShootingProblem, estimate: Estimate) -> Evaluation:
    """The flight simulated at an estimate."""
    return evaluate(problem, estimate.parameters, estimate.initial_state)


def refine(
    problem: ShootingProblem,
    search: Callable[[ShootingProblem, Estimate | None, float], Estimate],
    *,
    passes: int,
    evaluation: Callable[[ShootingProblem, Estimate], Evaluation] = evaluate_estimate,
    start: Float[Numeric, " parameters"] | None = None,
    huber: bool = False,
    stop: Callable[[Estimate], bool] = lambda estimate: False,
) -> Refined:
    """Alternate an estimate and the noise levels of its residuals until both settle.

    - `problem`: its `sigma` is the first guess of the noise levels.
    - `search`: makes an estimate of a problem, the previous estimate (`None` at first) and its `_colour_factor`.
    - `passes`: how often noise levels are computed at most.
    - `evaluation`: simulates the flight at an estimate.
    - `start`: where the first search starts; needed with `huber`.
    - `huber`: whether outliers are cut, see `jaxos4.winsorised`.
    - `stop`: whether to stop after an estimate, once its noise levels are computed.
    """
    estimate = search(problem, None, 1.0)
    rollouts, colour, kept, settled = int(estimate.rollouts), 1.0, 1.0, False
    previous, weighted = start, problem
    for _ in range(passes):
        if not has_answer(estimate):
            break
        before = weighted
        if huber:
            weighted, kept, errors = winsorised_of(evaluation(problem, estimate))
        else:
            found = evaluation(before, estimate)
            errors, weighted = found.errors, before.reweighted(found.errors, fitted=found.parameters.size)
        colour = _colour_factor(errors)
        settled = bool((np.abs(np.asarray(weighted.sigma) / np.asarray(before.sigma) - 1) < _SETTLED).all())
        if huber and previous is not None:
            std = np.sqrt(np.diagonal(estimate.covariance))
            moved = np.abs(np.asarray(estimate.parameters) - np.asarray(previous)) / std
            settled = settled and bool(moved.max() < _SETTLED_PARAMETERS * colour)
        previous = estimate.parameters
        settled = settled or stop(estimate)
        if settled:
            break
        estimate = search(weighted, estimate, colour)
        rollouts += int(estimate.rollouts)
    return Refined(weighted, estimate, rollouts, settled, colour, kept)


def _colour_factor(residuals: np.ndarray) -> float:
    """By how much standard errors exceed those of white noise, if residuals are a first-order process.

    The root of (1 + rho) / (1 - rho) of the worst channel, for neighbouring residuals that correlate by rho.
    `residuals`: a row a sample, a column a channel; 0: not measured.
    """
    products = residuals[1:] * residuals[:-1]
    pairs = products != 0
    power = np.where(pairs, (np.square(residuals[1:]) + np.square(residuals[:-1])) / 2, 0.0).sum(axis=0)
    neighbours = products.sum(axis=0)
    rho = np.clip(neighbours / np.where(power > 0, power, 1.0), 0.0, _MOST_CORRELATION)
    return float(np.sqrt(((1 + rho) / (1 - rho)).max()))
