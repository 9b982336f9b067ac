"""Predictions of measurements that were not fitted."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._custom_types import as_float
from .._xla import quick_jit
from ..analysis.diagnostics import residual_diagnostics
from ..analysis.evaluation import evaluate
from ..analysis.frequency_response import frequency_response
from ..analysis.prediction import Disturbances, Predictions, Skill, disturbances, predictions, skill
from ..estimate import fit_start
from ..estimators import EquationError
from ..shooting import ShootingProblem, padded, with_room
from ..shooting.gains import LogNoise
from .answers import channel_fits
from .fit import Fit
from .prepare import Case, HeldOut
from .results import PredictionSkill, RateSkill, Validation, finite_or_none

# Memory of the regression for comparison: the best on real flights.
_MEMORY = 0.9


def predict_held_out(fit: Fit, held_out: HeldOut, room: int) -> tuple[Predictions, PredictionSkill]:
    """Predict the rates of measurements that were not fitted, by the fit and by a regression with the same terms.

    The fit predicts the disturbance too, from the measurements before each start. `room`: see `Case`.
    """
    values = np.asarray(fit.estimate.parameters)[: fit.problem.unknowns.count]

    def scored(values: np.ndarray, noise: LogNoise | None) -> tuple[Predictions, Skill]:
        parameters = values if held_out.fitted_vehicle else _of_one_recording(fit.problem, held_out.problem, values)
        known = None if noise is None else _disturbances(fit.problem, held_out, room, parameters, noise)
        predicted = predictions(held_out.problem, as_float(parameters), disturbance=known)
        return predicted, skill(predicted)

    predicted, own = scored(values, fit.noise)
    held = [name in fit.held for name in fit.problem.unknowns.names]
    _, regressed = scored(_regressed(fit.problem, room, values, held), None)
    tables = (own.skill, own.std, own.rmse, own.persistence, regressed.skill)
    rates = {
        rate: RateSkill(*([finite_or_none(x) for x in table[:, i]] for table in tables)) for i, rate in enumerate("pqr")
    }
    return predicted, PredictionSkill(predicted.horizons.tolist(), own.starts, **rates)


def compile_ahead(case: Case) -> None:
    """Compile what checks the fit of a vehicle at any sample time, while the fits are computed."""
    problem, held_out = case.shooting, case.held_out
    center = np.asarray(problem.unknowns.center)
    frequency_response(with_room(problem, case.room), as_float(center))
    if held_out is None:
        return
    _regressed(problem, case.room, center, [False] * center.size)
    if held_out.fitted_vehicle:
        noise = LogNoise(*np.zeros((3, problem.columns.size)))
        _disturbances(problem, held_out, case.room, center, noise)


def _disturbances(
    fitted: ShootingProblem, held_out: HeldOut, room: int, parameters: np.ndarray, noise: LogNoise
) -> Disturbances:
    """The disturbances of the vehicle, from all measurements."""
    whole = _joined(fitted, held_out.problem) if held_out.fitted_vehicle else held_out.problem
    samples = whole.flight.time.shape[0]
    found = disturbances(with_room(whole, max(samples, room)), as_float(parameters), noise)
    return found._replace(value=found.value[:samples])


def _regressed(problem: ShootingProblem, room: int, values: np.ndarray, held: Sequence[bool]) -> np.ndarray:
    """The parameters by regression."""
    return np.asarray(_regression(with_room(problem, room), as_float(values), jnp.asarray(held)))


def _joined(fitted: ShootingProblem, tested: ShootingProblem) -> ShootingProblem:
    """The problem with all measurements: those that were fitted and those that were not."""
    own, others = np.asarray(tested.flight.states), np.asarray(fitted.flight.states)
    return eqx.tree_at(lambda p: p.flight.states, tested, as_float(np.where(np.isnan(own), others, own)))


def _of_one_recording(fitted: ShootingProblem, other: ShootingProblem, values: np.ndarray) -> np.ndarray:
    """The parameters of another recording: the mean of those of which each fitted recording has its own."""
    known = dict(zip(fitted.unknowns.names, values.tolist(), strict=True))
    each = {name: [known[own] for own in known if own.rpartition("_")[0] == name] for name in other.unknowns.names}
    return np.array([known[name] if name in known else np.mean(each[name]) for name in other.unknowns.names])


@quick_jit
def _regression(problem: ShootingProblem, values: Array, held: Array) -> Array:
    """The parameters by regression; held ones, and those that it cannot estimate, have the values of the fit."""
    linear = np.array([not each.in_forcing for each in problem.model.parameters])
    own = jnp.where(linear & ~held, problem.unknowns.center, values)
    unknowns = dataclasses.replace(problem.unknowns, center=own, free=linear & ~held)
    return EquationError(memory=_MEMORY).solution(dataclasses.replace(problem, unknowns=unknowns))


def validate_on(fit: Fit, held_out: HeldOut) -> Validation:
    """How well the parameters explain another flight; only its initial state is fitted."""
    other, parameters = eqx.tree_at(lambda p: p.sigma, held_out.problem, fit.problem.sigma), fit.estimate.parameters
    start, cost, sound, _ = quick_jit(fit_start)(padded(other), parameters)
    if not bool(sound):
        return Validation(held_out.name, None, None)
    diagnostics = residual_diagnostics(evaluate(other, parameters, start), fitted=False)
    return Validation(held_out.name, finite_or_none(cost), channel_fits(other, diagnostics))
