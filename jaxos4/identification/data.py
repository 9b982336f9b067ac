"""`Data`: flights and their likelihood, prepared for a search, with their provenance."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import msgspec
import numpy as np
from jaxtyping import Float, Int

from .._custom_types import Positive
from .._version import __version__
from ..airframe import PRESETS
from ..errors import check_choice
from ..estimate import AbstractEstimator
from ..estimators import ESTIMATORS
from ..recording.checks import Finding
from ..shooting import InnovationsProblem, ShootingProblem

Progress = Callable[[str], None]
L = TypeVar("L", ShootingProblem, InnovationsProblem)


def silent(stage: str) -> None:
    """Ignores progress."""


class HeldOut(NamedTuple):
    """Measurements that are not fitted.

    - `problem`: the flight and its model.
    - `recording`: the name of another recording; `None`: a part of the fitted recordings was held out.
    - `time`: of each sample in the log of that recording [s]; empty for an OS4 or a held-out part.
    """

    problem: ShootingProblem
    recording: str | None = None
    time: Float[np.ndarray, " samples"] = np.zeros(0)


class Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """Inputs, settings and versions of an identification. Fields that do not apply are not written.

    - `flight`: the name of an OS4's flight; `flights`, `validate`: the names of a vehicle's recordings.
    - `airframe`: its name or file; `terms`: of the vehicle's model; `battery_voltage`: the usual voltage [V].
    - `channels`, `initial_state`, `windows`, `samples`: of an OS4's `ShootingProblem`.
    - `sample_time`: of the fitted data [s]. `fitted_seconds`, `tested_seconds`: duration of fitted and test data [s].
    - `network`: the origin of a network, and how it was trained.
    - `notes`: about the data. `command`: the command line, if there was one.
    - `version`, `jax`, `device`, `precision`: of the computation.
    """

    flight: str | msgspec.UnsetType = msgspec.UNSET
    flights: list[str] | msgspec.UnsetType = msgspec.UNSET
    validate: str | None | msgspec.UnsetType = msgspec.UNSET
    airframe: str
    channels: str | msgspec.UnsetType = msgspec.UNSET
    initial_state: str | msgspec.UnsetType = msgspec.UNSET
    windows: int | msgspec.UnsetType = msgspec.UNSET
    samples: int | msgspec.UnsetType = msgspec.UNSET
    terms: list[str] | msgspec.UnsetType = msgspec.UNSET
    sample_time: Positive
    fitted_seconds: float | msgspec.UnsetType = msgspec.UNSET
    tested_seconds: float | msgspec.UnsetType = msgspec.UNSET
    battery_voltage: float | msgspec.UnsetType = msgspec.UNSET
    network: dict[str, Any] | msgspec.UnsetType = msgspec.UNSET
    notes: list[str] = []
    command: str | msgspec.UnsetType = msgspec.UNSET
    version: str
    jax: str
    device: str
    precision: str

    @classmethod
    def of(cls, problem: ShootingProblem, notes: Sequence[str], **own: Any) -> "Provenance":
        """The provenance of a flight that is fitted. `own`: the fields of its kind.

        `airframe`: the name of a preset, or "custom".
        """
        airframe, flight = problem.model.airframe, problem.flight
        return cls(
            airframe=next((name for name, preset in PRESETS.items() if preset is airframe), "custom"),
            sample_time=float(flight.dt),
            notes=list(notes),
            version=__version__,
            jax=jax.__version__,
            device=jax.devices()[0].device_kind,
            precision=str(flight.time.dtype),
            **own,
        )


@dataclasses.dataclass(frozen=True)
class Data(Generic[L]):
    """Flights as they are fitted, the measurements that test the answer, and facts about both.

    - `likelihood`: the likelihood with its bracket; padded for a vehicle.
    - `problem`: the flight and its model.
    - `provenance`: data, settings and versions.
    - `log`, `time`: of each sample for a vehicle, the number of its log and its time in that log [s].
    - `held_out`: the measurements that are not fitted, if any.
    - `findings`: faults of the logs that concern moments of inertia, or contradict another quantity.
    - `log_step`: the longest sample of the logs [s].
    - `motor_step`: the longest time between new values of the motors in the logs [s].
    - `vibrates`: the body rates that vibrate, each with its frequency [Hz].
    - `follows_commands`: whether rotor speeds are computed from commands.
    """

    likelihood: L
    problem: ShootingProblem
    provenance: Provenance
    log: Int[np.ndarray, " samples"] = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    time: Float[np.ndarray, " samples"] = dataclasses.field(default_factory=lambda: np.zeros(0))
    held_out: HeldOut | None = None
    findings: tuple[Finding, ...] = ()
    log_step: float = 0.0
    motor_step: float = 0.0
    vibrates: Mapping[str, float] = dataclasses.field(default_factory=dict)
    follows_commands: bool = False

    @property
    def contains_answers(self) -> bool:
        """Whether samples hold the controller's answers as commands: feedthroughs then explain most innovations."""
        return self.follows_commands and bool(getattr(self.likelihood, "answers_within", False))


def class_name(instance: object, kinds: Mapping[str, type]) -> str:
    """The name of an object's class in a table of classes, or else the class's own name."""
    return next((name for name, kind in kinds.items() if type(instance) is kind), type(instance).__name__)


def name_and_class(estimator: str | AbstractEstimator) -> tuple[str, type[AbstractEstimator]]:
    """The name and the class of an estimator. Raises `InputError` for an unknown name."""
    if not isinstance(estimator, str):
        return class_name(estimator, ESTIMATORS), type(estimator)
    check_choice("estimator", estimator, ESTIMATORS)
    return estimator, ESTIMATORS[estimator]
