"""`jaxos4.identify`: from recorded flights to parameters with intervals.

There are three steps, each for an OS4 and for a vehicle: prepare data with a likelihood (prepare_os4.py and
prepare_vehicle.py), fit the likelihood (fit.py), and judge the answer (judge.py).
"""

import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, overload

import msgspec

from ..airframe import Airframe
from ..errors import InputError
from ..estimate import AbstractEstimator
from ..logs import Source, as_recording, as_recordings
from ..models import MODELS
from ..models.abstract import PARAMETER_NAMES, AbstractModel
from ..networks import TrainedNetwork
from .data import class_name, silent
from .fit import DEFAULT, fit_os4, fit_vehicle, os4_estimator, vehicle_estimator
from .judge import judge_os4, judge_vehicle
from .prepare_os4 import Intervals, OS4Settings, prepare_os4
from .prepare_vehicle import VehicleSettings, prepare_vehicle
from .results import Identification, OS4Identification, VehicleIdentification

Settings = OS4Settings | VehicleSettings
S = TypeVar("S", OS4Settings, VehicleSettings)


@overload
def identify(
    flights: Source | Sequence[Source],
    subject: AbstractModel,
    *,
    settings: Settings | None = None,
    estimator: str | AbstractEstimator | None = None,
    bracket: Intervals = None,
    network: TrainedNetwork | str | os.PathLike[str] | None = None,
    validate: Source | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = silent,
) -> OS4Identification: ...


@overload
def identify(
    flights: Source | Sequence[Source],
    subject: Airframe,
    *,
    settings: Settings | None = None,
    estimator: str | AbstractEstimator | None = None,
    bracket: Intervals = None,
    network: TrainedNetwork | str | os.PathLike[str] | None = None,
    validate: Source | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = silent,
) -> VehicleIdentification: ...


def identify(
    flights: Source | Sequence[Source],
    subject: AbstractModel | Airframe,
    *,
    settings: Settings | None = None,
    estimator: str | AbstractEstimator | None = None,
    bracket: Intervals = None,
    network: TrainedNetwork | str | os.PathLike[str] | None = None,
    validate: Source | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = silent,
) -> Identification:
    """Identify an OS4 model from one flight, or a real vehicle from one or several recordings.

        found = jaxos4.identify("flight.csv", jaxos4.load_airframe("mine.toml"))
        print(found.summary())

    The noise levels of the sensors are estimated too. `jaxos4 estimate` calls this function.

    **Arguments:**

    - `flights`: the path of a log, a `Flight`, a `Recording` (a flight with a name), or several for a vehicle.
    - `subject`: a model in alpha_1..8, such as `PublishedOS4()`, or the `Airframe` of a real vehicle.
    - `settings`: `OS4Settings` for a model, `VehicleSettings` for an airframe.
    - `estimator`: a name in `jaxos4.estimators.ESTIMATORS`, or an estimator. By default `"ibss"` for a model, and
      `"filter-error"` for a vehicle, which flies in closed loop. The other estimators of a vehicle, such as `"ibss"`,
      search the same likelihood. An object keeps its settings at every sample time; for a vehicle, the name
      `"filter-error"` means a tolerance of 0.001.
    - `bracket`: a `Bracket`, or `[lower, upper]` by parameter name; the model's default for all others.
    - `network`: for a model, a trained network or its file; without it, an estimator that needs a network trains one.
    - `validate`: another flight or path, which is not fitted but predicted.
    - `seed`: random seed for training a network.
    - `progress`: called with the name of each stage.

    **Returns:** an `OS4Identification` or a `VehicleIdentification`. Check its `result`.

    **Raises:** `InputError` for unusable arguments or flights; `TrainingError` if a network cannot be trained.
    """
    if not isinstance(subject, Airframe) and getattr(subject, "parameter_names", None) != PARAMETER_NAMES:
        kinds = "a model in alpha_1..8 or an airframe, which `jaxos4.load_airframe` reads"
        raise InputError(f"`subject`: must be {kinds}, got {type(subject).__name__}.")
    given = subject if isinstance(subject, Airframe) else subject.airframe
    recordings = as_recordings(flights, given)
    if not recordings:
        raise InputError("`flights`: holds no flight; give one.")
    other = None if validate is None else as_recording(validate, "validation flight", given)
    begin = time.perf_counter()
    progress("checking and averaging")
    if isinstance(subject, Airframe):
        estimator = DEFAULT if estimator is None else estimator
        name, wanted = vehicle_estimator(estimator, network), _settings(VehicleSettings, settings)
        several = prepare_vehicle(recordings, subject, wanted, bracket=bracket, validate=other)
        choose = wanted.sample_time is None
        answer, sample_times = fit_vehicle(several, estimator, choose=choose, seed=seed, progress=progress)
        found = judge_vehicle(answer, sample_times, name, progress=progress)
    else:
        wanted = _settings(OS4Settings, settings)
        data, name, estimator = prepare_os4(
            recordings, subject, wanted, estimator=estimator, bracket=bracket, network=network, validate=other
        )
        data, solver = os4_estimator(data, estimator, bracket, seed=seed, progress=progress)
        answer = fit_os4(solver, data.likelihood, progress=progress)
        found = judge_os4(data, answer, solver, name)
    return msgspec.structs.replace(found, seconds=time.perf_counter() - begin)


def _settings(kind: type[S], settings: Settings | None) -> S:
    """The settings, or the default ones. Raises `InputError` if they are of another kind."""
    if settings is not None and not isinstance(settings, kind):
        what, got = "an airframe" if kind is VehicleSettings else "a model", type(settings).__name__
        raise InputError(f"`settings`: must be {kind.__name__} for {what} as `subject`, got {got}.")
    return kind() if settings is None else settings


def settings_for(subject: AbstractModel | Airframe, options: dict[str, Any]) -> Settings:
    """The settings for a subject, from options by name. An option that was not given is `None`.

    **Raises:** `InputError` for an option that does not fit the subject.
    """
    given = {name: value for name, value in options.items() if value is not None}
    kind = VehicleSettings if isinstance(subject, Airframe) else OS4Settings
    own = {field.name for field in dataclasses.fields(kind)}
    for name in given:
        if name in own or (name, given[name]) == ("initial_state", "free"):
            continue
        if kind is OS4Settings:
            why = f"is for a real vehicle, not for the {class_name(subject, MODELS)} model"
        elif name == "initial_state":
            raise InputError(f"`initial_state` {given[name]}: a vehicle's filters find their own state; leave it out.")
        else:
            why = "a vehicle is identified from its rates and specific force, without windows"
        raise InputError(f"`{name}`: {why}; leave it out.")
    return kind(**{name: value for name, value in given.items() if name in own})
