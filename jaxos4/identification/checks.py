"""The checks of an answer: the estimate of each quantity, the doubts about it, and its verdict."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import msgspec
import numpy as np

from .._custom_types import as_float
from ..analysis.diagnostics import Correlations, residual_correlations, residual_diagnostics
from ..analysis.frequency_response import FrequencyResponse, frequency_response
from ..analysis.identifiability import identifiability
from ..analysis.prediction import Predictions
from ..analysis.traces import Traces, flight_traces
from ..bracket import GAUSSIAN_PRIOR
from ..estimators import FilterError
from ..recording.motion import EXCITED
from ..results import meaning, result_names
from ..shooting import with_room
from .answers import AXES, INVERSE, Answer, channel_fits, overwhelmed, parameter_table, rigid_body, vehicle_constants
from .data import Data, Progress
from .doubts import (
    contradicted,
    doubts_of,
    doubts_of_log,
    few_parts,
    moved_by_sample_time,
    moves_between,
    neighbours,
    stronger_or_weaker,
    vibration,
)
from .held_out import predict_held_out, validate_on, vehicle_traces
from .quantities import doubts_of_flight, flight_quantities, vehicle_quantities
from .results import (
    ChannelFit,
    Constant,
    ParameterEstimate,
    PredictionSkill,
    RigidBody,
    SampleTime,
    Validation,
    finite_or_none,
)
from .search import Optimum, deviations
from .uncertainty import PROFILE
from .verdict import CONTRADICTED, RIGID_BODY, Doubt, Move, Quantity, Verdict, outcome, verdict_of

# Predictions that a result keeps: those of four minutes, 200 kB of a page.
_MOST_STARTS, _MOST_TRAJECTORIES = 1200, 40
_OF_YAW = ("alpha7", "alpha8")
_NOT_LOWEST = Doubt(
    "max_sweeps",
    "the likelihood has several maxima, and the search did not find the highest",
    "fly more roll, pitch and yaw, or choose another part with `begin` and `end`",
)


class Checked(NamedTuple):
    """An answer in physical quantities, with what speaks for and against each: the fields of an `Identification`.

    `notes`: what could not be checked.
    """

    parameters: dict[str, ParameterEstimate]
    result: str
    rigid_body: RigidBody = RigidBody()
    verdicts: dict[str, Verdict] = {}
    doubts: tuple[Doubt, ...] = ()
    notes: tuple[str, ...] = ()
    fit: dict[str, ChannelFit] = {}
    validation: Validation | None = None
    skill: PredictionSkill | None = None
    predictions: Predictions | None = None
    trajectories: Predictions | None = None
    response: FrequencyResponse | None = None
    traces: Traces | None = None
    correlations: Correlations | None = None


def check_flight(data: Data, answer: Answer, prior: float) -> Checked:
    """The checks of a flight of an OS4. `prior`: how the estimator uses the bracket."""
    names, search = answer.problem.unknowns.names, str(result_names(answer.estimate.result))
    reasons, limits, fit, traces, correlations = {}, dict.fromkeys(names), {}, None, None
    if (found := answer.evaluation) is not None:
        fit = channel_fits(answer.problem, residual_diagnostics(found))
        information = identifiability(found, answer.problem.unknowns.bracket)
        notes, known = information.notes(names), information.identifiable & information.excited
        reasons = {name: notes[name] for i, name in enumerate(names) if not known[i] and name in notes}
        limits = {name: finite_or_none(x) for name, x in zip(names, information.noise_limit, strict=True)}
        if found.feasible:
            errors = np.where(np.isnan(found.measured), np.nan, found.errors)[:, : found.problem.size]
            traces, correlations = flight_traces(found), residual_correlations(errors, found.torques)
    table = {
        name: msgspec.structs.replace(row, noise_limit=limits[name])
        for name, row in parameter_table(answer, prior, reasons).items()
    }
    if not answer.answered:
        return Checked(table, search, doubts=tuple(doubts_of_log(data.findings)))
    body = rigid_body(answer)
    doubts = [*doubts_of_flight(table, body, data.findings), *_doubts_of_search(search, (*table, RIGID_BODY))]
    verdicts = verdicts_of(flight_quantities(table, body), doubts)
    # What an OS4 flight does not show is no fault of the answer.
    wrong = [name for name, verdict in verdicts.items() if verdict.status == CONTRADICTED]
    return Checked(
        parameters=table,
        rigid_body=body,
        verdicts=verdicts,
        doubts=tuple(doubts),
        result=outcome(search, wrong if search == "successful" else tuple(verdicts), verdicts, doubts),
        fit=fit,
        validation=None if data.held_out is None else validate_on(answer, data.held_out),
        traces=traces,
        correlations=correlations,
    )


def check_vehicle(data: Data, answer: Answer, sample_times: Sequence[SampleTime], progress: Progress) -> Checked:
    """The checks of a vehicle: against the airframe, other sample times, and measurements that were not fitted.

    `sample_times`: that of the answer is among them.
    """
    search, optimum = str(result_names(answer.estimate.result)), answer.optimum
    if not answer.answered or optimum is None:
        return Checked({}, search, doubts=tuple(doubts_of_log(data.findings)))
    table, body = parameter_table(answer, GAUSSIAN_PRIOR), vehicle_constants(answer)
    predicted = paths = skill = None
    if data.held_out is not None:
        progress("predicting what was not fitted")
        predicted, paths, skill = predict_held_out(data, answer, optimum.noise, data.held_out)
    still = () if predicted is None else _still_axes(answer, predicted)
    notes = (
        f"the held-out part hardly turns about {' and '.join(still)}; choose another with `begin`, `end` or `validate`",
    ) * (0 < len(still) < len(AXES))
    weak, trusted = overwhelmed(answer), table
    if "yaw" in weak:
        # Vehicles hardly yaw. The other axes do not need it.
        body = RigidBody({name: row for name, row in body.constants.items() if name != "Iz"})
        trusted = {name: row for name, row in table.items() if name not in _OF_YAW}
        said = "not identified: the disturbance is larger"
        table |= {name: msgspec.structs.replace(table[name], note=said) for name in _OF_YAW if name in table}
        still = (*still, *({"yaw"} - {*still}))
    values = as_float(np.asarray(answer.estimate.parameters)[: answer.problem.unknowns.count])
    response = frequency_response(with_room(answer.problem, data.room), values)
    doubts = [
        *doubts_of_log(data.findings),
        *few_parts(data.seconds),
        *_doubts_of_weak_axes(weak),
        *_doubts_of_answer(data, answer, optimum, trusted, body.constants, skill, still),
        *_doubts_of_sample_time(answer, sample_times, body.constants),
        *stronger_or_weaker(response, body.constants),
    ]
    quantities = vehicle_quantities(answer, table, body.constants, skill, still)
    if not optimum.is_lowest:
        doubts.insert(0, msgspec.structs.replace(_NOT_LOWEST, moves=dict.fromkeys(quantities)))
    doubts += _doubts_of_search(search, quantities)
    verdicts = verdicts_of(quantities, doubts)
    predicted, paths = (None if each is None else each.thinned(_MOST_STARTS) for each in (predicted, paths))
    traces, correlations = vehicle_traces(data, answer, optimum, predicted)
    return Checked(
        parameters=table,
        rigid_body=body,
        verdicts=verdicts,
        doubts=tuple(doubts),
        result=outcome(search, ("Ix", "Iy"), verdicts, doubts),
        notes=notes,
        skill=skill,
        predictions=predicted,
        trajectories=None if paths is None else paths.thinned(_MOST_TRAJECTORIES),
        traces=traces,
        correlations=correlations,
        response=response,
    )


def _doubts_of_search(search: str, quantities: Iterable[str]) -> Iterator[Doubt]:
    """The doubt about a search that did not end well. `search`: the name of its result code."""
    if search != "successful":
        cause, remedy = meaning(search).rsplit(": ", 1)
        yield Doubt(search, cause, remedy, dict.fromkeys(quantities))


def _doubts_of_weak_axes(weak: Mapping[str, str]) -> Iterator[Doubt]:
    """The doubts about axes on which disturbances are larger than the torque of the rotors; see `overwhelmed`."""
    inertias = dict(zip(AXES.values(), INVERSE, strict=True))
    for axis, why in weak.items():
        yield Doubt("unidentifiable", why, f"fly more {axis}, or in calmer air", {inertias[axis]: None})


def _doubts_of_answer(
    data: Data,
    answer: Answer,
    optimum: Optimum,
    trusted: dict[str, ParameterEstimate],
    constants: dict[str, Constant],
    skill: PredictionSkill | None,
    still: Sequence[str],
) -> Iterator[Doubt]:
    """The doubts about parameters, moments of inertia and predictions. `trusted`: the parameters that are judged."""
    model, own = answer.problem.model, optimum.whole
    widths = dict(zip(own.names, np.asarray(own.half_width).tolist(), strict=True))
    # What is known of a fixed one is its bracket.
    fixed = {name: (row.value, widths[name]) for name, row in answer.fixed.items()} | answer.negative
    yield from (doubt for _, doubt in contradicted(model, fixed))
    yield from doubts_of(
        model, trusted, constants, skill, still, data.log_step, partial(consequences, answer, optimum, constants)
    )


def _doubts_of_sample_time(
    answer: Answer, sample_times: Sequence[SampleTime], constants: dict[str, Constant]
) -> Iterator[Doubt]:
    """The doubts about samples that are too short or too long."""
    step = float(answer.problem.flight.dt)
    pair = neighbours(sample_times, step)
    yield from vibration(answer.disturbances, step, moves_between(*pair) if pair else {})
    yield from moved_by_sample_time(*pair, constants) if pair else ()


def verdicts_of(quantities: Mapping[str, Quantity], doubts: Sequence[Doubt]) -> dict[str, Verdict]:
    """The verdict for each quantity. `doubts`: all of the identification."""
    return {name: verdict_of(name, quantity, doubts) for name, quantity in quantities.items()}


def consequences(
    answer: Answer, optimum: Optimum, constants: dict[str, Constant], name: str, value: float
) -> dict[str, Move | None]:
    """The change of each quantity if a parameter is fixed at a value, and all others are fitted again.

    Not by the covariance: under a controller the cost is flat, and an inertia moves two to three times as far. Nothing
    moves if the search did not find this parameter. `None`: there is no such fit.

    **Arguments:** `constants`: the moments of inertia.
    """
    model, own, values = answer.problem.model, optimum.likelihood.problem.unknowns, optimum.values
    if not np.asarray(own.free)[own.names.index(name)]:
        return {}
    other = optimum.restricted(FilterError(tolerance=PROFILE.tolerance), {name: value})
    others = {each: names for each, names in model.quantities.items() if name not in names}
    if not other.converged:
        return dict.fromkeys((*constants, *others))
    moved, std = other.values, deviations(answer.estimate.covariance)
    gains = [i for i, parameter in enumerate(model.parameters) if parameter.scales_torque]
    factor = np.prod(moved[gains] / values[gains])
    moves: dict[str, Move | None] = {}
    for inertia, row in constants.items():
        share = abs(factor * values[INVERSE[inertia]] / moved[INVERSE[inertia]] - 1)
        moves[inertia] = Move(float(share), float(share * row.estimate / row.std))
    for quantity, names in others.items():
        places = [i for i in map(own.names.index, names) if std[i] > 0]
        if places:
            change, width = np.abs(moved - values)[places], np.asarray(own.half_width)[places]
            moves[quantity] = Move(float((change / width).max()), float((change / std[places]).max()))
    return moves


def _still_axes(answer: Answer, predicted: Predictions) -> tuple[str, ...]:
    """The axes about which the held-out part hardly turns, or about which it was not measured."""
    still = []
    for (rate, axis), measured in zip(AXES.items(), np.moveaxis(predicted.measured, 2, 0), strict=True):
        noise = answer.disturbances[rate].sensor if rate in answer.disturbances else 0.0
        seen = measured[np.isfinite(measured)]
        if not seen.size or seen.std() < max(EXCITED.weak, EXCITED.over_noise * noise):
            still.append(axis)
    return tuple(still)
