"""Residuals of an estimate: the noise levels that they show, and how well a model explains each channel."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..analysis.diagnostics import Diagnostics, diagnostics_of
from ..analysis.evaluation import Evaluation, evaluate
from ..estimate import Estimate
from ..flight import STATE_NAMES, STATE_UNITS
from ..models.state import CASCADE_ORDER
from ..shooting import ShootingProblem
from .results import ChannelFit, finite_or_none, has_answer

# Noise levels have settled if none changes by more than this share. Weights this close to the right ones cost less
# than 1 % of the efficiency.
_SETTLED = 0.2
# Correlations of residuals are computed up to this many samples apart.
_LAGS = 25
_FEWEST_SAMPLES = 2


class Refined(NamedTuple):
    """An estimate with the noise levels that belong to it.

    - `problem`: with the noise levels that were found.
    - `estimate`: the last one.
    - `rollouts`: of all searches together.
    - `settled`: whether the noise levels stopped changing, or `stop` ended the passes.
    """

    problem: ShootingProblem
    estimate: Estimate
    rollouts: int
    settled: bool


def evaluate_estimate(problem: ShootingProblem, estimate: Estimate) -> Evaluation:
    """The flight simulated at an estimate."""
    return evaluate(problem, estimate.parameters, estimate.initial_state)


def refine(
    problem: ShootingProblem,
    search: Callable[[ShootingProblem], Estimate],
    *,
    passes: int,
    stop: Callable[[Estimate], bool] = lambda estimate: False,
) -> Refined:
    """Alternate an estimate and the noise levels of its residuals until both settle.

    - `problem`: its `sigma` is the first guess of the noise levels.
    - `search`: makes an estimate of a problem.
    - `passes`: how often noise levels are computed at most.
    - `stop`: whether to stop after an estimate, once its noise levels are computed.
    """
    estimate = search(problem)
    rollouts, settled = int(estimate.rollouts), False
    for _ in range(passes):
        if not has_answer(estimate):
            break
        before, found = problem, evaluate_estimate(problem, estimate)
        problem = before.reweighted(found.errors)
        change = np.abs(np.asarray(problem.sigma) / np.asarray(before.sigma) - 1)
        settled = bool((change < _SETTLED).all()) or stop(estimate)
        if settled:
            break
        estimate = search(problem)
        rollouts += int(estimate.rollouts)
    return Refined(problem, estimate, rollouts, settled)


def diagnose(evaluation: Evaluation, *, fitted: bool) -> Diagnostics:
    """Diagnostics of the residuals; `fitted`: whether the parameters were fitted to this flight."""
    return diagnostics_of(evaluation, fitted=fitted, lags=min(_LAGS, evaluation.measured.shape[0] // 2))


def channel_fits(problem: ShootingProblem, diagnostics: Diagnostics) -> dict[str, ChannelFit]:
    """The diagnostics of each measured channel, by its name."""
    return {
        STATE_NAMES[column]: ChannelFit(
            rms=float(diagnostics.rms[i]),
            unit=STATE_UNITS[column],
            percent=finite_or_none(diagnostics.percent[i]),
            level=float(diagnostics.level[i]),
            level_p=float(diagnostics.level_p[i]),
            correlation=float(diagnostics.colour[i]),
            white_p=float(diagnostics.white_p[i]),
            input_correlation=dict(
                zip(("roll", "pitch", "yaw"), diagnostics.input_correlation[i].tolist(), strict=True)
            ),
            input_p=float(diagnostics.input_p[i]),
        )
        for i, column in enumerate(CASCADE_ORDER[: problem.size])
        if diagnostics.count[i] > _FEWEST_SAMPLES
    }
