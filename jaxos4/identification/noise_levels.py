"""The noise levels of the sensors, found together with the parameters."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from .._custom_types import Parameters
from ..analysis.huber import winsorised
from ..estimate import Estimate
from ..shooting import ShootingProblem
from .results import has_answer

# Noise levels have settled if none changes by more than this share. Weights this close to the right ones cost less
# than 1 % of the efficiency.
SETTLED = 0.2
# With outliers, no parameter may move by more than this many of its standard deviations either. The standard deviations
# allow for coloured noise.
_SETTLED_PARAMETERS = 0.2
# Beyond this correlation of neighbouring residuals, the number of independent ones cannot be estimated.
_MOST_CORRELATION = 0.98


class Refined(NamedTuple):
    """An estimate with the noise levels that belong to it.

    - `problem`: with the noise levels that were found, and outliers cut if asked.
    - `estimate`: the last one.
    - `rollouts`: of all searches together.
    - `settled`: whether the noise levels stopped changing, or `stop` ended the passes.
    - `colour`: by how much standard errors exceed those of white noise, see `colour_factor`.
    - `kept`: the share of the measurements that were not cut.
    """

    problem: ShootingProblem
    estimate: Estimate
    rollouts: int
    settled: bool
    colour: float
    kept: float


def refine(
    problem: ShootingProblem,
    search: Callable[[ShootingProblem, Estimate | None, float], Estimate],
    *,
    passes: int,
    start: Parameters | None = None,
    huber: bool = False,
    stop: Callable[[Estimate], bool] = lambda estimate: False,
) -> Refined:
    """Alternate an estimate and the noise levels of its residuals until both settle.

    **Arguments:**

    - `problem`: its `sigma` is the first guess of the noise levels.
    - `search`: makes an estimate of a problem, the previous estimate (`None` at first) and its `colour_factor`.
    - `passes`: how often noise levels are computed at most.
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
            weighted, share, residuals = winsorised(problem, estimate.parameters, estimate.initial_state)
            kept = float(share)
        else:
            residuals = before.residuals(estimate.parameters, estimate.initial_state)
            weighted = before.reweighted(residuals)
        colour = colour_factor(np.asarray(residuals).reshape(-1, problem.columns.size))
        settled = bool((jnp.abs(weighted.sigma / before.sigma - 1) < SETTLED).all())
        if huber and previous is not None:
            moved = jnp.abs(estimate.parameters - previous) / estimate.std
            settled = settled and bool(moved.max() < _SETTLED_PARAMETERS * colour)
        previous = estimate.parameters
        settled = settled or stop(estimate)
        if settled:
            break
        estimate = search(weighted, estimate, colour)
        rollouts += int(estimate.rollouts)
    return Refined(weighted, estimate, rollouts, settled, colour, kept)


def colour_factor(residuals: np.ndarray) -> float:
    """By how much standard errors exceed those of white noise, if residuals are a first-order process.

    The root of (1 + rho) / (1 - rho) of the worst channel, where neighbouring residuals correlate by rho.

    **Arguments:**

    - `residuals`: one row for each sample, one column for each channel; 0: not measured.
    """
    products = residuals[1:] * residuals[:-1]
    pairs = products != 0
    power = np.where(pairs, (np.square(residuals[1:]) + np.square(residuals[:-1])) / 2, 0.0).sum(axis=0)
    neighbours = products.sum(axis=0)
    rho = np.clip(neighbours / np.where(power > 0, power, 1.0), 0.0, _MOST_CORRELATION)
    return float(np.sqrt(((1 + rho) / (1 - rho)).max()))
