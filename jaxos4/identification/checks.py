"""The checks of an answer: the estimate of each quantity, the doubts about it, and its verdict."""

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from .._custom_types import as_float
from ..airframe import AXES, PITCH, ROLL, YAW
from ..analysis.diagnostics import residual_correlations, residual_diagnostics
from ..analysis.frequency_response import frequency_response
from ..analysis.identifiability import identifiability
from ..analysis.prediction import Predictions
from ..analysis.traces import os4_traces
from ..bracket import GAUSSIAN_PRIOR
from ..estimate import AbstractEstimator
from ..flight import CHANNEL_NAMES
from ..recording.motion import OVER_NOISE, WEAK
from ..results import result_names
from ..shooting import with_room
from .answers import Answer, channel_fits, overwhelmed, parameter_table, rigid_body, vehicle_constants
from .data import Data, Progress
from .doubts import doubts_of_log, doubts_of_os4, doubts_of_vehicle
from .held_out import predict_held_out, validate_on, vehicle_traces
from .quantities import os4_quantities, vehicle_quantities
from .results import Identification, RigidBody, SampleTime
from .tables import finite_or_none
from .verdict import CONTRADICTED, judge

# Predictions that a result keeps: those of four minutes, 200 kB of a page.
_MOST_STARTS, _MOST_TRAJECTORIES = 1200, 40


def _identified(
    data: Data, answer: Answer, estimator: str, model: str, notes: Sequence[str] = (), **checked: Any
) -> Identification:
    """The result of an answer, with the fields that were `checked`. `notes`: what could not be checked."""
    free, sigma = answer.free, np.asarray(answer.problem.sigma)
    covariance = np.asarray(answer.estimate.covariance)[np.ix_(free, free)]
    return Identification(
        estimator=estimator,
        model=model,
        rollouts=answer.rollouts,
        cost=finite_or_none(answer.estimate.cost),
        provenance=msgspec.structs.replace(data.provenance, notes=[*data.provenance.notes, *notes]),
        covariance=covariance.tolist() if np.isfinite(covariance).all() else None,
        airframe=answer.problem.model.airframe,
        estimate=answer.estimate,
        problem=answer.problem,
        held=answer.fixed,
        noise={CHANNEL_NAMES[i]: float(sigma[i]) for i in answer.problem.columns},
        disturbances=answer.disturbances,
        widened=answer.widened,
        **checked,
    )


def check_os4(data: Data, answer: Answer, estimator: AbstractEstimator, name: str, model: str) -> Identification:
    """The checked result of a flight of an OS4, which the estimator of this `name` searched."""
    own = data, answer, name, model
    names, search = answer.problem.unknowns.names, str(result_names(answer.estimate.result))
    missing, limits, fit, traces, correlations = {}, dict.fromkeys(names), {}, None, None
    if (found := answer.evaluation) is not None:
        fit = channel_fits(answer.problem, residual_diagnostics(found))
        information = identifiability(found, answer.problem.unknowns.bracket)
        notes, known = information.notes(names), information.identifiable & information.excited
        missing = {name: notes[name] for i, name in enumerate(names) if not known[i] and name in notes}
        limits = {name: finite_or_none(x) for name, x in zip(names, information.noise_limit, strict=True)}
        if found.feasible:
            errors = np.where(np.isnan(found.measured), np.nan, found.errors)[:, : found.problem.size]
            traces, correlations = os4_traces(found), residual_correlations(errors, found.torques)
    table = {
        name: msgspec.structs.replace(row, noise_limit=limits[name])
        for name, row in parameter_table(answer, estimator.prior, missing).items()
    }
    if not answer.answered:
        return _identified(*own, parameters=table, result=search, doubts=tuple(doubts_of_log(data.findings)))
    body = rigid_body(answer)
    # The answer of a method that does not shoot is not the best fit, so its residuals are not white.
    doubts = doubts_of_os4(data, search, table, body, fit if estimator.shoots else {})
    judged = judge(os4_quantities(table, body), doubts)
    # Alphas were asked, and not the rigid body. What an OS4 flight does not show is no fault of the answer.
    wrong = [name for name in table if judged.verdicts[name].status == CONTRADICTED]
    return _identified(
        *own,
        parameters=table,
        rigid_body=body,
        verdicts=judged.verdicts,
        doubts=tuple(doubts),
        result=judged.result(search, wrong if search == "successful" else table),
        fit=fit,
        validation=None if data.held_out is None else validate_on(answer, data.held_out),
        traces=traces,
        correlations=correlations,
    )


def check_vehicle(
    data: Data, answer: Answer, sample_times: Sequence[SampleTime], name: str, progress: Progress
) -> Identification:
    """The result of a vehicle, checked against the airframe, other sample times, and measurements that were not fitted.

    `sample_times`: that of the answer is among them. `name`: of the estimator.
    """
    search, optimum = str(result_names(answer.estimate.result)), answer.optimum
    own = data, answer, name, "flight"
    several = tuple(sample_times) if len(sample_times) > 1 else ()
    if not answer.answered or optimum is None:
        return _identified(
            *own, parameters={}, result=search, doubts=tuple(doubts_of_log(data.findings)), sample_times=several
        )
    table, body = parameter_table(answer, GAUSSIAN_PRIOR), vehicle_constants(answer)
    predicted = paths = skill = None
    if data.held_out is not None:
        progress("predicting what was not fitted")
        predicted, paths, skill = predict_held_out(data, answer, optimum.noise, data.held_out)
    still = () if predicted is None else _still_axes(answer, predicted)
    notes = (
        f"the held-out part hardly turns about {' and '.join(still)}; choose another with `begin`, `end` or `validate`",
    ) * (0 < len(still) < len(AXES))
    if YAW.motion in overwhelmed(answer):
        # Vehicles hardly yaw. The other axes do not need it.
        body = RigidBody({name: row for name, row in body.constants.items() if name != YAW.inertia})
        said = "not identified: the disturbance is larger"
        of_yaw = {YAW.coupling, YAW.inverse} & table.keys()
        table |= {name: msgspec.structs.replace(table[name], note=said) for name in of_yaw}
        still = (*still, *({YAW.motion} - {*still}))
    values = as_float(np.asarray(answer.estimate.parameters)[: answer.problem.unknowns.count])
    response = frequency_response(with_room(answer.problem, data.room), values)
    quantities = vehicle_quantities(answer, table, body.constants, skill, still)
    doubts = doubts_of_vehicle(
        data, answer, optimum, sample_times, table, body.constants, quantities, response, skill=skill, still=still
    )
    judged = judge(quantities, doubts)
    predicted, paths = (None if each is None else each.thinned(_MOST_STARTS) for each in (predicted, paths))
    traces, correlations = vehicle_traces(data, answer, optimum, predicted)
    return _identified(
        *own,
        notes,
        parameters=table,
        rigid_body=body,
        verdicts=judged.verdicts,
        doubts=tuple(doubts),
        result=judged.result(search, (ROLL.inertia, PITCH.inertia)),
        sample_times=several,
        skill=skill,
        predictions=predicted,
        trajectories=None if paths is None else paths.thinned(_MOST_TRAJECTORIES),
        traces=traces,
        correlations=correlations,
        response=response,
    )


def _still_axes(answer: Answer, predicted: Predictions) -> tuple[str, ...]:
    """The axes about which the held-out part hardly turns, or about which it was not measured."""
    still = []
    for axis, measured in zip(AXES, np.moveaxis(predicted.measured, 2, 0), strict=True):
        noise = answer.disturbances[axis.rate].sensor if axis.rate in answer.disturbances else 0.0
        seen = measured[np.isfinite(measured)]
        if not seen.size or seen.std() < max(WEAK, OVER_NOISE * noise):
            still.append(axis.motion)
    return tuple(still)
