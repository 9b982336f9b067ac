"""The verdicts about an answer: what speaks against it, and which of its quantities can be trusted all the same."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import msgspec
import numpy as np

from .._custom_types import as_float
from ..analysis.diagnostics import residual_correlations
from ..analysis.frequency_response import frequency_response
from ..analysis.prediction import Predictions
from ..analysis.traces import flight_traces
from ..models.flight_model import FlightModel
from ..recording.motion import EXCITED
from ..results import meaning, result_names
from ..shooting import with_room
from .answers import AXES, INVERSE, overwhelmed, parameter_table, rigid_body, vehicle_constants
from .consequences import consequences
from .doubts import (
    contradicted,
    doubts_of,
    doubts_of_log,
    few_parts,
    moved_by_sample_time,
    moves_between,
    neighbours,
    vibration,
)
from .fit import Fit
from .held_out import predict_held_out, validate_on, vehicle_traces
from .prepare import Case, Progress
from .quantities import doubts_of_flight, flight_quantities, vehicle_quantities
from .results import RigidBody, SampleTime
from .verdict import CONTRADICTED, Doubt, Quantity, outcome, verdict_of

# Predictions that a result keeps: those of four minutes, 200 kB of a page.
_MOST_STARTS = 1200
_OF_YAW = ("alpha7", "alpha8")
_NOT_LOWEST = Doubt(
    "max_sweeps",
    "the likelihood has several maxima, and the search did not find the highest",
    "fly more roll, pitch and yaw, or choose another part with `begin` and `end`",
)


def judge(case: Case, fit: Fit, sample_times: Sequence[SampleTime] = (), *, progress: Progress) -> dict[str, Any]:
    """Compare an answer with the airframe, with other sample times, and with measurements that were not fitted.

    `sample_times`: of a vehicle; the one of the fit is among them.

    **Returns:** the fields of an `Identification` for the answer, and for what speaks for and against it. `notes`: what
    could not be checked.
    """
    if not fit.answered:
        result = str(result_names(fit.estimate.result))
        return {"parameters": {} if case.is_vehicle else parameter_table(case, fit), "result": result}
    return _judge_vehicle(case, fit, sample_times, progress) if case.is_vehicle else _judge_flight(case, fit)


def _judge_flight(case: Case, fit: Fit) -> dict[str, Any]:
    table, body = parameter_table(case, fit), rigid_body(fit)
    other = None if case.held_out is None else validate_on(fit, case.held_out, case.validate)
    quantities = flight_quantities(table, body)
    doubts = [*doubts_of_flight(table, body, case.doubts)]
    judged = _verdicts(fit, quantities, doubts, is_vehicle=False)
    shown = {}
    if (found := fit.evaluation) is not None and found.feasible:
        errors = np.where(np.isnan(found.measured), np.nan, found.errors)[:, : found.problem.size]
        shown = {"traces": flight_traces(found), "correlations": residual_correlations(errors, found.torques)}
    return {"parameters": table, "rigid_body": body, "validation": other, **judged, **shown}


def _judge_vehicle(case: Case, fit: Fit, sample_times: Sequence[SampleTime], progress: Progress) -> dict[str, Any]:
    model = fit.problem.model
    if not isinstance(model, FlightModel):
        raise ValueError("`fit.problem.model` must be a `FlightModel`.")
    table, step, body = parameter_table(case, fit), float(fit.problem.flight.dt), vehicle_constants(fit)
    predicted = skill = None
    if case.held_out is not None:
        progress("predicting what was not fitted")
        predicted, skill = predict_held_out(case, fit, case.held_out)
    still = () if predicted is None else _still_axes(fit, predicted)
    notes = [
        f"the held-out part hardly turns about {' and '.join(still)}; choose another with `begin`, `end` or `validate`"
    ] * (0 < len(still) < len(AXES))
    weak, trusted = overwhelmed(fit), table
    if "yaw" in weak:
        # Vehicles hardly yaw. The other axes do not need it.
        body = RigidBody({name: row for name, row in body.constants.items() if name != "Iz"})
        trusted = {name: row for name, row in table.items() if name not in _OF_YAW}
        said = "not identified: the disturbance is larger"
        table |= {name: msgspec.structs.replace(table[name], note=said) for name in _OF_YAW if name in table}
        still = (*still, *({"yaw"} - {*still}))
    own = fit.problem.unknowns
    widths = dict(zip(own.names, np.asarray(own.half_width).tolist(), strict=True))
    # What is known of a fixed one is its bracket.
    held = {name: (row.value, widths[name]) for name, row in fit.held.items()} | fit.negative
    follow, pair = partial(consequences, fit, body.constants, model.quantities), neighbours(sample_times, step)
    inertias = dict(zip(AXES.values(), INVERSE, strict=True))
    doubts = [
        *doubts_of_log(case.doubts),
        *few_parts(case.provenance.fitted_seconds or 0.0),
        *(
            Doubt("unidentifiable", why, f"fly more {axis}, or in calmer air", {inertias[axis]: None})
            for axis, why in weak.items()
        ),
        *(doubt for _, doubt in contradicted(model, held)),
        *doubts_of(model, trusted, body.constants, skill, still, case.log_step, follow),
        *vibration(fit.disturbances, step, moves_between(*pair) if pair else {}),
        *(moved_by_sample_time(*pair, body.constants) if pair else ()),
    ]
    quantities = vehicle_quantities(model, fit, table, body.constants, skill, still)
    predicted = None if predicted is None else predicted.thinned(_MOST_STARTS)
    traces, correlations = vehicle_traces(case, fit, predicted)
    values = as_float(np.asarray(fit.estimate.parameters)[: own.count])
    return {
        "parameters": table,
        "rigid_body": body,
        "notes": notes,
        "skill": skill,
        "predictions": predicted,
        "traces": traces,
        "correlations": correlations,
        "response": frequency_response(with_room(fit.problem, case.room), values),
        **_verdicts(fit, quantities, doubts, is_vehicle=True),
    }


def _verdicts(fit: Fit, quantities: dict[str, Quantity], doubts: list[Doubt], *, is_vehicle: bool) -> dict[str, Any]:
    """The verdicts, the doubts with those about the search, and the result code."""
    search, every = str(result_names(fit.estimate.result)), dict.fromkeys(quantities)
    if not fit.is_lowest:
        doubts = [msgspec.structs.replace(_NOT_LOWEST, moves=every), *doubts]
    if search != "successful":
        cause, remedy = meaning(search).rsplit(": ", 1)
        doubts = [*doubts, Doubt(search, cause, remedy, every)]
    verdicts = {name: verdict_of(name, quantity, doubts) for name, quantity in quantities.items()}
    # What an OS4 flight does not show is no fault of the answer.
    wrong = [name for name, verdict in verdicts.items() if verdict.status == CONTRADICTED]
    required = ("Ix", "Iy") if is_vehicle else tuple(verdicts) if search != "successful" else wrong
    result = outcome(search, required, verdicts, doubts)
    return {"verdicts": verdicts, "doubts": tuple(doubts), "result": result}


def _still_axes(fit: Fit, predicted: Predictions) -> tuple[str, ...]:
    """The axes about which the held-out part hardly turns, or about which it was not measured."""
    still = []
    for (rate, axis), measured in zip(AXES.items(), np.moveaxis(predicted.measured, 2, 0), strict=True):
        noise = fit.disturbances[rate].sensor if rate in fit.disturbances else 0.0
        seen = measured[np.isfinite(measured)]
        if not seen.size or seen.std() < max(EXCITED.weak, EXCITED.over_noise * noise):
            still.append(axis)
    return tuple(still)
