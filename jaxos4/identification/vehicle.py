"""From recordings of a vehicle to the problem that an estimator solves, and the measurements that test the answer."""

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from ..airframe import Airframe
from ..analysis.prediction import HORIZONS, starts
from ..bracket import Bracket
from ..errors import InputError, TrainingError, shortened
from ..estimate import AbstractEstimator
from ..estimators import ESTIMATORS, IBSS, FilterError, Hybrid, make_estimator
from ..flight import Flight
from ..logs import Recording
from ..models.flight_model import FlightModel
from ..models.terms import FULL_SCALE, TERMS, VERTICAL_BIAS, VOLTAGE, clash, default_terms
from ..recording.prepared import HOLDOUT, Prepared, prepare
from ..shooting import InnovationsProblem, ShootingProblem, Unknowns, capacity_of, with_room
from ..shooting.feedthrough import input_innovations
from .prepare import NO_CLOCK, Case, Clock, Progress, VehicleSettings, airframe_name, name_and_class, versions
from .problem import GivenNetwork, Intervals, bracket_of, liveliest, vehicle_network_for
from .results import Provenance

# The scale of the errors of a simulation, for networks that are trained for a vehicle [rad/s].
_FIRST_SIGMA = 0.5
# Segments of a flight. They are filtered in parallel, and their disagreement shows errors of the model.
_SEGMENTS = 16
_FEW_RECORDINGS = 4  # from twice this number of recordings on, there are more segments
_SHORTEST_SEGMENT = 1.25  # no segment is shorter than this [s]
# The estimator of a vehicle, which flies in closed loop. With this tolerance it stops within 0.05 standard deviations
# of the minimum.
DEFAULT, _TOLERANCE = "filter-error", 1e-3


def prepare_vehicle(
    recordings: Sequence[Recording],
    airframe: Airframe,
    settings: VehicleSettings,
    *,
    estimator: str | AbstractEstimator | None,
    bracket: Intervals,
    network: GivenNetwork,
    validate: Recording | None,
) -> list[Case]:
    """Recordings of a vehicle at several sample times, the shortest first. Arguments as of `identify`."""
    name, kind = name_and_class(DEFAULT if estimator is None else estimator)
    if not kind.in_closed_loop:
        fitting = ", ".join(each for each, other in ESTIMATORS.items() if other.in_closed_loop)
        raise InputError(
            f"`estimator` {name}: is biased by a controller that answers gusts, as every vehicle has; use one of "
            f"{fitting}."
        )
    if network is not None or isinstance(estimator, Hybrid):
        raise InputError("`network`: a vehicle's network is trained for its own flights; use `estimator` hybrid.")
    by_default = HOLDOUT if validate is None else 0.0
    holdout = by_default if settings.holdout is None else settings.holdout
    prepared = prepare(
        recordings, airframe, begin=settings.begin, end=settings.end, sample_time=settings.sample_time, holdout=holdout
    )
    # All sample times share one program, with room for the shortest.
    return [
        _case(recordings, airframe, settings, each, prepared[0], name, bracket=bracket, validate=validate)
        for each in prepared
    ]


def _case(
    recordings: Sequence[Recording],
    airframe: Airframe,
    settings: VehicleSettings,
    prepared: Prepared,
    room: Prepared,
    name: str,
    *,
    bracket: Intervals,
    validate: Recording | None,
) -> Case:
    terms, voltage = _checked_terms(settings.terms, prepared.available), prepared.battery_voltage
    model = FlightModel(airframe, terms=terms, recordings=prepared.recordings, battery_voltage=voltage)
    if prepared.level is not None and not isinstance(bracket, Bracket) and VERTICAL_BIAS in model.parameter_names:
        value, error = prepared.level  # the flight says how the accelerometer errs along z
        bracket = {VERTICAL_BIAS: [value - error, value + error], **(bracket or {})}
    unknowns = Unknowns.of(model, bracket_of(bracket, model))
    shooting = _problem(model, prepared.fitted, windows=prepared.windows, unknowns=unknowns)
    measured = np.count_nonzero(~np.isnan(shooting.recorded()))
    if measured <= unknowns.count:
        raise InputError(
            f"{recordings[0].name}: {measured} measurements for {unknowns.count} unknowns; give a longer flight."
        )
    held_out, tested_seconds, notes, tested_clock = _held_out(recordings, validate, prepared, shooting, model)
    stretch = prepared.fitted.stretch
    number = np.zeros(prepared.fitted.time.shape[0], int) if stretch is None else np.asarray(stretch)
    powered = any(VOLTAGE in TERMS[term].needs for term in terms)
    provenance = Provenance(
        flights=[recording.name for recording in recordings],
        validate=None if validate is None else validate.name,
        airframe=airframe_name(airframe),
        terms=list(terms),
        sample_time=float(prepared.fitted.dt),
        fitted_seconds=prepared.seconds[0],
        tested_seconds=tested_seconds,
        battery_voltage=voltage if powered and voltage is not None else msgspec.UNSET,
        notes=list(notes),
        **versions(shooting),
    )
    recording = np.asarray(prepared.recordings)[number]
    problem = _innovations(shooting, prepared, room)
    return Case(
        problem, shooting, FilterError(tolerance=_TOLERANCE), name, "flight", held_out, recording, provenance,
        validate.name if validate else "", prepared.doubts, prepared.log_step, (recording, prepared.time), tested_clock,
    )  # fmt: skip


def with_estimator(case: Case, estimator: str | AbstractEstimator, *, seed: int, progress: Progress) -> Case:
    """The case, to be searched by an estimator; a network is trained for it if the estimator needs one."""
    if not isinstance(estimator, str):
        return case._replace(estimator=estimator)
    if not ESTIMATORS[estimator].needs_network:
        return case._replace(estimator=make_estimator(estimator))
    progress("training a network for these flights")
    begin, seen = time.perf_counter(), liveliest(case.shooting)
    name, method = str((case.provenance.flights or ["flight"])[0]), IBSS()
    try:
        method = Hybrid(vehicle_network_for(seen, name, seed=seed), seen=seen)
        what = f"its network was trained for these flights in {time.perf_counter() - begin:.0f} s"
    except TrainingError as error:
        what = f"no network for these flights ({error}); IBSS searched the whole bracket"
    notes = [*case.provenance.notes, f"{estimator}: {what}"]
    return case._replace(estimator=method, provenance=msgspec.structs.replace(case.provenance, notes=notes))


def _problem(model: FlightModel, flight: Flight, **settings: Any) -> ShootingProblem:
    """The problem of a vehicle's flight: its rates, and what its model says of specific force."""
    return ShootingProblem(model, flight, sigma=np.full(12, _FIRST_SIGMA), channels="rates", method="rk4", **settings)


def _innovations(shooting: ShootingProblem, prepared: Prepared, room: Prepared) -> InnovationsProblem:
    """The likelihood of a vehicle, in a program for all flights that are not longer than `room`."""
    recordings = max(prepared.recordings) + 1
    # Segments are as many for all sample times, and last a while at the longest.
    seconds = float(room.fitted.dt) * room.fitted.time.shape[0]
    most = _SEGMENTS * max(recordings // _FEW_RECORDINGS, 1)
    segments = int(np.clip(seconds / _SHORTEST_SEGMENT, 2 * recordings if recordings > 1 else 1, most))
    least_noise = np.append(np.zeros(3), prepared.force_noise[list(shooting.model.force_axes)])
    capacity = capacity_of(room.fitted.time.shape[0])
    padded, inputs = with_room(shooting, capacity), _input_innovations(shooting, capacity)
    return InnovationsProblem(padded, segments=segments, least_noise=least_noise, input_innovations=inputs)


def _input_innovations(shooting: ShootingProblem, capacity: int) -> Float[np.ndarray, "samples feedthroughs 3"] | None:
    """Those of a flight that is padded to `capacity` samples."""
    flight = shooting.flight
    if flight.within is None:
        return None
    samples, mixer = flight.time.shape[0], np.asarray(shooting.model.airframe.mixer)
    torque = np.square(np.asarray(flight.within)) @ mixer[:3].T
    stretch = np.zeros(samples, int) if flight.stretch is None else np.asarray(flight.stretch)
    found = input_innovations(torque, shooting.recorded()[:, :3], stretch, float(flight.dt))
    return np.pad(found, ((0, capacity - samples), (0, 0), (0, 0)))


def _held_out(
    recordings: Sequence[Recording],
    validate: Recording | None,
    prepared: Prepared,
    fitted: ShootingProblem,
    model: FlightModel,
) -> tuple[ShootingProblem | None, float, tuple[str, ...], Clock]:
    """The flight that is predicted and not fitted, if there is one; how long it lasts [s]; the notes about all data.

    **Returns:** also the clock of that flight, if it is another recording.
    """
    name, notes, seconds = recordings[0].name, prepared.notes, prepared.seconds[1]
    remedy, clock = "give `holdout` 0 or `validate`", NO_CLOCK
    if validate is not None:
        other = _prepare_other(recordings, validate, prepared, model)
        own = dataclasses.replace(model, recordings=other.recordings)
        held_out, seconds = _problem(own, other.fitted), other.seconds[0]
        name, remedy, notes = validate.name, "give another flight", notes + other.notes
        clock = np.full(other.time.size, len(recordings)), other.time
    elif prepared.tested is not None:
        held_out = dataclasses.replace(fitted, flight=prepared.tested)
    else:
        return None, 0.0, (*notes, "nothing was held out, so no prediction checks the fit"), clock
    try:
        starts(held_out.flight)
    except ValueError:
        raise InputError(
            f"{name}: nothing is long enough to be predicted {max(HORIZONS):g} s ahead; {remedy}."
        ) from None
    return held_out, seconds, notes, clock


def _prepare_other(
    recordings: Sequence[Recording], validate: Recording, prepared: Prepared, model: FlightModel
) -> Prepared:
    """The recording to predict, with the sample time of those that are fitted."""
    if any(validate.same_data(recording) for recording in recordings):
        raise InputError(
            f"{validate.name}: `validate` is fitted already; leave it out: a part of the flight is held out by default."
        )
    step = float(prepared.fitted.dt)
    (other,) = prepare([validate], model.airframe, sample_time=step, holdout=0.0, predicted=True)
    for term in model.terms:
        if TERMS[term].changes_rates and not TERMS[term].needs <= other.available:
            raise InputError(
                f"{validate.name}: `validate` did not measure what the term {term} needs; give `terms` without it."
            )
    return other


def _checked_terms(terms: Sequence[str] | None, available: frozenset[str]) -> tuple[str, ...]:
    """The terms in the order of `TERMS`. Raises `InputError` for one that is unknown or not available."""
    if terms is None:
        return default_terms(available)
    for term in terms:
        if term not in TERMS:
            raise InputError(f"`terms`: knows no `{shortened(term, 40)}`; the terms are {', '.join(TERMS)}.")
        missing = TERMS[term].needs - available
        if FULL_SCALE in missing:
            raise InputError(f"`terms`: {term} needs `max_rotor_speed` in the airframe; set it or leave it out.")
        if missing:
            what = " and ".join(sorted(missing))
            raise InputError(f"`terms`: {term} needs {what}, which these logs did not measure; leave it out.")
    if why := clash(terms):
        raise InputError(f"`terms`: {why}.")
    return tuple(term for term in TERMS if term in terms)
