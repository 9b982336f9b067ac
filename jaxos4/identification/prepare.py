"""From recordings and a subject to the problem that an estimator solves, and the measurements that test the answer."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from ..airframe import Airframe
from ..analysis.prediction import HORIZONS, starts
from ..bracket import Bracket
from ..errors import InputError, TrainingError
from ..estimate import AbstractEstimator
from ..estimators import ESTIMATORS, IBSS, FilterError, Hybrid, make_estimator
from ..flight import Flight
from ..models import MODELS
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER
from ..models.terms import FULL_SCALE, TERMS, VOLTAGE, default_terms
from ..models.vehicle import FlightModel
from ..networks import TrainedNetwork
from ..recording import preparation
from ..recording.reading import Recording
from ..shooting import InnovationsProblem, ShootingProblem, Unknowns
from ..shooting.innovations import SEGMENT, SETTLING
from .network import GivenNetwork, loaded, network_for, network_provenance, vehicle_network_for
from .problem import Intervals, bracket_of, flight_problem
from .provenance import airframe_name, class_name, name_and_class, versions
from .results import Provenance
from .settings import FlightSettings, VehicleSettings

# The scale of the errors of a simulation, for networks that are trained for a vehicle [rad/s].
_FIRST_SIGMA = 0.5
# A flight has at least so many segments, whose disagreement shows errors of the model, unless they would be too short.
_FEWEST_SEGMENTS, _SHORTEST_SEGMENT = 8, 80
# A filter has settled after this time [s].
_SETTLED = 0.512
# The cost has kinks where a delay passes a sample. Slopes jump closer to the minimum than this [standard deviations].
_KINKS = 0.05
# The estimator of a vehicle, which flies in closed loop.
DEFAULT = "filter-error"
Progress = Callable[[str], None]


class HeldOut(NamedTuple):
    """Measurements that are not fitted.

    - `problem`: with these measurements. `name`: of the recording.
    - `seconds`: how long they last [s].
    - `fitted_vehicle`: whether they are a part of the fitted recordings, which have their own offsets.
    """

    problem: ShootingProblem
    name: str
    seconds: float = 0.0
    fitted_vehicle: bool = False


class Case(NamedTuple):
    """Everything that a fit needs, and the measurements that test it.

    - `problem`: the likelihood, with its bracket. `estimator`: what searches it; `name`: of the estimator.
    - `model`: the name of the equations.
    - `prior`: how the estimator uses the bracket, see `jaxos4.bracket`.
    - `held_out`: the measurements that are not fitted, if there are any.
    - `recording`: the number of the recording of each sample.
    - `provenance`: data, settings and versions.
    """

    problem: ShootingProblem | InnovationsProblem
    estimator: AbstractEstimator
    name: str
    model: str
    prior: float
    held_out: HeldOut | None
    recording: np.ndarray
    provenance: Provenance

    @property
    def is_vehicle(self) -> bool:
        """Whether the likelihood allows for disturbances, as that of a vehicle does."""
        return isinstance(self.problem, InnovationsProblem)

    @property
    def shooting(self) -> ShootingProblem:
        """The flight and its model."""
        return self.problem.problem if isinstance(self.problem, InnovationsProblem) else self.problem


def prepare_flight(
    recordings: Sequence[Recording],
    model: AbstractModel,
    settings: FlightSettings,
    *,
    estimator: str | AbstractEstimator | None,
    bracket: Intervals,
    network: GivenNetwork,
    validate: Recording | None,
    seed: int,
    progress: Progress,
) -> Case:
    """A flight of an OS4. Arguments as of `identify`."""
    recording, *others = recordings
    subject = class_name(model, MODELS)
    if others:
        raise InputError(
            f"{others[0].name}: `subject` {subject} explains one flight; use an `Airframe` as `subject` for several."
        )
    estimator = "ibss" if estimator is None else estimator
    name, kind = name_and_class(estimator)
    _check_options(name, kind, settings, network)
    if network is not None and not isinstance(estimator, str):
        raise InputError(f"`network`: this {name} estimator has one already; leave it out.")
    own = estimator.network if isinstance(estimator, Hybrid) else estimator
    trained = own if isinstance(own, TrainedNetwork) else loaded(network)
    if trained is not None and not kind.shoots and bracket is not None:
        raise InputError("`bracket`: a network searches the bracket that it was trained in; leave one of them out.")
    where, shooting = bracket_of(bracket, model), {"initial_state": settings.initial_state, "window": settings.window}
    problem = flight_problem(recording, model, where, channels=settings.channels, **shooting)
    other = None if validate is None else flight_problem(validate, model, where, **shooting)
    if _has_own_channels(kind):
        problem = _restricted(problem, kind.looks_at, name, recording)
    if kind.needs_network and trained is None:
        progress("training a network for this flight")
        trained = network_for(problem, where, recording.name, shoots=kind.shoots, seed=seed)
    method = make_estimator(estimator, trained) if isinstance(estimator, str) else estimator
    if trained is not None:
        mismatch = trained.mismatch(problem)
        if mismatch is not None:
            raise InputError(
                f"`network`: cannot be used on {recording.name}: {mismatch}; train one with `jaxos4 train`."
            )
        if not kind.shoots:
            problem = problem.restrict(trained.channels).within(trained.bracket)
    notes, held_out = recording.notes, None
    if validate is not None and other is not None:
        held_out, notes = HeldOut(_comparable(other, problem, validate), validate.name), notes + validate.named_notes
    samples = int(problem.flight.time.shape[0])
    provenance = Provenance(
        flight=recording.name,
        airframe=airframe_name(model.airframe),
        channels=problem.channels,
        initial_state=settings.initial_state,
        windows=problem.windows,
        samples=samples,
        sample_time=float(problem.flight.dt),
        network=msgspec.UNSET if trained is None else network_provenance(network, trained),
        notes=list(notes),
        **versions(problem),
    )
    return Case(problem, method, name, subject, kind.prior, held_out, np.zeros(samples, int), provenance)


def prepare_vehicle(
    recordings: Sequence[Recording],
    airframe: Airframe,
    settings: VehicleSettings,
    *,
    estimator: str | AbstractEstimator | None,
    bracket: Intervals,
    network: GivenNetwork,
    validate: Recording | None,
    seed: int,
    progress: Progress,
) -> Case:
    """Recordings of a vehicle. Arguments as of `identify`."""
    estimator = DEFAULT if estimator is None else estimator
    name, kind = name_and_class(estimator)
    if not kind.in_closed_loop:
        fitting = ", ".join(each for each, other in ESTIMATORS.items() if other.in_closed_loop)
        raise InputError(
            f"`estimator` {name}: is biased by a controller that answers gusts, as every vehicle has; use one of "
            f"{fitting}."
        )
    if network is not None:
        raise InputError("`network`: a vehicle's network is trained for its own flights; leave it out.")
    prepared = preparation.prepare(
        recordings,
        airframe,
        begin=settings.begin,
        end=settings.end,
        sample_time=settings.sample_time,
        holdout=settings.share(validated=validate is not None),
    )
    terms, voltage = _checked_terms(settings.terms, prepared.available), prepared.battery_voltage
    model = FlightModel(airframe, terms=terms, recordings=prepared.recordings, battery_voltage=voltage)
    problem = _vehicle_problem(model, prepared.fitted, bracket_of(bracket, model), prepared.windows, recordings[0].name)
    held_out, notes = _held_out(recordings, validate, prepared, problem.problem, model)
    if kind.needs_network and isinstance(estimator, str):
        progress("training a network for these flights")
        try:
            trained = vehicle_network_for(problem.problem, recordings[0].name, seed=seed)
            method = _coarser(make_estimator(estimator, trained))
        except TrainingError as error:
            method, notes = (
                _coarser(IBSS()),
                (*notes, f"no network for these flights ({error}); IBSS searched the whole bracket"),
            )
    else:
        method = _coarser(make_estimator(estimator)) if isinstance(estimator, str) else estimator
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
        tested_seconds=0.0 if held_out is None else held_out.seconds,
        battery_voltage=voltage if powered and voltage is not None else msgspec.UNSET,
        notes=list(notes),
        **versions(problem.problem),
    )
    recording = np.asarray(prepared.recordings)[number]
    return Case(problem, method, name, "flight", FilterError.prior, held_out, recording, provenance)


def _coarser(method: AbstractEstimator) -> AbstractEstimator:
    """The estimator, which ends a bisection where the kinks of a vehicle's cost begin to matter."""
    if isinstance(method, Hybrid):
        return dataclasses.replace(method, ibss=dataclasses.replace(method.ibss, tolerance=_KINKS))
    return dataclasses.replace(method, tolerance=_KINKS) if isinstance(method, IBSS) else method


def _vehicle_problem(
    model: FlightModel, flight: Flight, bracket: Bracket, windows: int, name: str
) -> InnovationsProblem:
    shooting = ShootingProblem(
        model,
        flight,
        sigma=np.full(12, _FIRST_SIGMA),
        channels="rates",
        method="rk4",
        windows=windows,
        unknowns=Unknowns.of(model, bracket),
    )
    measured, unknowns = np.count_nonzero(~np.isnan(shooting.recorded())), len(model.parameter_names)
    if measured <= unknowns:
        raise InputError(f"{name}: {measured} measurements for {unknowns} unknowns; give a longer flight.")
    samples = flight.time.shape[0]
    segment = min(SEGMENT, max(samples // _FEWEST_SEGMENTS, _SHORTEST_SEGMENT))
    settling = min(SETTLING, max(round(_SETTLED / float(flight.dt)), 1))
    return InnovationsProblem(shooting, segment=segment, settling=settling)


def _held_out(
    recordings: Sequence[Recording],
    validate: Recording | None,
    prepared: preparation.Prepared,
    fitted: ShootingProblem,
    model: FlightModel,
) -> tuple[HeldOut | None, tuple[str, ...]]:
    """The data that are predicted and not fitted, if there are any; and the notes about all data."""
    held_out, notes = None, prepared.notes
    if validate is not None:
        other = _prepare_other(recordings, validate, prepared, model)
        held_out, notes = (
            HeldOut(_on(fitted, model, other.fitted), validate.name, other.seconds[0]),
            notes + other.notes,
        )
    elif prepared.tested is not None:
        whole = dataclasses.replace(fitted, flight=prepared.tested)
        held_out = HeldOut(whole, recordings[0].name, prepared.seconds[1], fitted_vehicle=True)
    if held_out is None:
        return None, (*notes, "nothing was held out, so no prediction checks the fit")
    try:
        starts(held_out.problem.flight)
    except ValueError:
        remedy = "give `holdout` 0 or `validate`" if held_out.fitted_vehicle else "give another flight"
        raise InputError(
            f"{held_out.name}: nothing is long enough to be predicted {max(HORIZONS):g} s ahead; {remedy}."
        ) from None
    return held_out, notes


def _on(fitted: ShootingProblem, model: FlightModel, flight: Flight) -> ShootingProblem:
    """The problem of another flight, which counts as one recording."""
    stretches = 1 if flight.stretch is None else int(flight.stretch.max()) + 1
    other = dataclasses.replace(model, recordings=(0,) * stretches)
    return ShootingProblem(other, flight, sigma=fitted.sigma, channels="rates", method="rk4")


def _prepare_other(
    recordings: Sequence[Recording], validate: Recording, prepared: preparation.Prepared, model: FlightModel
) -> preparation.Prepared:
    """The recording to predict, with the sample time of those that are fitted."""
    if any(validate.same_data(recording) for recording in recordings):
        raise InputError(
            f"{validate.name}: `validate` is fitted already; leave it out: a part of the flight is held out by default."
        )
    step = float(prepared.fitted.dt)
    other = preparation.prepare([validate], model.airframe, sample_time=step, holdout=0.0, predicted=True)
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
            raise InputError(f"`terms`: knows no `{term[:40]}`; the terms are {', '.join(TERMS)}.")
    for term in terms:
        missing = TERMS[term].needs - available
        if FULL_SCALE in missing:
            raise InputError(f"`terms`: {term} needs `max_rotor_speed` in the airframe; set it or leave it out.")
        if missing:
            what = " and ".join(sorted(missing))
            raise InputError(f"`terms`: {term} needs {what}, which these logs did not measure; leave it out.")
    return tuple(term for term in TERMS if term in terms)


def _restricted(problem: ShootingProblem, channels: str, name: str, recording: Recording) -> ShootingProblem:
    """The problem on the channels that an estimator looks at."""
    problem = problem.restrict(channels)
    if np.isnan(np.asarray(problem.flight.states)[:, CASCADE_ORDER[: problem.size]]).all(axis=0).any():
        raise InputError(f"{recording.name}: {name} needs p, q and r; use `estimator` output-error.")
    return problem


def _comparable(other: ShootingProblem, problem: ShootingProblem, validate: Recording) -> ShootingProblem:
    """The other flight's problem on the same channels."""
    other = other.restrict(problem.channels) if other.size > problem.size else other
    if np.isnan(other.recorded()).all():
        raise InputError(
            f"{validate.name}: nothing was measured among the {problem.channels} channels; give another flight."
        )
    return other


def _check_options(name: str, kind: type[AbstractEstimator], settings: FlightSettings, network: GivenNetwork) -> None:
    if network is not None and not kind.needs_network:
        raise InputError(f"`network`: {name} uses none; use `estimator` network or hybrid, or leave it out.")
    if settings.window is not None and not (kind.shoots or kind.needs_network):
        shooting = ", ".join(each for each, other in ESTIMATORS.items() if other.shoots)
        raise InputError(f"`window`: {name} does not shoot; use one of the estimators {shooting}.")
    if settings.window is not None and network is not None:
        raise InputError("`window`: a network of windows serves one flight alone; leave `network` out.")
    if _has_own_channels(kind) and settings.channels not in (None, kind.looks_at):
        raise InputError(
            f"`channels` {settings.channels}: {name} looks at the {kind.looks_at}; use `estimator` output-error."
        )


def _has_own_channels(kind: type[AbstractEstimator]) -> bool:
    return kind.looks_at != "all" and not kind.needs_network
