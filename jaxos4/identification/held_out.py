"""Predictions of measurements that were not fitted."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._custom_types import Numeric, as_float
from ..analysis.diagnostics import residual_diagnostics
from ..analysis.evaluation import evaluate
from ..analysis.open_loop import disturbances
from ..analysis.prediction import Predictions, Skill, predictions, skill
from ..estimate import fit_start
from ..estimators import EquationError
from ..shooting import ShootingProblem, padded, with_room
from ..shooting.gains import LogNoise
from .answers import Answer, channel_fits
from .data import Data, HeldOut
from .results import PredictionSkill, RateSkill, Validation, finite_or_none

REGRESSION = EquationError(memory=0.9)
"""For comparison. This memory is the best on real flights."""


def predict_held_out(
    data: Data, answer: Answer, noise: LogNoise, held_out: HeldOut
) -> tuple[Predictions, PredictionSkill]:
    """Predict the rates of measurements that were not fitted, by the answer and by a regression with the same terms.

    The answer, with the `noise` of its filters, predicts the disturbance too, from the measurements before each start.
    """
    problem, names = held_out.problem, answer.problem.unknowns.names
    values = np.asarray(answer.estimate.parameters)[: len(names)]

    def scored(values: np.ndarray, noise: LogNoise | None) -> tuple[Predictions, Skill]:
        parameters = values
        if held_out.recording:  # the mean of those of which each fitted recording has its own
            fitted = dict(zip(names, values.tolist(), strict=True))
            each = {n: [fitted[own] for own in fitted if own.rpartition("_")[0] == n] for n in problem.unknowns.names}
            parameters = np.array([fitted[n] if n in fitted else np.mean(each[n]) for n in each])
        known = None if noise is None else _disturbances(data, held_out, parameters, noise)
        predicted = predictions(problem, as_float(parameters), disturbance=known, noise=noise)
        return predicted, skill(predicted)

    predicted, own = scored(values, noise)
    fixed = [name in answer.fixed for name in names]
    _, regressed = scored(_regressed(answer.problem, data.room, values, fixed), None)
    tables = (own.skill, own.std, own.rmse, own.persistence, regressed.skill)
    rates = {
        rate: RateSkill(*([finite_or_none(x) for x in table[:, i]] for table in tables)) for i, rate in enumerate("pqr")
    }
    return predicted, PredictionSkill(predicted.horizons.tolist(), own.starts, **rates)


def _disturbances(data: Data, held_out: HeldOut, parameters: np.ndarray, noise: LogNoise) -> np.ndarray:
    """The disturbances of the vehicle, from all measurements: those that were fitted and those that were not."""
    problem = held_out.problem
    if not held_out.recording:
        own, others = np.asarray(problem.flight.states), np.asarray(data.flight.flight.states)
        both = as_float(np.where(np.isnan(own), others, own))
        problem = eqx.tree_at(lambda p: p.flight.states, problem, both)
    samples = problem.flight.time.shape[0]
    return disturbances(with_room(problem, max(samples, data.room)), as_float(parameters), noise)[:samples]


def _regressed(problem: ShootingProblem, room: int, values: np.ndarray, fixed: Sequence[bool]) -> np.ndarray:
    """The parameters by regression."""
    return np.asarray(_regression(with_room(problem, room), as_float(values), np.asarray(fixed)))


@eqx.filter_jit
def _regression(problem: ShootingProblem, values: Array, fixed: Numeric) -> Array:
    """The parameters by regression; fixed ones, and those that it cannot estimate, have the values of the fit."""
    linear = np.array([not each.in_forcing for each in problem.model.parameters])
    own = jnp.where(linear & ~fixed, problem.unknowns.center, values)
    unknowns = dataclasses.replace(problem.unknowns, center=own, free=linear & ~fixed)
    return REGRESSION.solution(dataclasses.replace(problem, unknowns=unknowns))


def validate_on(answer: Answer, held_out: HeldOut) -> Validation:
    """How well the parameters explain another flight; only its initial state is fitted."""
    other, name = eqx.tree_at(lambda p: p.sigma, held_out.problem, answer.problem.sigma), held_out.recording
    start, cost, feasible, _ = eqx.filter_jit(fit_start)(padded(other), answer.estimate.parameters)
    if not bool(feasible):
        return Validation(name, None, None)
    diagnostics = residual_diagnostics(evaluate(other, answer.estimate.parameters, start), fitted=False)
    return Validation(name, finite_or_none(cost), channel_fits(other, diagnostics))
