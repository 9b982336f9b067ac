"""Judges answers: verdicts with the issues behind them, and predictions of measurements that were not fitted."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Numeric, as_float, finite_or_none
from .._xla import compiled_cheaply
from ..airframe import AXES, INERTIAS, MOTIONS, PITCH, ROLL, YAW
from ..analysis.diagnostics import Correlations, Diagnostics, residual_correlations, residual_diagnostics
from ..analysis.evaluation import evaluate, identifiability
from ..analysis.frequency_response import frequency_response, modelled_acceleration
from ..analysis.inertia import fit_inertia
from ..analysis.prediction import HORIZONS, Predictions, filtered, predictions, skill, trajectory_horizons
from ..analysis.traces import Traces, os4_traces, position_of
from ..bracket import GAUSSIAN_PRIOR
from ..estimate import AbstractEstimator, fit_start
from ..estimators import EquationError
from ..flight import CHANNEL_NAMES, RATES, STATE_NAMES, STATE_UNITS
from ..models import MODELS
from ..models.flight_model import without_recording
from ..models.state import CASCADE_ORDER
from ..recording.motion import OVER_NOISE, WEAK
from ..results import result_names
from ..shooting import ShootingProblem, padded
from ..shooting.gains import LogNoise
from .answers import (
    UNIT,
    Answer,
    OS4Answer,
    VehicleAnswer,
    dominated,
    parameter_notes,
    parameter_table,
    shared_fields,
    vehicle_constants,
)
from .data import Data, HeldOut, Progress, class_name, silent
from .issues import issues_of_log, issues_of_os4, issues_of_vehicle
from .quantities import os4_quantities, vehicle_quantities
from .results import (
    ChannelFit,
    Constant,
    OS4Identification,
    ParameterEstimate,
    PredictionSkill,
    RateSkill,
    RigidBody,
    SampleTime,
    Validation,
    VehicleIdentification,
)
from .verdict import CONTRADICTED, result_of, verdicts_of

# Predictions that a result keeps. They cover four minutes and take 200 kB of a page.
_MOST_STARTS, _MOST_TRAJECTORIES = 1200, 40
REGRESSION = EquationError(memory=0.9)
"""The regression with which predictions are compared. This memory is the best on real flights."""
REQUIRED = ROLL.inertia, PITCH.inertia
"""The quantities that decide the result code of a vehicle. Iz is not: it also needs the rotors' drag."""


def judge_os4(data: Data, answer: OS4Answer, estimator: AbstractEstimator, name: str) -> OS4Identification:
    """The result for an OS4, with rigid body, issues and verdicts. `name`: the estimator's name."""
    search, flown = str(result_names(answer.estimate.result)), answer.evaluation
    found = OS4Identification(
        model=class_name(answer.problem.model, MODELS),
        parameters=_alphas(answer, estimator.largest_std),
        result=search,
        issues=tuple(issues_of_log(data.findings)),
        **shared_fields(data, answer, name),
    )
    if flown is None or answer.diagnostics is None:
        return found
    errors = np.where(np.isnan(flown.measured), np.nan, flown.errors)[:, : flown.problem.size]
    found = msgspec.structs.replace(
        found,
        rigid_body=_rigid_body(answer),
        fit=_channel_fits(answer.problem, answer.diagnostics),
        validation=None if data.held_out is None else _validate_on(answer, data.held_out),
        traces=os4_traces(flown) if flown.feasible else None,
        correlations=residual_correlations(errors, flown.torques) if flown.feasible else None,
    )
    # The answer of a method that does not shoot is not the best fit, so its residuals are not white.
    issues = issues_of_os4(data, found, found.fit if estimator.shoots else {})
    estimated = {name: row for name, row in found.parameters.items() if row.estimate is not None}
    notes = {name: parameter_notes(answer, name, row) for name, row in estimated.items()}
    verdicts = verdicts_of(os4_quantities(found, notes), issues)
    # Only the alphas were requested. An alpha that the flight does not show is no fault of the answer.
    wrong = [name for name in found.parameters if verdicts[name].status == CONTRADICTED]
    result = result_of(verdicts, issues, search, wrong if search == "successful" else found.parameters)
    return msgspec.structs.replace(found, verdicts=verdicts, issues=tuple(issues), result=result)


def _alphas(answer: OS4Answer, largest_std: float) -> dict[str, ParameterEstimate]:
    """The estimate of each alpha, with the noise above which it cannot be distinguished from 0."""
    names, missing, limits = answer.problem.unknowns.names, {}, {}
    if answer.evaluation is not None:
        information = identifiability(answer.evaluation, answer.problem.unknowns.bracket)
        notes, known = information.notes(names), information.identifiable & information.excited
        missing = {name: notes[name] for i, name in enumerate(names) if not known[i] and name in notes}
        limits = {name: finite_or_none(x) for name, x in zip(names, information.noise_limit, strict=True)}
    table = parameter_table(answer, largest_std, missing)
    return {name: msgspec.structs.replace(row, noise_limit=limits.get(name)) for name, row in table.items()}


def _rigid_body(answer: Answer) -> RigidBody:
    """The moments of inertia that explain the alphas best; none if they are not identifiable."""
    rigid = fit_inertia(answer.problem.model, answer.estimate.parameters, answer.estimate.covariance)
    values, std = np.asarray(rigid.constants), np.asarray(rigid.std)
    if not np.isfinite(std).all() or (std > np.abs(values))[:3].any():
        return RigidBody()
    table = zip((*INERTIAS, "J_R"), values.tolist(), std.tolist(), strict=True)
    constants = {name: Constant(value, error, UNIT) for name, value, error in table}
    return RigidBody(constants, consistency_p=float(rigid.p_value), is_rigid_body=bool(rigid.is_rigid_body))


def _validate_on(answer: Answer, held_out: HeldOut) -> Validation:
    """The fit of the parameters to another flight; only its initial state is estimated."""
    other, name = eqx.tree_at(lambda p: p.sigma, held_out.problem, answer.problem.sigma), held_out.recording or ""
    start, cost, feasible, _ = eqx.filter_jit(fit_start)(padded(other), answer.estimate.parameters)
    if not bool(feasible):
        return Validation(name, None, None)
    diagnostics = residual_diagnostics(evaluate(other, answer.estimate.parameters, start), fitted=False)
    return Validation(name, finite_or_none(cost), _channel_fits(other, diagnostics))


def _channel_fits(problem: ShootingProblem, diagnostics: Diagnostics) -> dict[str, ChannelFit]:
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
            input_correlation=dict(zip(MOTIONS, diagnostics.input_correlation[i].tolist(), strict=True)),
            input_p=float(diagnostics.input_p[i]),
        )
        for i, column in enumerate(CASCADE_ORDER[: problem.size])
        if diagnostics.count[i] > 2
    }


def judge_vehicle(
    answer: VehicleAnswer, sample_times: Sequence[SampleTime], estimator: str, *, progress: Progress = silent
) -> VehicleIdentification:
    """The result of a vehicle, checked against the airframe, other sample times, and measurements that were not fitted.

    `sample_times`: those of `fit_vehicle`, including the answer's. `estimator`: the estimator's name.
    """
    progress("checking the answer")
    search, data = str(result_names(answer.estimate.result)), answer.optimum.data
    found = VehicleIdentification(
        parameters={},
        result=search,
        issues=tuple(issues_of_log(data.findings)),
        sample_times=tuple(sample_times) if len(sample_times) > 1 else (),
        held=dict(answer.fixed),
        noise={CHANNEL_NAMES[i]: float(np.asarray(answer.problem.sigma)[i]) for i in answer.problem.columns},
        disturbances=dict(answer.disturbances),
        widened=dict(answer.widened),
        **shared_fields(data, answer, estimator),
    )
    if not answer.answered:
        return found
    predicted = paths = achieved = None
    if data.held_out is not None:
        progress("predicting what was not fitted")
        predicted, paths, achieved = predict_held_out(answer, data.held_out)
    still = () if predicted is None else _still_axes(answer, predicted)
    notes = data.provenance.notes
    if 0 < len(still) < len(AXES):
        hardly = f"the held-out part hardly turns about {' and '.join(still)}"
        notes = [*notes, f"{hardly}; choose another with `begin`, `end` or `validate`"]
    table, body = parameter_table(answer, GAUSSIAN_PRIOR), vehicle_constants(answer)
    if YAW.motion in dominated(answer):
        # Vehicles hardly yaw, and the other axes do not need Iz.
        body = RigidBody({name: row for name, row in body.constants.items() if name != YAW.inertia})
        said = "not identified: the disturbance is larger"
        of_yaw = {YAW.coupling, YAW.inverse} & table.keys()
        table |= {name: msgspec.structs.replace(table[name], note=said) for name in of_yaw}
        still = (*still, *({YAW.motion} - {*still}))
    response = frequency_response(in_one_window(answer.problem), as_float(answer.parameters))
    predicted, paths = (None if each is None else each.thinned(_MOST_STARTS) for each in (predicted, paths))
    traces, correlations = vehicle_traces(answer, predicted)
    found = msgspec.structs.replace(
        found,
        provenance=msgspec.structs.replace(data.provenance, notes=notes),
        parameters=table,
        rigid_body=body,
        skill=achieved,
        predictions=predicted,
        trajectories=None if paths is None else paths.thinned(_MOST_TRAJECTORIES),
        traces=traces,
        correlations=correlations,
        response=response,
    )
    quantities = vehicle_quantities(answer, found, still)
    issues = issues_of_vehicle(answer, found, response, sample_times=sample_times, quantities=quantities, still=still)
    verdicts = verdicts_of(quantities, issues)
    result = result_of(verdicts, issues, search, REQUIRED)
    return msgspec.structs.replace(found, verdicts=verdicts, issues=tuple(issues), result=result)


def _still_axes(answer: VehicleAnswer, predicted: Predictions) -> tuple[str, ...]:
    """The axes about which the held-out part hardly turns, or whose rate was not measured there."""
    still = []
    for axis, measured in zip(AXES, np.moveaxis(predicted.measured, 2, 0), strict=True):
        noise = answer.disturbances[axis.rate].sensor if axis.rate in answer.disturbances else 0.0
        seen = measured[np.isfinite(measured)]
        if not seen.size or seen.std() < max(WEAK, OVER_NOISE * noise):
            still.append(axis.motion)
    return tuple(still)


def predict_held_out(answer: VehicleAnswer, held_out: HeldOut) -> tuple[Predictions, Predictions, PredictionSkill]:
    """Predict held-out body rates, by the answer and by a regression with the same terms.

    The answer's filters predict the disturbance too, from the measurements before each start.

    **Returns:** the answer's predictions at `HORIZONS`; its predictions in between, as trajectories; and the skill.
    """
    data, problem, names = answer.optimum.data, held_out.problem, answer.problem.unknowns.names

    def predicted_by(values: np.ndarray, noise: LogNoise | None, horizons: tuple[float, ...] = HORIZONS) -> Predictions:
        parameters = values
        if held_out.recording is not None:  # average the parameters that differ between the fitted recordings
            shared = np.array([without_recording(name) for name in names])
            parameters = np.array([values[shared == name].mean() for name in problem.unknowns.names])
        known = None
        if noise is not None:
            known, _ = _disturbances(_together(data, held_out), parameters, noise)
        return predictions(problem, as_float(parameters), horizons=horizons, disturbance=known, noise=noise)

    horizons = (*HORIZONS, *trajectory_horizons(float(problem.flight.dt)))
    every = predicted_by(answer.parameters, answer.optimum.noise, horizons)
    predicted, trajectories = every.at(np.s_[: len(HORIZONS)]), every.at(np.s_[len(HORIZONS) :])
    own, fixed = skill(predicted), [name in answer.fixed for name in names]
    regressed = np.asarray(_regressed(in_one_window(answer.problem), as_float(answer.parameters), np.asarray(fixed)))
    compared = skill(predicted_by(regressed, None))
    tables = (own.skill, own.std, own.rmse, own.persistence, compared.skill)
    rates = {
        rate: RateSkill(*([finite_or_none(x) for x in table[:, i]] for table in tables)) for i, rate in enumerate("pqr")
    }
    return predicted, trajectories, PredictionSkill(predicted.horizons.tolist(), own.starts, **rates)


def in_one_window(problem: ShootingProblem) -> ShootingProblem:
    """The padded problem of a vehicle's flight, so that flights of other lengths share the programs that check them.

    These checks do not simulate, so windows do not matter.
    """
    return padded(dataclasses.replace(problem, windows=1))


def _together(data: Data, held_out: HeldOut) -> ShootingProblem:
    """The problem with all measurements of the held-out flight, including those that were fitted."""
    if held_out.recording is not None:
        return held_out.problem
    own, others = np.asarray(held_out.problem.flight.states), np.asarray(data.problem.flight.states)
    both = as_float(np.where(np.isnan(own), others, own))
    return eqx.tree_at(lambda p: p.flight.states, held_out.problem, both)


def _disturbances(
    problem: ShootingProblem, parameters: np.ndarray, noise: LogNoise
) -> tuple[Float[np.ndarray, "samples 3"], Float[np.ndarray, "samples 3"]]:
    """The disturbance of each body rate [rad/s^2] and its innovation [rad/s; NaN: not measured] at each sample.

    Filters estimate the disturbance from the measurements up to each sample. An innovation is a measured rate minus
    its prediction from the sample before. The model is evaluated at the measured rates.
    """
    samples = problem.flight.time.shape[0]
    problem = in_one_window(problem)
    flight, rates = problem.flight, np.asarray(problem.flight.states)[:, RATES]
    modelled = np.pad(modelled_acceleration(problem, as_float(parameters)), ((0, 1), (0, 0)))
    of_rates = jax.tree.map(lambda leaf: as_float(np.asarray(leaf)[: len(RATES)]), noise)
    known, innovation = filtered(of_rates, rates, modelled, flight.stretch_numbers, flight.dt)
    return np.asarray(known.disturbance)[:samples], np.asarray(innovation)[:samples]


def vehicle_traces(answer: VehicleAnswer, predicted: Predictions | None) -> tuple[Traces, Correlations]:
    """The signals of the fitted flights, and the correlations of the innovations.

    `predicted`: the predictions that the result keeps.
    """
    optimum, data = answer.optimum, answer.optimum.data
    other = data.held_out
    problem = answer.problem if other is None or other.recording is not None else _together(data, other)
    disturbance, innovation = _disturbances(problem, answer.parameters, optimum.noise)
    flight = answer.problem.flight
    states, omega = np.asarray(flight.states, float), np.asarray(flight.omega, float)
    position = position_of(np.asarray(problem.flight.states, float))
    start = np.zeros(0, int) if predicted is None else predicted.start
    signals = omega, states[:, RATES], states[:, :0], disturbance, position
    starts = data.time[start], data.log[start]
    if other is not None and other.recording is not None:  # its log comes after the fitted ones
        starts = other.time[start], np.full(start.size, len(data.provenance.flights or ()))
    traces = Traces(data.time, data.log, *signals, *starts)
    torques = omega**2 @ np.asarray(answer.problem.model.airframe.mixer)[:3].T
    crossed = residual_correlations(innovation, torques)
    if (parts := optimum.estimate.parts) is not None:
        # The innovations of the likelihood itself are exact for means.
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
