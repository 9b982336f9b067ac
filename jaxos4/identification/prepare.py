"""From recordings, a subject and settings to a case: what an estimator solves, and what tests the answer."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import msgspec
import numpy as np

from .._version import __version__
from ..airframe import PRESETS, Airframe
from ..errors import InputError
from ..estimate import AbstractEstimator
from ..estimators import ESTIMATORS, Hybrid, make_estimator
from ..logs import Recording
from ..models import MODELS
from ..models.abstract import PARAMETER_NAMES, AbstractModel
from ..models.state import CASCADE_ORDER
from ..networks import TrainedNetwork
from ..networks.file import load_network
from ..recording.checks import KINEMATIC, Finding, self_checks
from ..shooting import InnovationsProblem, ShootingProblem
from .problem import GivenNetwork, Intervals, bracket_of, flight_problem, network_for, network_provenance
from .results import Provenance

Progress = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class FlightSettings:
    """How to look at a flight of an OS4.

    - `channels`: `"rates"`, `"attitude"` or `"all"`: the compared channels; by default everything that was measured.
    - `initial_state`: `"free"`: estimated too; `"known"`: the first sample is exact.
    - `window`: length of the windows for multiple shooting [s]; by default the flight is one window.
    """

    channels: str | None = None
    initial_state: str = "free"
    window: float | None = None


@dataclasses.dataclass(frozen=True)
class VehicleSettings:
    """How to look at recordings of a vehicle.

    - `terms`: of `jaxos4.TERMS`; by default those that the recordings allow.
    - `begin`, `end`: use this part of each recording [s]; by default its usable stretches.
    - `sample_time`: average to samples of this length [s]; by default 0.004 s if the recordings have shorter ones.
    - `holdout`: share of the flight that is held out and predicted, 0 to 0.5; by default 0.25, or 0 with `validate`.
    """

    terms: Sequence[str] | None = None
    begin: float | None = None
    end: float | None = None
    sample_time: float | None = None
    holdout: float | None = None


Settings = FlightSettings | VehicleSettings
S = TypeVar("S", FlightSettings, VehicleSettings)


def settings_for(subject: AbstractModel | Airframe, options: dict[str, Any]) -> Settings:
    """The settings for a subject, from options by name; those that were not given are `None`.

    **Raises:** `InputError` for an option that does not fit the subject.
    """
    given = {name: value for name, value in options.items() if value is not None}
    kind = VehicleSettings if isinstance(subject, Airframe) else FlightSettings
    own = {field.name for field in dataclasses.fields(kind)}
    for name in given:
        if name in own or (name, given[name]) == ("initial_state", "free"):
            continue
        if kind is FlightSettings:
            why = f"is for an `Airframe` as `subject`, not for the {class_name(subject, MODELS)} model"
        elif name == "initial_state":
            raise InputError(f"`initial_state` {given[name]}: a vehicle's filters find their own state; leave it out.")
        else:
            why = "a vehicle is identified from its rates and specific force, without windows"
        raise InputError(f"`{name}`: {why}; leave it out.")
    return kind(**{name: value for name, value in given.items() if name in own})


def own_settings(kind: type[S], settings: Settings | None) -> S:
    """The settings, or the default ones. Raises `InputError` if they are of another kind."""
    if settings is not None and not isinstance(settings, kind):
        what, got = "an airframe" if kind is VehicleSettings else "a model", type(settings).__name__
        raise InputError(f"`settings`: must be {kind.__name__} for {what} as `subject`, got {got}.")
    return kind() if settings is None else settings


Clock = tuple[np.ndarray, np.ndarray]
NO_CLOCK: Clock = np.zeros(0, int), np.zeros(0)


class Case(NamedTuple):
    """Everything that a fit needs, and the measurements that test it.

    - `problem`: the likelihood, with its bracket. `shooting`: the flight and its model.
    - `estimator`: what searches it; `name`: of the estimator.
    - `model`: the name of the equations.
    - `held_out`: the flight with the measurements that are not fitted, if there are any.
    - `recording`: the number of the recording of each sample.
    - `provenance`: data, settings and versions.
    - `validate`: the name of the other recording that `held_out` is; empty: it is a part of the fitted ones.
    - `doubts`: what the logs show that concerns moments of inertia. `log_step`: the longest sample of the logs [s].
    - `clock`: of each sample of a vehicle, the number of its log, and its time in this log [s]. `tested_clock`: the
      same for `held_out`, if that is another recording.
    """

    problem: ShootingProblem | InnovationsProblem
    shooting: ShootingProblem
    estimator: AbstractEstimator
    name: str
    model: str
    held_out: ShootingProblem | None
    recording: np.ndarray
    provenance: Provenance
    validate: str = ""
    doubts: tuple[Finding, ...] = ()
    log_step: float = 0.0
    clock: Clock = NO_CLOCK
    tested_clock: Clock = NO_CLOCK

    @property
    def is_vehicle(self) -> bool:
        """Whether the likelihood allows for disturbances, as that of a vehicle does."""
        return isinstance(self.problem, InnovationsProblem)

    @property
    def room(self) -> int:
        """The number of samples of a padded flight: checks at all sample times share their programs."""
        return self.problem.flight.time.shape[0]


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
    if getattr(model, "parameter_names", None) != PARAMETER_NAMES:
        raise InputError(f"`subject`: must be a model in alpha_1..8 or an airframe, got {type(model).__name__}.")
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
    trained = estimator.network if isinstance(estimator, Hybrid) else estimator
    if not isinstance(trained, TrainedNetwork):
        trained = network if network is None or isinstance(network, TrainedNetwork) else load_network(network)
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
    notes, name_of_other = recording.notes, ""
    if validate is not None and other is not None:
        other, notes, name_of_other = _comparable(other, problem, validate), notes + validate.named_notes, validate.name
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
    one = np.zeros(samples, int)
    doubts = self_checks(recording, model.airframe, checks=KINEMATIC)
    return Case(problem, problem, method, name, subject, other, one, provenance, name_of_other, doubts)


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


def versions(problem: ShootingProblem) -> dict[str, Any]:
    """Versions, device and precision."""
    return {
        "version": __version__,
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "precision": str(problem.flight.time.dtype),
    }


def airframe_name(airframe: Airframe) -> str:
    """The name of a preset, or "custom"."""
    return next((name for name, preset in PRESETS.items() if preset is airframe), "custom")


def class_name(instance: object, kinds: Mapping[str, type]) -> str:
    """The name of an object's class in a table of classes, or else the class's own name."""
    return next((name for name, kind in kinds.items() if type(instance) is kind), type(instance).__name__)


def name_and_class(estimator: str | AbstractEstimator) -> tuple[str, type[AbstractEstimator]]:
    """The name and the class of an estimator. Raises `InputError` for an unknown name."""
    if not isinstance(estimator, str):
        return class_name(estimator, ESTIMATORS), type(estimator)
    if estimator not in ESTIMATORS:
        raise InputError(f"`estimator`: must be one of {', '.join(ESTIMATORS)}, got {estimator!r}.")
    return estimator, ESTIMATORS[estimator]
