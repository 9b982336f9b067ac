"""Predictions of measurements that were not fitted."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._custom_types import Numeric, as_float
from ..analysis.diagnostics import Correlations, residual_correlations, residual_diagnostics
from ..analysis.evaluation import evaluate
from ..analysis.frequency_response import frequency_response
from ..analysis.open_loop import Traced, traced
from ..analysis.prediction import Predictions, Skill, predictions, skill
from ..analysis.traces import Traces, position_of
from ..estimate import fit_start
from ..estimators import EquationError
from ..flight import RATES
from ..shooting import ShootingProblem, padded, with_room
from ..shooting.gains import LogNoise
from .answers import channel_fits
from .fit import Fit
from .prepare import Case
from .results import PredictionSkill, RateSkill, Validation, finite_or_none

# Memory of the regression for comparison: the best on real flights.
_MEMORY = 0.9


def predict_held_out(case: Case, fit: Fit, held_out: ShootingProblem) -> tuple[Predictions, PredictionSkill]:
    """Predict the rates of measurements that were not fitted, by the fit and by a regression with the same terms.

    The fit predicts the disturbance too, from the measurements before each start.
    """
    values = np.asarray(fit.estimate.parameters)[: fit.problem.unknowns.count]

    def scored(values: np.ndarray, noise: LogNoise | None) -> tuple[Predictions, Skill]:
        parameters = values
        if case.validate:  # the mean of those of which each fitted recording has its own
            fitted = dict(zip(fit.problem.unknowns.names, values.tolist(), strict=True))
            each = {n: [fitted[own] for own in fitted if own.rpartition("_")[0] == n] for n in held_out.unknowns.names}
            parameters = np.array([fitted[n] if n in fitted else np.mean(each[n]) for n in each])
        seen, known = _together(case, fit.problem, held_out), None
        if noise is not None:
            known = _traced(case, seen, parameters, noise).disturbance
        predicted = predictions(held_out, as_float(parameters), disturbance=known, noise=noise)
        return predicted, skill(predicted)

    predicted, own = scored(values, fit.noise)
    held = [name in fit.held for name in fit.problem.unknowns.names]
    _, regressed = scored(_regressed(fit.problem, case.room, values, held), None)
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
    if not case.validate:
        _traced(case, problem, center, LogNoise(*np.zeros((3, problem.columns.size))))


def _together(case: Case, fitted: ShootingProblem, held_out: ShootingProblem) -> ShootingProblem:
    """The problem with all measurements: those that were fitted, and those that were held out of the same flight."""
    if case.validate:
        return held_out
    own, others = np.asarray(held_out.flight.states), np.asarray(fitted.flight.states)
    return eqx.tree_at(lambda p: p.flight.states, held_out, as_float(np.where(np.isnan(own), others, own)))


def _traced(case: Case, problem: ShootingProblem, parameters: np.ndarray, noise: LogNoise) -> Traced:
    samples = problem.flight.time.shape[0]
    found = traced(with_room(problem, max(samples, case.room)), as_float(parameters), noise)
    return Traced(*(each[:samples] for each in found))


def vehicle_traces(case: Case, fit: Fit, predicted: Predictions | None) -> tuple[Traces, Correlations]:
    """The signals of the fitted flights, and the correlations of the innovations.

    `predicted`: the predictions that the result keeps.
    """
    problem = fit.problem if case.held_out is None or case.validate else _together(case, fit.problem, case.held_out)
    values = np.asarray(fit.estimate.parameters)[: fit.problem.unknowns.count]
    noise = LogNoise(*np.zeros((3, 3))) if fit.noise is None else fit.noise
    found, flight = _traced(case, problem, values, noise), fit.problem.flight
    states, omega = np.asarray(flight.states, float), np.asarray(flight.omega, float)
    position = position_of(np.asarray(problem.flight.states, float))
    start = np.zeros(0, int) if predicted is None else predicted.start
    log, time = case.clock
    start_log, start_time = (each[start] for each in (case.tested_clock if case.validate else case.clock))
    signals = omega, states[:, RATES], states[:, :0], found.disturbance, position
    traces = Traces(time, log, *signals, start_time, start_log)
    torques = omega**2 @ np.asarray(fit.problem.model.airframe.mixer)[:3].T
    crossed = residual_correlations(found.innovation, torques)
    if fit.searched is not None and (parts := fit.searched[1].parts) is not None:
        # Of the innovations of the likelihood itself, which is exact for means.
        products = np.asarray(parts.products).sum(axis=0)[:3]
        crossed = crossed._replace(own=products[:, 1:] / np.maximum(products[:, :1], 1.0))
    return traces.thinned(), crossed


def _regressed(problem: ShootingProblem, room: int, values: np.ndarray, held: Sequence[bool]) -> np.ndarray:
    """The parameters by regression."""
    return np.asarray(_regression(with_room(problem, room), as_float(values), np.asarray(held)))


@eqx.filter_jit
def _regression(problem: ShootingProblem, values: Array, held: Numeric) -> Array:
    """The parameters by regression; held ones, and those that it cannot estimate, have the values of the fit."""
    linear = np.array([not each.in_forcing for each in problem.model.parameters])
    own = jnp.where(linear & ~held, problem.unknowns.center, values)
    unknowns = dataclasses.replace(problem.unknowns, center=own, free=linear & ~held)
    return EquationError(memory=_MEMORY).solution(dataclasses.replace(problem, unknowns=unknowns))


def validate_on(fit: Fit, other: ShootingProblem, name: str) -> Validation:
    """How well the parameters explain another flight; only its initial state is fitted."""
    other, parameters = eqx.tree_at(lambda p: p.sigma, other, fit.problem.sigma), fit.estimate.parameters
    start, cost, feasible, _ = eqx.filter_jit(fit_start)(padded(other), parameters)
    if not bool(feasible):
        return Validation(name, None, None)
    diagnostics = residual_diagnostics(evaluate(other, parameters, start), fitted=False)
    return Validation(name, finite_or_none(cost), channel_fits(other, diagnostics))
