"""What an identification returns: typed results, and the same as JSON."""

from typing import Any

import msgspec

from ..analysis.prediction import Predictions
from ..estimate import Estimate
from ..shooting import ShootingProblem


class ParameterEstimate(msgspec.Struct, frozen=True):
    """One estimated parameter.

    - `estimate`: in `unit`; `None` if the parameter is not identifiable.
    - `std`: its standard deviation; `None` if it is not finite.
    - `bound`: the Cramer-Rao bound at the noise that was found, as a standard deviation.
    - `ci95`: the 95 % interval; `None` if the parameter is not identifiable.
    - `unit`: of all these.
    - `note`: what the user must know, or an empty string.
    - `noise_limit`: below this multiple of the noise, the airframe's value could be distinguished from 0. One flight
      of an OS4 only.
    """

    estimate: float | None
    std: float | None
    bound: float | None
    ci95: tuple[float, float] | None
    unit: str
    note: str
    noise_limit: float | None | msgspec.UnsetType = msgspec.UNSET

    @property
    def identifiable(self) -> bool:
        """Whether there is an estimate."""
        return self.estimate is not None


class Constant(msgspec.Struct, frozen=True):
    """A physical constant that follows from the parameters, with its standard deviation.

    `note`: what it rests on. A vehicle's only.
    """

    estimate: float
    std: float
    unit: str
    note: str | msgspec.UnsetType = msgspec.UNSET


class RigidBody(msgspec.Struct, frozen=True):
    """The rigid body that explains the alphas best.

    - `constants`: Ix, Iy, Iz and J_R, those that are identifiable.
    - `consistency_p`: how often the alphas of a rigid body would disagree this much or more; `None`: not tested.
    - `is_rigid_body`: whether no moment of inertia exceeds the sum of the other two; `None`: not tested.
    """

    constants: dict[str, Constant] = {}
    consistency_p: float | None = None
    is_rigid_body: bool | None = None

    def to_dict(self) -> dict[str, Any]:
        """As in the JSON: constants by name, then the tests that were made."""
        tests = {"consistency_p": self.consistency_p, "rigid_body": self.is_rigid_body}
        return msgspec.to_builtins(self.constants) | {k: v for k, v in tests.items() if v is not None}


class ChannelFit(msgspec.Struct, frozen=True):
    """How well one channel is explained: see `jaxos4.Diagnostics` for what the numbers are."""

    rms: float
    unit: str
    percent: float | None
    level: float
    level_p: float
    correlation: float
    white_p: float
    input_correlation: dict[str, float]
    input_p: float


class Validation(msgspec.Struct, frozen=True):
    """How well a flight that was not fitted is explained; `None` where the model's trajectory diverges."""

    flight: str
    cost: float | None
    fit: dict[str, ChannelFit] | None


class HeldParameter(msgspec.Struct, frozen=True):
    """A parameter that was not estimated: its value, and why."""

    value: float
    unit: str
    note: str


class RateSkill(msgspec.Struct, frozen=True):
    """Skill of the predictions of one body rate, by horizon; see `jaxos4.Skill`.

    `equation_error`: the skill of regression with the same terms.
    """

    skill: list[float | None]
    std: list[float | None]
    rmse: list[float | None]
    persistence: list[float | None]
    equation_error: list[float | None]


class PredictionSkill(msgspec.Struct, frozen=True):
    """Skill of predictions of what was not fitted, from so many starts, over horizons [s]."""

    horizons: list[float]
    starts: int
    p: RateSkill
    q: RateSkill
    r: RateSkill


class Identification(msgspec.Struct, frozen=True, kw_only=True):
    """What is common to every identification.

    - `estimator`, `model`: their names.
    - `result`: the name of the result code, see `jaxos4.RESULTS`.
    - `rollouts`: simulated flights that all searches took together.
    - `cost`: 1/2 |W (y - x)|^2 at the answer; `None` without one.
    - `seconds`: from the first computation to the last.
    - `parameters`: by name; empty without an answer of a vehicle.
    - `rigid_body`: moments of inertia.
    - `provenance`: what was identified with what: inputs, settings, versions.
    - `estimate`, `problem`: the same as arrays, and the problem that was solved; not in `to_dict`.
    """

    estimator: str
    model: str
    result: str
    rollouts: int
    cost: float | None
    seconds: float
    parameters: dict[str, ParameterEstimate]
    rigid_body: RigidBody
    provenance: dict[str, Any]
    estimate: Estimate
    problem: ShootingProblem

    @property
    def successful(self) -> bool:
        """Whether the answer can be used."""
        return self.result == "successful"

    def to_dict(self) -> dict[str, Any]:
        """Dictionaries, lists, numbers and strings, ready for JSON."""
        arrays = ("estimate", "problem", "predictions")
        fields = {name: getattr(self, name) for name in self.__struct_fields__ if name not in (*arrays, "rigid_body")}
        return msgspec.to_builtins(fields) | {"constants": self.rigid_body.to_dict()}


class FlightIdentification(Identification, frozen=True, kw_only=True):
    """An OS4 model identified from one flight.

    - `fit`: how well each measured channel is explained, by its name.
    - `validation`: the same of another flight, if there was one.
    """

    fit: dict[str, ChannelFit]
    validation: Validation | None


class VehicleIdentification(Identification, frozen=True, kw_only=True):
    """A real vehicle identified from its recordings.

    - `held`: parameters that were not estimated.
    - `cut`: the share of the measurements that Huber's loss cut.
    - `noise`: standard deviation of the residuals by channel.
    - `skill`: of predictions of what was not fitted; `None` if there is nothing to predict.
    - `predictions`: these predictions; not in `to_dict`.
    """

    held: dict[str, HeldParameter]
    cut: float
    noise: dict[str, float]
    skill: PredictionSkill | None
    predictions: Predictions | None
