"""The result of an identification: typed, and as JSON."""

from typing import TYPE_CHECKING, Any

import msgspec
from jaxtyping import Array, PRNGKeyArray

from .._custom_types import NotNegative, Positive, as_list
from ..airframe import Airframe, airframe_table
from ..analysis.diagnostics import Correlations
from ..analysis.frequency_response import FrequencyResponse
from ..analysis.prediction import Predictions
from ..analysis.traces import Traces
from ..estimate import Estimate
from ..results import NINETY_FIVE, NO_ANSWER
from ..shooting import ShootingProblem
from .data import Provenance
from .verdict import Issue, Verdict

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from ..report import Plots

VEHICLE_MODEL = "flight"  # the name of the model of a vehicle, in files and on the command line
APART = {"rigid_body", "airframe", "estimate", "problem"}  # fields that a file holds in another form, or not at all
LATE = 0.005  # s; a `rotor_delay` below minus this means that motors are recorded late


class ParameterEstimate(msgspec.Struct, frozen=True):
    """One estimated parameter.

    - `estimate`, `ci95`: the estimate and its 95 % interval; `None` if the parameter is not identifiable.
    - `std`: standard deviation of the estimate; `None` if it is not finite. That of `thrust_gain` includes 1 % for the
      accelerometer's scale.
    - `bound`: the Cramer-Rao bound at the estimated noise levels, as a standard deviation.
    - `unit`: the unit of these fields. `note`: a warning, or an empty string.
    - `bracket`: where the parameter was searched; for a vehicle, a prior with this centre and half-width.
    - `noise_limit`: the airframe's value could be distinguished from 0 up to this multiple of the noise. Only for one
      flight of an OS4.
    """

    estimate: float | None
    std: NotNegative | None
    bound: float | None
    ci95: tuple[float, float] | None
    unit: str
    note: str
    noise_limit: float | None | msgspec.UnsetType = msgspec.UNSET
    bracket: tuple[float, float] | None | msgspec.UnsetType = msgspec.UNSET

    @property
    def is_below_noise(self) -> bool:
        """Whether the estimate cannot be distinguished from 0."""
        return self.ci95 is not None and self.ci95[0] < 0 < self.ci95[1]

    def is_outside_bracket(self, times: float = 1.0) -> bool:
        """Whether the estimate lies outside the bracket, or one that is this many times as wide, if there are both."""
        wider = self.wider_bracket(times)
        return self.estimate is not None and wider is not None and not wider[0] <= self.estimate <= wider[1]

    def wider_bracket(self, times: float) -> tuple[float, float] | None:
        """The bracket, this many times as wide about its centre; `None` without one."""
        if not isinstance(self.bracket, tuple):
            return None
        lower, upper = self.bracket
        more = (times - 1) * (upper - lower) / 2
        return lower - more, upper + more


class Constant(msgspec.Struct, frozen=True):
    """A physical constant that follows from the parameters. `note`: its condition on the airframe (vehicle only)."""

    estimate: float
    std: NotNegative
    unit: str
    note: str | msgspec.UnsetType = msgspec.UNSET

    @property
    def margin(self) -> float:
        """Half the width of the 95 % interval."""
        return NINETY_FIVE * self.std

    @property
    def ci95(self) -> tuple[float, float]:
        """The 95 % interval."""
        return self.estimate - self.margin, self.estimate + self.margin


class RigidBody(msgspec.Struct, frozen=True):
    """The moments of inertia that explain alpha_1..8 best.

    - `constants`: Ix, Iy, Iz and J_R, as far as they are identifiable.
    - `consistency_p`: the probability that the alphas of a rigid body disagree this much or more; `None`: not tested.
    - `is_rigid_body`: whether no moment of inertia exceeds the sum of the other two; `None`: not tested.
    """

    constants: dict[str, Constant] = {}
    consistency_p: float | None = None
    is_rigid_body: bool | None = None

    def to_dict(self) -> dict[str, Any]:
        """Constants by name, then the tests that were made."""
        tests = {"consistency_p": self.consistency_p, "rigid_body": self.is_rigid_body}
        return msgspec.to_builtins(self.constants) | {k: v for k, v in tests.items() if v is not None}


COLOURED = 0.3
"""Residuals are coloured if neighbours correlate by more than this: intervals then allow for it."""


class ChannelFit(msgspec.Struct, frozen=True):
    """The fit of the model to one channel; see `jaxos4.Diagnostics`. `correlation`: of neighbouring residuals."""

    rms: float
    unit: str
    percent: float | None
    level: NotNegative
    level_p: float
    correlation: float
    white_p: float
    input_correlation: dict[str, float]
    input_p: float


class Validation(msgspec.Struct, frozen=True):
    """The fit of the model to another flight. `cost` and `fit` are `None` if its trajectory diverges."""

    flight: str
    cost: float | None
    fit: dict[str, ChannelFit] | None


class FixedParameter(msgspec.Struct, frozen=True):
    """A parameter that was not estimated: the value used for it, and why."""

    value: float
    unit: str
    note: str


class RateSkill(msgspec.Struct, frozen=True):
    """Predictions of one body rate by horizon; see `jaxos4.Skill`. `equation_error`: skill of a regression."""

    skill: list[float | None]
    std: list[float | None]
    rmse: list[float | None]
    persistence: list[float | None]
    equation_error: list[float | None]


class Disturbance(msgspec.Struct, frozen=True):
    """The disturbance of a channel: everything that acts on it besides the model.

    - `strength`: standard deviation, in `unit`. `time_constant`: of the Ornstein-Uhlenbeck process [s].
    - `sensor`: standard deviation of the sensor's white noise, in the unit of the channel.
    - `correlation`: the largest correlation of innovations up to 8 samples apart; near 0 if the noise is as modelled.
    - `smoothing`: the time constant of the low-pass filter through which the disturbance of a specific force acts [s].
    """

    strength: NotNegative
    unit: str
    time_constant: Positive
    sensor: NotNegative
    correlation: float
    smoothing: float | None = None

    @property
    def correlation_time(self) -> float:
        """The integral of the autocorrelation over positive lags [s]."""
        return self.time_constant + (self.smoothing or 0.0)


class SampleTime(msgspec.Struct, frozen=True):
    """The moments of inertia of a vehicle at one sample time [s].

    - `correlation`: the largest correlation of a body rate's innovations. `samples`: their number for each rate.
    """

    sample_time: Positive
    constants: dict[str, Constant]
    correlation: float
    samples: int


class PredictionSkill(msgspec.Struct, frozen=True):
    """Skill of `starts` predictions of measurements that were not fitted, by horizon [s]."""

    horizons: list[float]
    starts: int
    p: RateSkill
    q: RateSkill
    r: RateSkill


class Identification(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """The parameters of a quadrotor, and the evidence by which to judge them.

    Made by `jaxos4.identify`, or read from a file by `jaxos4.read_result`; either is an `OS4Identification` or a
    `VehicleIdentification`.

    - `estimator`, `model`: their names.
    - `result`: the name of the result code, see `jaxos4.RESULTS`.
    - `rollouts`: simulated flights in all searches; for a vehicle, in its estimator's at the chosen sample time.
    - `cost`: 1/2 |W (y - x)|^2 at the estimate; for a vehicle, the negative log-likelihood. `None` if not finite.
    - `seconds`: computing time [s].
    - `parameters`: by name. Without an answer, a vehicle has none.
    - `rigid_body`: moments of inertia.
    - `verdicts`: for each quantity, whether it can be trusted, and why not. Empty without an answer.
    - `issues`: the failed checks of the estimate, and how far each would move a quantity. In files: `doubts`.
    - `provenance`: inputs, settings, versions, and notes about the data.
    - `covariance`: of `parameters`; `None` without an answer.
    - `airframe`: the constants that were not estimated.
    - `estimate`, `problem`: the estimate of all unknowns as arrays, and the flight with its model and the estimated
      noise levels. Files do not hold them: `None` if the result was read from one.
    - `traces`: signals of the fitted flights, at most 1,200 samples. `correlations`: of the residuals. `None` without
      an answer.
    """

    estimator: str
    model: str
    result: str
    rollouts: int = 0
    cost: float | None = None
    seconds: float = 0.0
    parameters: dict[str, ParameterEstimate]
    rigid_body: RigidBody = RigidBody()
    verdicts: dict[str, Verdict] = {}
    issues: tuple[Issue, ...] = msgspec.field(default=(), name="doubts")
    provenance: Provenance
    covariance: list[list[float]] | None
    airframe: Airframe
    estimate: Estimate | None = None
    problem: ShootingProblem | None = None
    traces: Traces | None = None
    correlations: Correlations | None = None

    @property
    def successful(self) -> bool:
        """Whether what was asked for can be trusted: Ix and Iy of a vehicle; of an OS4, no alpha is contradicted."""
        return self.result == "successful"

    @property
    def is_vehicle(self) -> bool:
        """Whether it is a `VehicleIdentification`."""
        return isinstance(self, VehicleIdentification)

    @property
    def has_answer(self) -> bool:
        """Whether there is an estimate at all."""
        return self.result not in NO_ANSWER

    @property
    def logs(self) -> tuple[str, ...]:
        """The names of the flights that were fitted."""
        return tuple(self.provenance.flights or (self.provenance.flight or "flight",))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the estimate cannot be trusted, or only with care, and what to do; one line each."""
        return tuple(issue.warning for issue in self.issues)

    @property
    def motor_clock(self) -> str:
        """The delay of the recorded motors in words, if `rotor_delay` is clearly negative; else empty."""
        delay = self.parameters.get("rotor_delay")
        if delay is None or delay.estimate is None or delay.estimate > -LATE:
            return ""
        return f"motors are recorded {-1e3 * delay.estimate:.0f} ms late"

    def sample(self, samples: int, *, key: PRNGKeyArray) -> dict[str, Array]:
        """Vehicles drawn from the uncertainty, ready for `jax.vmap`; see `jaxos4.export.sample_vehicles`."""
        from ..export import sample_vehicles

        return sample_vehicles(self, samples, key=key)

    def to_dict(self) -> dict[str, Any]:
        """Dictionaries, lists, numbers and strings, which `jaxos4 estimate` writes as JSON.

        `airframe` has the keys of an airframe's file. `covariance` has the rows and columns of `parameters`.
        """
        every = msgspec.structs.fields(self)
        fields = {field.encode_name: getattr(self, field.name) for field in every if field.name not in APART}
        fields |= {"constants": self.rigid_body.to_dict(), "airframe": airframe_table(self.airframe)}
        return msgspec.to_builtins(fields, enc_hook=as_list)

    def summary(self, *, verbose: bool = False, width: int = 80) -> str:
        """The text of `jaxos4 estimate` on a terminal of this width [columns]. `verbose`: with all parameters."""
        from ..report import identification_summary

        return identification_summary(self, verbose=verbose, width=width)

    def __repr__(self) -> str:
        inertias = "".join(f", {name} = {row.estimate:.4g} kg m^2" for name, row in self.rigid_body.constants.items())
        return f"<Identification by {self.estimator}, {self.model} model: {self.result}{inertias}; see summary()>"

    def _repr_html_(self) -> str:
        """Verdict, physical quantities and reservations, for a notebook."""
        from ..report import identification_html

        return identification_html(self)

    @property
    def plot(self) -> "Plots":
        """Figures on one axis each, such as `found.plot.rates()`; see `jaxos4.report.Plots`."""
        from ..report import Plots

        return Plots(self)

    def to_dataframe(self) -> "pd.DataFrame":
        """Constants, parameters and fixed parameters (`held`) as a pandas DataFrame, in rows by name.

        Columns: `kind`, `unit`, `estimate`, `std`, `low` and `high` (the 95 % interval), `bound`, `note`.

        **Raises:** `InputError` if pandas is not installed.
        """
        from .tables import dataframe

        return dataframe(self)

    def to_dataset(self) -> "xr.Dataset":
        """Parameters, covariance, predictions and response as an xarray Dataset.

        Dimensions: `parameter`, `other` (the same names), `start` [s], `horizon` [s], `rate`, `axis`, `frequency` [Hz].

        **Raises:** `InputError` if xarray is not installed.
        """
        from .tables import dataset

        return dataset(self)


class OS4Identification(Identification, frozen=True, kw_only=True, eq=False):
    """The parameters of an OS4, from one flight.

    - `fit`: how well the model explains each measured channel, by the channel's name.
    - `validation`: the same for another flight, if one was given.
    """

    fit: dict[str, ChannelFit] = {}
    validation: Validation | None = None


class VehicleIdentification(Identification, frozen=True, kw_only=True, eq=False):
    """The parameters of a real vehicle, from its recorded flights.

    - `held`: parameters that were not estimated.
    - `noise`: standard deviation of the sensors' noise by channel.
    - `disturbances`: the accelerations that the model lacks, by channel.
    - `widened`: the factor by which an interval was widened because parts of the flights disagree, by parameter.
    - `sample_times`: the moments of inertia at each sample time that belongs to the answer; empty if only one does.
    - `skill`: of predictions of measurements that were not fitted; `None` if there are none.
    - `predictions`: the predictions themselves, at most 1,200 starts. `trajectories`: the same every 20 ms, at most 40.
    - `response`: the frequency response with the fitted data. `None` without an answer.
    """

    model: str = VEHICLE_MODEL
    held: dict[str, FixedParameter] = {}
    noise: dict[str, float] = {}
    disturbances: dict[str, Disturbance] = {}
    widened: dict[str, float] = {}
    sample_times: tuple[SampleTime, ...] = ()
    skill: PredictionSkill | None = None
    predictions: Predictions | None = None
    trajectories: Predictions | None = None
    response: FrequencyResponse | None = None
