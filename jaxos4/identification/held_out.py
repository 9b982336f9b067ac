"""Predictions of measurements that were not fitted."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Numeric, as_float
from .._xla import compiled_cheaply
from ..analysis.diagnostics import Correlations, residual_correlations, residual_diagnostics
from ..analysis.evaluation import evaluate
from ..analysis.frequency_response import modelled_acceleration
from ..analysis.prediction import HORIZONS, Predictions, filtered, predictions, skill, trajectory_horizons
from ..analysis.traces import Traces, position_of
from ..estimate import fit_start
from ..estimators import EquationError
from ..flight import RATES
from ..models.flight_model import without_recording
from ..shooting import ShootingProblem, padded, with_room
from ..shooting.gains import LogNoise
from .answers import Answer, channel_fits
from .data import Data, HeldOut
from .results import PredictionSkill, RateSkill, Validation
from .search import Optimum
from .tables import finite_or_none

REGRESSION = EquationError(memory=0.9)
"""For comparison. This memory is the best on real flights."""


def predict_held_out(
    data: Data, answer: Answer, noise: LogNoise, held_out: HeldOut
) -> tuple[Predictions, Predictions, PredictionSkill]:
    """Predict the rates of measurements that were not fitted, by the answer and by a regression with the same terms.

    The answer, with the `noise` of its filters, predicts the disturbance too, from the measurements before each start.

    **Returns:** its predictions at `HORIZONS`; those between start and end, as trajectories; and the skill.
    """
    problem, names = held_out.problem, answer.problem.unknowns.names
    values = np.asarray(answer.estimate.parameters)[: len(names)]

    def predicted_by(values: np.ndarray, noise: LogNoise | None, horizons: tuple[float, ...] = HORIZONS) -> Predictions:
        parameters = values
        if held_out.recording is not None:  # the mean of those of which each fitted recording has its own
            shared = np.array([without_recording(name) for name in names])
            parameters = np.array([values[shared == name].mean() for name in problem.unknowns.names])
        known = None
        if noise is not None:
            known, _ = _disturbances(data, _together(data, held_out), parameters, noise)
        return predictions(problem, as_float(parameters), horizons=horizons, disturbance=known, noise=noise)

    every = predicted_by(values, noise, (*HORIZONS, *trajectory_horizons(float(problem.flight.dt))))
    predicted, trajectories = every.at(np.s_[: len(HORIZONS)]), every.at(np.s_[len(HORIZONS) :])
    own, fixed = skill(predicted), [name in answer.fixed for name in names]
    regressed = np.asarray(_regressed(with_room(answer.problem, data.room), as_float(values), np.asarray(fixed)))
    compared = skill(predicted_by(regressed, None))
    tables = (own.skill, own.std, own.rmse, own.persistence, compared.skill)
    rates = {
        rate: RateSkill(*([finite_or_none(x) for x in table[:, i]] for table in tables)) for i, rate in enumerate("pqr")
    }
    return predicted, trajectories, PredictionSkill(predicted.horizons.tolist(), own.starts, **rates)


def _together(data: Data, held_out: HeldOut) -> ShootingProblem:
    """The problem with all measurements: those that were fitted, and those that were held out of the same flight."""
    if held_out.recording is not None:
        return held_out.problem
    own, others = np.asarray(held_out.problem.flight.states), np.asarray(data.problem.flight.states)
    both = as_float(np.where(np.isnan(own), others, own))
    return eqx.tree_at(lambda p: p.flight.states, held_out.problem, both)


def _disturbances(
    data: Data, problem: ShootingProblem, parameters: np.ndarray, noise: LogNoise
) -> tuple[Float[np.ndarray, "samples 3"], Float[np.ndarray, "samples 3"]]:
    """The disturbance of each body rate [rad/s^2] and its innovation [rad/s; NaN: not measured] at each sample.

    Filters know the disturbance from the measurements until the sample. An innovation is a measured rate less its
    prediction from the sample before. The model is evaluated at the measured rates.
    """
    samples = problem.flight.time.shape[0]
    problem = with_room(problem, max(samples, data.room))
    flight, rates = problem.flight, np.asarray(problem.flight.states)[:, RATES]
    modelled = np.pad(modelled_acceleration(problem, as_float(parameters)), ((0, 1), (0, 0)))
    of_rates = jax.tree.map(lambda leaf: as_float(np.asarray(leaf)[: len(RATES)]), noise)
    known, innovation = filtered(of_rates, rates, modelled, flight.stretch_numbers, flight.dt)
    return np.asarray(known.disturbance)[:samples], np.asarray(innovation)[:samples]


def vehicle_traces(
    data: Data, answer: Answer, optimum: Optimum, predicted: Predictions | None
) -> tuple[Traces, Correlations]:
    """The signals of the fitted flights, and the correlations of the innovations.

    `predicted`: the predictions that the result keeps.
    """
    other = data.held_out
    problem = answer.problem if other is None or other.recording is not None else _together(data, other)
    values = np.asarray(answer.estimate.parameters)[: answer.problem.unknowns.count]
    disturbance, innovation = _disturbances(data, problem, values, optimum.noise)
    flight = answer.problem.flight
    states, omega = np.asarray(flight.states, float), np.asarray(flight.omega, float)
    position = position_of(np.asarray(problem.flight.states, float))
    start = np.zeros(0, int) if predicted is None else predicted.start
    clock = data.clock if other is None or other.recording is None else other.clock
    signals = omega, states[:, RATES], states[:, :0], disturbance, position
    traces = Traces(data.clock.time, data.clock.log, *signals, clock.time[start], clock.log[start])
    torques = omega**2 @ np.asarray(answer.problem.model.airframe.mixer)[:3].T
    crossed = residual_correlations(innovation, torques)
    if (parts := optimum.estimate.parts) is not None:
        # Of the innovations of the likelihood itself, which is exact for means.
        products = np.asarray(parts.products).sum(axis=0)[:3]
        crossed = msgspec.structs.replace(crossed, own=products[:, 1:] / np.maximum(products[:, :1], 1.0))
    return traces.thinned(), crossed


@compiled_cheaply
def _regressed(problem: ShootingProblem, values: Array, fixed: Numeric) -> Array:
    """The parameters by regression; fixed ones, and those that it cannot estimate, have the values of the fit."""
    linear = np.array([not each.in_forcing for each in problem.model.parameters])
    own = jnp.where(linear & ~fixed, problem.unknowns.center, values)
    unknowns = dataclasses.replace(problem.unknowns, center=own, free=linear & ~fixed)
    return REGRESSION.solution(dataclasses.replace(problem, unknowns=unknowns))


def validate_on(answer: Answer, held_out: HeldOut) -> Validation:
    """The fit of the parameters to another flight, of which only the initial state is estimated."""
    other, name = eqx.tree_at(lambda p: p.sigma, held_out.problem, answer.problem.sigma), held_out.recording or ""
    start, cost, feasible, _ = eqx.filter_jit(fit_start)(padded(other), answer.estimate.parameters)
    if not bool(feasible):
        return Validation(name, None, None)
    diagnostics = residual_diagnostics(evaluate(other, answer.estimate.parameters, start), fitted=False)
    return Validation(name, finite_or_none(cost), channel_fits(other, diagnostics))
