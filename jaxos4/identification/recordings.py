"""Identification of a real vehicle from one recording or several."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..airframe import Airframe
from ..analysis.frequency_response import frequency_response
from ..bracket import NO_PRIOR, Bracket
from ..errors import InputError
from ..estimate import AbstractEstimator, Estimate
from ..estimators import IBSS, FilterError, make_estimator
from ..flight import CHANNEL_NAMES
from ..models.terms import FULL_SCALE, TERMS, default_terms
from ..models.vehicle import FlightModel
from ..recording.preparation import HOLDOUT, WINDOW, Prepared, prepare
from ..recording.reading import Recording
from ..results import result_names
from ..shooting import ShootingProblem
from .checks import answered_gusts, doubts_of, vibration
from .constants import vehicle_constants
from .filter_fit import fit_by_filter
from .held_out import HeldOut, check_starts, predict_held_out
from .network import vehicle_network_for
from .parameters import parameter_table
from .problem import Intervals, bracket_of
from .provenance import airframe_name, name_and_class, shooting_names, versions
from .results import Doubt, HeldParameter, RigidBody, VehicleIdentification, finite_or_none
from .vehicle import Search, VehicleFit, fit_vehicle, free_bracket

# The first guess of the noise levels [rad/s]: errors of the model rather than of the sensor.
_FIRST_SIGMA = 0.5
# The largest Jacobian of output error [GiB]; a search needs a few of them.
_LARGEST_JACOBIAN = 1.0
# Results with an answer: a doubt says more than they do.
_ANSWERS = ("successful", "at_bound", "max_sweeps")
# The estimator of a vehicle, which flies in closed loop.
DEFAULT = "filter-error"


def identify_vehicle(
    recordings: Sequence[Recording],
    airframe: Airframe,
    *,
    estimator: str | AbstractEstimator | None,
    bracket: Intervals,
    terms: Sequence[str] | None,
    begin: float | None,
    end: float | None,
    window: float | None,
    sample_time: float | None,
    holdout: float | None,
    validate: Recording | None,
    loss: str | None,
    seed: int,
    progress: Callable[[str], None],
) -> VehicleIdentification:
    """What `jaxos4.identify` does with an airframe. The arguments are the same."""
    estimator = DEFAULT if estimator is None else estimator
    name, kind = name_and_class(estimator)
    by_filter = issubclass(kind, FilterError)
    if loss not in (None, "huber", "squares"):
        raise InputError(f"`loss`: must be huber or squares, got {loss!r}.")
    if not kind.shoots and not by_filter:
        raise InputError(
            f"`estimator` {name}: does not shoot, which a vehicle needs; use {DEFAULT} or one of {shooting_names()}."
        )
    if by_filter and loss == "huber":
        raise InputError(f"`loss` huber: {name} models what others cut as outliers; leave it out.")
    started, window = time.perf_counter(), WINDOW if window is None else window
    share = holdout if holdout is not None else 0.0 if validate is not None else HOLDOUT
    part = {"begin": begin, "end": end, "window": window, "sample_time": sample_time, "holdout": share}
    prepared = prepare(recordings, airframe, **part)
    chosen = default_terms(prepared.available) if terms is None else _checked_terms(terms, prepared.available)
    voltage = prepared.battery_voltage
    model = FlightModel(airframe, terms=chosen, recordings=prepared.recordings, battery_voltage=voltage)
    where = bracket_of(bracket, model)
    held_out, notes = _held_out(recordings, validate, prepared, model, window)
    problem = _problem(prepared, model, recordings[0].name, window)
    _check_memory(problem, name)
    number = np.asarray(prepared.recordings)[_stretches(prepared)]
    # Filter error is fitted in any case: it shows whether the controller answered gusts.
    settings = estimator if isinstance(estimator, FilterError) else FilterError()
    filtered = fit_by_filter(problem, where, estimator=settings, recording=number, progress=progress)
    fit, process = filtered.fit, filtered.noise
    if not by_filter:
        last = _last_search(estimator, kind, recordings[0].name, seed)
        fit = fit_vehicle(problem, where, estimator=last, huber=loss != "squares", progress=progress)
        process = None
    estimate, free, noise = fit.estimate, fit.problem.model, np.asarray(fit.problem.sigma)
    predicted = skill = None
    if fit.answered and held_out is not None:
        progress("predicting what was not fitted")
        predicted, skill = predict_held_out(fit, model, held_out, process)
    prior = kind.prior if by_filter else NO_PRIOR
    some = free_bracket(where, model, fit.held)
    table = parameter_table(free, estimate, fit.bound, some, prior=prior) if fit.answered else {}
    body = vehicle_constants(free.parameter_names, estimate, where, airframe) if fit.answered else RigidBody()
    doubts = doubts_of(table, body.constants, skill, airframe) if fit.answered else ()
    if by_filter:
        doubts += tuple(vibration(filtered.disturbances, float(prepared.fitted.dt)))
    else:
        contradictions, not_compared = _compared(body, filtered.fit, where, airframe)
        doubts, notes = doubts + contradictions, notes + not_compared
    result = str(result_names(estimate.result))
    return VehicleIdentification(
        estimator=name,
        model="flight",
        result=doubts[0].result if doubts and result in _ANSWERS else result,
        rollouts=fit.rollouts,
        cost=finite_or_none(estimate.cost),
        seconds=time.perf_counter() - started,
        parameters=table,
        rigid_body=body,
        held=_held_parameters(fit, model),
        cut=fit.cut,
        noise={CHANNEL_NAMES[i]: float(noise[i]) for i in fit.problem.columns},
        doubts=doubts,
        disturbances=filtered.disturbances if by_filter else {},
        widened=filtered.widened if by_filter else {},
        skill=skill,
        predictions=predicted,
        response=frequency_response(fit.problem, estimate.parameters) if fit.answered else None,
        provenance=_provenance(recordings, validate, prepared, fit.problem, model, held_out)
        | {"window": window, "loss": "likelihood" if by_filter else loss or "huber", "notes": list(notes)},
        estimate=estimate,
        problem=fit.problem,
    )


def _compared(
    body: RigidBody, other: VehicleFit, bracket: Bracket, airframe: Airframe
) -> tuple[tuple[Doubt, ...], tuple[str, ...]]:
    """What the fit `other` by filter error says against moments of inertia, and a note on those it does not know."""
    allowed = RigidBody()
    if other.answered:
        allowed = vehicle_constants(other.problem.model.parameter_names, other.estimate, bracket, airframe)
    unknown = [name for name in body.constants if name not in allowed.constants]
    notes = (f"not compared with filter error, which does not know them: {', '.join(unknown)}",) if unknown else ()
    return tuple(answered_gusts(body.constants, allowed.constants)), notes


def _provenance(
    recordings: Sequence[Recording],
    validate: Recording | None,
    prepared: Prepared,
    problem: ShootingProblem,
    model: FlightModel,
    held_out: HeldOut | None,
) -> dict[str, Any]:
    """The data, the vehicle and the versions."""
    return {
        "flights": [recording.name for recording in recordings],
        "validate": None if validate is None else validate.name,
        "airframe": airframe_name(model.airframe),
        "terms": list(model.terms),
        "sample_time": float(prepared.fitted.dt),
        "fitted_seconds": prepared.seconds[0],
        "tested_seconds": 0.0 if held_out is None else held_out.seconds,
        **({"battery_voltage": prepared.battery_voltage} if "voltage" in model.terms else {}),
        **versions(problem),
    }


def _stretches(prepared: Prepared) -> np.ndarray:
    """The stretch of each sample."""
    stretch = prepared.fitted.stretch
    return np.zeros(prepared.fitted.time.shape[0], dtype=int) if stretch is None else np.asarray(stretch)


def _held_out(
    recordings: Sequence[Recording], validate: Recording | None, prepared: Prepared, model: FlightModel, window: float
) -> tuple[HeldOut | None, tuple[str, ...]]:
    """The data that are predicted and not fitted, if there are any; and the notes about all data."""
    held_out, notes = None, prepared.notes
    if validate is not None:
        other = _prepare_other(recordings, validate, prepared, model, window)
        held_out, notes = HeldOut(other.fitted, other.seconds[0], validate.name, False), notes + other.notes
    elif prepared.tested is not None:
        held_out = HeldOut(prepared.tested, prepared.seconds[1], recordings[0].name, True)
    if held_out is None:
        return None, (*notes, "nothing was held out, so no prediction checks the fit")
    check_starts(held_out)
    return held_out, notes


def _held_parameters(fit: VehicleFit, model: FlightModel) -> dict[str, HeldParameter]:
    return {
        name: HeldParameter(fit.held[name][0], unit, fit.held[name][1] or "not asked")
        for name, unit in zip(model.parameter_names, model.parameter_units, strict=True)
        if name in fit.held
    }


def _check_memory(problem: ShootingProblem, name: str) -> None:
    gibibytes = problem.flight.time.shape[0] * problem.columns.size * _unknowns(problem) * 8 / 2**30
    if name == "output-error" and gibibytes > _LARGEST_JACOBIAN:
        raise InputError(
            f"`estimator` {name}: its Jacobian would take {gibibytes:.0f} GiB in {problem.windows} windows; use ibss, "
            "or less of the flight by `begin` and `end`."
        )


def _last_search(
    estimator: str | AbstractEstimator, kind: type[AbstractEstimator], name: str, seed: int
) -> Search | None:
    """The search of the last stage; `None`: IBSS from the end of the stage before. `name`: of the first recording."""
    if not isinstance(estimator, str):
        return estimator
    if kind is IBSS:
        return None
    if not kind.needs_network:
        return make_estimator(estimator)

    def with_network(problem: ShootingProblem, bracket: Bracket) -> Estimate:
        return make_estimator(estimator, vehicle_network_for(problem, bracket, name, seed=seed))(problem, bracket)

    return with_network


def _checked_terms(terms: Sequence[str], available: frozenset[str]) -> tuple[str, ...]:
    """The terms in the order of `TERMS`. Raises `InputError` for one that is unknown or not available."""
    for term in terms:
        if term not in TERMS:
            raise InputError(f"`terms`: knows no `{term[:40]}`; the terms are {', '.join(TERMS)}.")
    for term in terms:
        missing = TERMS[term].needs - available
        if FULL_SCALE in missing:
            raise InputError(f"`terms`: {term} needs `max_rotor_speed` in the airframe; set it or leave it out.")
        if missing:
            what = " and ".join(sorted(missing))
            raise InputError(f"`terms`: {term} needs {what}, which these logs did not measure; leave it out.")
    return tuple(term for term in TERMS if term in terms)


def _prepare_other(
    recordings: Sequence[Recording], validate: Recording, prepared: Prepared, model: FlightModel, window: float
) -> Prepared:
    """The recording to predict, with the sample time of those that are fitted."""
    if any(validate.same_data(recording) for recording in recordings):
        raise InputError(
            f"{validate.name}: `validate` is fitted already; leave it out: a part of the flight is held out by default."
        )
    step = float(prepared.fitted.dt)
    other = prepare([validate], model.airframe, window=window, sample_time=step, holdout=0.0, predicted=True)
    for term in model.terms:
        # Predictions of the rates need no accelerometer.
        if term != "accelerometer" and not TERMS[term].needs <= other.available:
            raise InputError(
                f"{validate.name}: `validate` did not measure what the term {term} needs; give `terms` without it."
            )
    return other


def _problem(prepared: Prepared, model: FlightModel, name: str, window: float) -> ShootingProblem:
    sigma, windows = np.full(12, _FIRST_SIGMA), prepared.windows
    problem = ShootingProblem(model, prepared.fitted, sigma=sigma, channels="rates", method="rk4", windows=windows)
    measured = np.count_nonzero(~np.isnan(problem.recorded()))
    if measured <= _unknowns(problem):
        raise InputError(
            f"{name}: {measured} measurements are too few for windows of {window:g} s; give a longer `window`."
        )
    return problem


def _unknowns(problem: ShootingProblem) -> int:
    return len(problem.model.parameter_names) + problem.windows * problem.free_size
