"""The settings of an identification, and the names of estimators and models."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from ..airframe import Airframe
from ..errors import InputError
from ..estimate import AbstractEstimator
from ..estimators import ESTIMATORS
from ..models import MODELS
from ..models.abstract import AbstractModel


@dataclasses.dataclass(frozen=True)
class FlightSettings:
    """Settings of the identification of an OS4.

    - `channels`: `"rates"`, `"attitude"` or `"all"`: the compared channels; by default everything that was measured.
    - `initial_state`: `"free"`: estimated too; `"known"`: the first sample is exact.
    - `window`: length of the windows for multiple shooting [s]; by default the flight is one window.
    """

    channels: str | None = None
    initial_state: str = "free"
    window: float | None = None


@dataclasses.dataclass(frozen=True)
class VehicleSettings:
    """Settings of the identification of a vehicle.

    - `terms`: of `jaxos4.TERMS`; by default those that the recordings allow.
    - `begin`, `end`: use this part of each recording [s]; by default its usable stretches.
    - `sample_time`: average to samples of this length [s]; by default 0.002 s, or 0.004 s for commands, if the
      recordings have shorter ones.
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
            why = f"is for a real vehicle, not for the {class_name(subject, MODELS)} model"
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
