"""From a vehicle's recordings to its data at several sample times, with the likelihood of innovations."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from ..airframe import AXES, YAW, Airframe
from ..analysis.prediction import HORIZONS, starts
from ..bracket import Bracket
from ..errors import InputError, shortened
from ..flight import ANGLES, CHANNEL_NAMES, Flight
from ..logs import Recording
from ..models.flight_model import FlightModel
from ..models.terms import COMMANDS, FULL_SCALE, SAG, TERMS, VERTICAL_BIAS, VOLTAGE, clash, default_terms
from ..recording.prepared import HOLDOUT, Prepared, prepare
from ..recording.sensor_errors import unseen_sag
from ..shooting import InnovationsProblem, ShootingProblem, Unknowns, capacity_of, with_capacity
from ..shooting.feedthrough import COUNTS, FEEDTHROUGHS, LAGGED_COUNTS, MEANS, input_innovations, lagged
from .data import Data, HeldOut, Provenance
from .prepare_os4 import Intervals, bracket_of

SEGMENTS = 16  # parts of a flight, filtered in parallel; their disagreement shows errors of the model
RECORDINGS = 4  # twice this many or more have more segments
MIN_SEGMENT = 1.25  # s
# Up to this sample time [s], torque hardly answers a measurement in its own sample, if measurements are instants or
# motors follow commands. Commands then need the innovations of earlier samples, too (`lagged`).
UNANSWERED = 0.005
SIGMA = 0.5  # rad/s; the scale of the errors of a simulation, for networks
GUESS_REACH = 4.0  # alpha8 may be this many times a guess too small or too large: published drag torques differ as much


@dataclasses.dataclass(frozen=True)
class VehicleSettings:
    """Settings of the identification of a vehicle.

    - `terms`: of `jaxos4.TERMS`; by default those that the recordings allow.
    - `begin`, `end`: use this part of each recording [s]; by default its usable stretches.
    - `sample_time`: average to samples of this length [s]; by default the best one up to 0.032 s, from 0.002 s
      (commands that change more rarely than twice in that: 0.004 s) or the recordings' sample time if it is longer.
    - `holdout`: share of the flight that is held out and predicted, 0 to 0.5; by default 0.25, or 0 with `validate`.
    """

    terms: Sequence[str] | None = None
    begin: float | None = None
    end: float | None = None
    sample_time: float | None = None
    holdout: float | None = None


def prepare_vehicle(
    recordings: Sequence[Recording],
    airframe: Airframe,
    settings: VehicleSettings,
    *,
    bracket: Intervals = None,
    validate: Recording | None = None,
) -> list[Data[InnovationsProblem]]:
    """The data at several sample times, the shortest first. Arguments as in `identify`."""
    if validate is not None and settings.holdout:
        raise InputError("`holdout`: `validate` is predicted instead of a part of the flights; leave one of them out.")
    if validate is not None and any(validate.same_data(recording) for recording in recordings):
        raise InputError(
            f"{validate.name}: `validate` is fitted already; leave it out: a part of the flight is held out by default."
        )
    by_default = HOLDOUT if validate is None else 0.0
    holdout = by_default if settings.holdout is None else settings.holdout
    prepared = prepare(
        recordings, airframe, begin=settings.begin, end=settings.end, sample_time=settings.sample_time, holdout=holdout
    )
    # All sample times share one program, with capacity for the shortest, which has the most samples.
    return [
        _data(recordings, airframe, settings, each, prepared[0], bracket=bracket, validate=validate)
        for each in prepared
    ]


def _data(
    recordings: Sequence[Recording],
    airframe: Airframe,
    settings: VehicleSettings,
    prepared: Prepared,
    finest: Prepared,
    *,
    bracket: Intervals,
    validate: Recording | None,
) -> Data[InnovationsProblem]:
    terms, voltage = _checked_terms(settings.terms, prepared.available), prepared.battery_voltage
    model = FlightModel(airframe, terms=terms, recordings=prepared.recordings, battery_voltage=voltage)
    powered = any(VOLTAGE in TERMS[term].needs for term in terms)
    own: dict[str, Any] = {}
    if prepared.level is not None and VERTICAL_BIAS in model.parameter_names:
        value, error = prepared.level  # the flight shows the accelerometer's error along z
        own[VERTICAL_BIAS] = [value - error, value + error]
    if powered and voltage is not None and SAG in model.parameter_names:
        unseen = max(map(unseen_sag, recordings))  # a logged voltage contains the rest
        center, half_width = (float(each[model.parameter_names.index(SAG)]) for each in (model.alpha, model.half_width))
        own[SAG] = [unseen * (center - half_width), unseen * (center + half_width)]
    if airframe.guesses_drag:
        center = 1 / float(airframe.inertia[2])
        own[YAW.inverse] = [-GUESS_REACH * center, (2 + GUESS_REACH) * center]
    given = bracket if isinstance(bracket, Bracket) else own | dict(bracket or {})
    unknowns = Unknowns.of(model, bracket_of(given, model))
    shooting = _problem(model, prepared.fitted, windows=prepared.windows, unknowns=unknowns)
    measured = np.count_nonzero(~np.isnan(shooting.recorded()))
    if measured <= unknowns.count:
        raise InputError(
            f"{recordings[0].name}: {measured} measurements for {unknowns.count} unknowns; give a longer flight."
        )
    held_out, tested_seconds, notes = _held_out(recordings, validate, prepared, shooting, model)
    provenance = Provenance.of(
        shooting,
        notes,
        flights=[recording.name for recording in recordings],
        validate=None if validate is None else validate.name,
        terms=list(terms),
        fitted_seconds=prepared.seconds[0],
        tested_seconds=tested_seconds,
        battery_voltage=voltage if powered and voltage is not None else msgspec.UNSET,
    )
    return Data(
        likelihood=_innovations(shooting, prepared, finest),
        problem=shooting,
        provenance=provenance,
        held_out=held_out,
        findings=prepared.findings,
        log_step=prepared.log_step,
        motor_step=prepared.motor_step,
        vibrates=prepared.vibrates,
        follows_commands=COMMANDS in prepared.available,
        log=np.asarray(prepared.recordings)[prepared.fitted.stretch_numbers],
        time=prepared.time,
    )


def _problem(model: FlightModel, flight: Flight, **settings: Any) -> ShootingProblem:
    """The problem of a vehicle's flight: its rates, and specific force if the model predicts it."""
    return ShootingProblem(model, flight, sigma=np.full(12, SIGMA), channels="rates", method="rk4", **settings)


def _innovations(shooting: ShootingProblem, prepared: Prepared, finest: Prepared) -> InnovationsProblem:
    """The likelihood of a vehicle, padded so that all flights up to the length of the `finest` share a program."""
    recordings = max(prepared.recordings) + 1
    # All sample times have the same number of segments, each of at least `MIN_SEGMENT` unless recordings are many.
    seconds = float(finest.fitted.dt) * finest.fitted.time.shape[0]
    most = SEGMENTS * max(recordings // RECORDINGS, 1)
    segments = int(np.clip(seconds / MIN_SEGMENT, 2 * recordings if recordings > 1 else 1, most))
    least_noise = np.append(np.zeros(3), prepared.force_noise[list(shooting.model.force_axes)])
    capacity = capacity_of(finest.fitted.time.shape[0])
    flight, commanded = shooting.flight, COMMANDS in prepared.available
    # Torque before a measured instant cannot answer it, and motors take longer to answer than a short sample lasts.
    is_short, is_instant = float(flight.dt) <= UNANSWERED, float(flight.averaging_time) == 0.0
    is_lagged, measured_first = is_short and commanded, is_short and is_instant and not commanded
    innovations = _input_innovations(
        shooting,
        capacity,
        commanded=commanded,
        is_lagged=is_lagged,
        means=MEANS if is_short else (),
        measured_first=measured_first,
    )
    return InnovationsProblem(
        with_capacity(shooting, capacity),
        segments=segments,
        least_noise=least_noise,
        input_innovations=innovations,
        answers_within=not (is_lagged or measured_first),
        lagged=is_lagged,
    )


def _input_innovations(
    shooting: ShootingProblem,
    capacity: int,
    *,
    commanded: bool,
    is_lagged: bool,
    means: Sequence[float],
    measured_first: bool,
) -> Float[np.ndarray, "samples feedthroughs channels"] | None:
    """Input innovations of body rates and vertical force, padded to `capacity`; `None` without `Flight.within`."""
    flight, columns = shooting.flight, shooting.columns
    if flight.within is None:
        return None
    dt, (samples,), stretch = float(flight.dt), flight.time.shape, np.asarray(flight.stretch_numbers)
    within, airframe = np.asarray(flight.within), shooting.model.airframe
    inputs = np.square(within) @ np.asarray(airframe.mixer).T
    counts = LAGGED_COUNTS if is_lagged else COUNTS
    speeds, slow = (), ()
    if means and not commanded:
        # The reaction torque follows the change of the speeds, which past torque does not determine.
        speeds, slow = (within.mean(axis=1) @ np.asarray(airframe.rotor_spins),), _slow_signals(flight)
    found = np.zeros((capacity, max(LAGGED_COUNTS) if commanded else FEEDTHROUGHS, columns.size))
    for channel, (column, measured) in enumerate(zip(columns, shooting.recorded().T, strict=True)):
        axis = channel if channel < 3 else 3 if CHANNEL_NAMES[column] == "az" else None
        if axis is not None:
            torque, count = inputs[:, :, axis], counts[axis]
            some = 1 if is_lagged else count
            own = input_innovations(
                torque,
                measured,
                stretch,
                dt,
                some,
                speeds=speeds if axis == AXES.index(YAW) else (),
                means=means,
                slow=slow if axis < AXES.index(YAW) else (),
                measured_first=measured_first,
            )
            found[:samples, :count, channel] = lagged(own[:, 0], stretch, count) if is_lagged else own
    return found


def _slow_signals(flight: Flight) -> list[Float[np.ndarray, " samples"]]:
    """The signals that roll and pitch respond to: the upright direction along x and y, and the velocity if known."""
    phi, theta = np.asarray(flight.states)[:, ANGLES[:2]].T
    velocity = () if flight.body_velocity is None else np.asarray(flight.body_velocity).T
    return [-np.sin(theta), np.cos(theta) * np.sin(phi), *velocity]


def _held_out(
    recordings: Sequence[Recording],
    validate: Recording | None,
    prepared: Prepared,
    fitted: ShootingProblem,
    model: FlightModel,
) -> tuple[HeldOut | None, float, tuple[str, ...]]:
    """The held-out measurements, if there are any; their length [s]; the notes about all data."""
    name, notes, seconds = recordings[0].name, prepared.notes, prepared.seconds[1]
    remedy = "give `holdout` 0 or `validate`"
    if validate is not None:
        (other,) = prepare(
            [validate], model.airframe, sample_time=float(prepared.fitted.dt), holdout=0.0, predicted=True
        )
        for term in model.terms:
            if TERMS[term].changes_rates and not TERMS[term].needs <= other.available:
                lacks = f"`validate` lacks measurements that the term {term} needs"
                raise InputError(f"{validate.name}: {lacks}; give `terms` without it.")
        own = dataclasses.replace(model, recordings=other.recordings)
        held_out, seconds = HeldOut(_problem(own, other.fitted), validate.name, other.time), other.seconds[0]
        name, remedy, notes = validate.name, "give another flight", (*notes, *other.notes, *map(str, other.findings))
    elif prepared.tested is not None:
        held_out = HeldOut(dataclasses.replace(fitted, flight=prepared.tested))
    else:
        return None, 0.0, (*notes, "nothing was held out, so no prediction checks the fit")
    try:
        starts(held_out.problem.flight)
    except ValueError:
        raise InputError(
            f"{name}: nothing is long enough to be predicted {max(HORIZONS):g} s ahead; {remedy}."
        ) from None
    return held_out, seconds, notes


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
