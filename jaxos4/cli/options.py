"""The options of all commands, their choices and checks, and how messages name them."""

import math
import re
from pathlib import Path
from typing import Annotated, Any, Literal

from typer import Argument, Option

from ..errors import InputError
from ..estimators import ESTIMATORS

# The names in the library's tables, written out because an import of these tables takes seconds; a test compares them.
Model = Literal["published", "corrected"]
VehicleModel = Literal["published", "corrected", "flight"]
Excitation = Literal["multisine", "doublet", "3211", "chirp"]
Method = Literal["euler", "rk4", "diffrax"]
Sensors = Literal["commands", "speeds"]
Channels = Literal["rates", "attitude", "all"]
InitialState = Literal["free", "known"]
Simulator = Literal["mujoco", "rotorpy", "sdf", "drone-models", "urdf"]
Features = Literal["score", "raw"]
Architecture = Literal["mlp", "cmac"]
Criterion = Literal["A", "D", "worst"]


ASKED: dict[str, Any] = {}
"""The options of the command that runs, and their values."""


def as_typed(message: str) -> str:
    """A text of the library, which names arguments between backticks, with the options of the command instead.

    An option at its beginning has its file: "--bracket mine.toml: ...".
    """

    def typed(found: re.Match[str]) -> str:
        if found[1] not in ASKED:
            return found[0]
        value, option = ASKED[found[1]], f"--{found[1].replace('_', '-')}"
        return f"{option} {value}" if found.start() == 0 and isinstance(value, Path) else option

    return re.sub(r"`(\w+)`", typed, message)


def check_sizes() -> None:
    """Refuses numbers of options that are far larger than any time, speed, size or count."""
    most = 1e9
    for name, given in ASKED.items():
        for value in given if isinstance(given, tuple) else (given,):
            if name != "seed" and isinstance(value, int | float) and not math.isnan(value) and abs(value) > most:
                raise InputError(f"`{name}`: must lie within +-{most:g}, got {value:.6g}.")


def _check_seed(seed: int) -> int:
    """Refuses a random seed that JAX cannot use."""
    if not 0 <= seed < 2**63:
        raise InputError(f"--seed: must lie in 0 to 2^63 - 1, got {seed}.")
    return seed


def _check_estimator(name: str | None) -> str | None:
    """Refuses an estimator that neither this package nor another one has."""
    if name is not None and name not in ESTIMATORS:
        raise InputError(f"--estimator: must be one of {', '.join(ESTIMATORS)}, got {name!r}.")
    return name


def given(**settings: Any) -> dict[str, Any]:
    """The settings that have a value."""
    return {name: value for name, value in settings.items() if value is not None}


_File = Path | None
_Number = float | None

# Files to read.
Flights = Annotated[list[Path], Argument(metavar="FLIGHT...", help="A flight, or logs of one vehicle.")]
OneFlight = Annotated[Path, Argument(metavar="FLIGHT.csv", help="The recorded flight.")]
TrainedFlight = Annotated[Path, Argument(metavar="FLIGHT.csv", help="A flight with the inputs to train for.")]
Log = Annotated[Path, Argument(metavar="LOG", help="A flight in one of the formats of docs/logs.md.")]
Result = Annotated[Path, Argument(metavar="RESULT.json", help="A vehicle: a file of `jaxos4 estimate --out`.")]
Designed = Annotated[
    _File, Argument(metavar="[RESULT.json]", help="A vehicle of `estimate --out`; implies --closed-loop.")
]
Compared = Annotated[
    list[Path] | None, Argument(metavar="[RESULT.json...]", help="Results to compare. Without them: all estimators.")
]
Specification = Annotated[Path, Argument(metavar="SPEC.toml", help="The specification of the study.")]
Reported = Annotated[Path, Argument(metavar="SOURCE", help="The folder of a study, or a file of `estimate --out`.")]
Bracket = Annotated[_File, Option(help="TOML file: alpha1 = [lower, upper], ...")]
Columns = Annotated[
    str | None,
    Option(
        metavar="MAP.toml",
        help="Which columns or topics of the logs hold what: a column map (docs/logs.md), or mavros, px4-ros2, ...",
    ),
]
Network = Annotated[_File, Option(help="A file of `jaxos4 train`; without it, a network is trained now.")]
Validate = Annotated[_File, Option(help="Another flight: not fitted, but predicted.")]
Speeds = Annotated[_File, Option(help="CSV of rotor speeds from `design` to fly, instead of an excitation.")]
References = Annotated[_File, Option(help="With --closed-loop: CSV of references from `design`. Default: random.")]

# Files to write.
Json = Annotated[_File, Option(help="JSON file to write.")]
Predictions = Annotated[_File, Option(help="The predictions, as netCDF (.nc) or CSV (.csv).")]
Figure = Annotated[_File, Option(help="A figure to write (.svg).")]
Page = Annotated[_File, Option("--report", help="An HTML page to write.")]
AirframeOut = Annotated[
    _File, Option(metavar="FILE.toml", help="An airframe to write: what the log knows, and what must be measured.")
]
FlightOut = Annotated[Path, Option(help="The flight file to write (CSV).")]
DesignOut = Annotated[Path, Option(help="The CSV to write: rotor speeds; with --closed-loop: references.")]
NetworkOut = Annotated[Path, Option(help="The network file to write.")]
ExportOut = Annotated[_File, Option(help="The file to write; with --samples, the folder. Default: standard output.")]
StudyOut = Annotated[Path, Option(help="Folder of the study: a new one, or one to resume.")]
ComparisonOut = Annotated[_File, Option(help="The folder to write. Default: comparison, or comparison-quick.")]
PageOut = Annotated[_File, Option(help="Of a file: the page to write. Default: beside it, as .html.")]
Csv = Annotated[_File, Option(help="Of a study: errors, bounds, efficiency and coverage as a table (CSV).")]
Pdf = Annotated[bool, Option("--pdf", help="Of a study: the figures as PDF too.")]

# The vehicle, its model and what is fitted.
Airframe = Annotated[str, Option(help="A preset (os4, os4-simulator, voos, crazyflie, x500, ...), or a TOML file.")]
VehicleAirframe = Annotated[
    str | None, Option(help="A preset (os4, crazyflie, x500, ...) or a TOML file; a real vehicle needs one.")
]
Equations = Annotated[Model, Option(help="Equations of motion: as published, or corrected.")]
OpenLoopEquations = Annotated[Model | None, Option(help="Equations of motion. Default: published.")]
VehicleEquations = Annotated[
    VehicleModel | None, Option(help="Equations: as published, corrected, or of a real vehicle. Default: by the log.")
]
Estimator = Annotated[
    str | None,
    Option(
        metavar=f"[{'|'.join(ESTIMATORS.data)}]",  # to list those of other packages takes a tenth of a second
        help="The algorithm; default: ibss, or filter-error for a vehicle.",
        callback=_check_estimator,
        autocompletion=lambda: list(ESTIMATORS),
    ),
]
FittedChannels = Annotated[Channels | None, Option(help="Channels to fit. Default: all that were measured.")]
SeenChannels = Annotated[
    Channels | None, Option(help="Channels that it sees. Default: rates, and attitude if a rate was not measured.")
]
MeasuredChannels = Annotated[Channels | None, Option(help="Channels that will be measured. Default: all.")]
FirstState = Annotated[InitialState, Option(help="free: estimated too; known: equal to the first sample.")]
DesignedFirstState = Annotated[
    InitialState | None, Option(help="free: estimated too (default); known: equal to the first sample.")
]
Window = Annotated[_Number, Option(help="Multiple shooting: windows of this length [s], each with an initial state.")]
Terms = Annotated[str | None, Option(help="Real vehicle: offset,damping,...; default: what the logs allow.")]
Begin = Annotated[_Number, Option("--begin", "--from", help="Real vehicle: first time to use [s].")]
End = Annotated[_Number, Option("--end", "--to", help="Real vehicle: last time to use [s].")]
SampleTime = Annotated[_Number, Option(help="Real vehicle: the sample time to average to [s]. Default: the best.")]
Holdout = Annotated[_Number, Option(help="Real vehicle: the share to predict; default: 0.25.")]
Verbose = Annotated[bool, Option("--verbose", "-v", help="Real vehicle: all parameters, noise and predictions.")]

# Training, export and prediction.
SeenFeatures = Annotated[Features, Option(help="What the network sees.")]
NetworkKind = Annotated[Architecture, Option(help="A multilayer perceptron, or CMAC: tables of weights.")]
TrainedNoise = Annotated[
    tuple[float, float], Option(help="Lowest and highest noise to train for, in multiples of the standard noise.")
]
Steps = Annotated[int, Option(help="Number of training steps.")]
Seed = Annotated[int, Option(help="Random seed.", callback=_check_seed)]
Target = Annotated[Simulator, Option(help="MuJoCo (MJCF), RotorPy, SDF (Gazebo), drone_models (crazyflow) or URDF.")]
Samples = Annotated[int, Option(metavar="N", help="Draw N vehicles from the uncertainty, with a manifest.")]
InertiaZ = Annotated[_Number, Option(help="Iz to use [kg m^2], as far as a rigid body can have it, if Iz is a guess.")]
Horizon = Annotated[float, Option(help="How far ahead to predict [s].")]
AveragedTo = Annotated[_Number, Option(help="The sample time to average to [s]. Default: that of the estimate.")]
Spacing = Annotated[float, Option(help="Time between two starts [s]; 0: from each sample.")]

# Simulated and designed flights.
ClosedLoop = Annotated[bool, Option("--closed-loop", help="A controller flies a real vehicle through gusts.")]
Duration = Annotated[_Number, Option(help="Duration [s]. Default: 5; with --closed-loop: 20.")]
Step = Annotated[_Number, Option(help="Sample time [s]. Default: 0.01; with --closed-loop: 0.004.")]
Shape = Annotated[Excitation | None, Option(help="Shape of the inputs. Default: multisine.")]
Integrator = Annotated[Method | None, Option(help="Integrator of the equations of motion. Default: euler.")]
Noise = Annotated[_Number, Option(help="White sensor noise, in multiples of the standard noise. Default: 0.")]
Gust = Annotated[_Number, Option(help="With --closed-loop: RMS of torque / inertia [rad/s^2]. Default: 5.")]
Lag = Annotated[_Number, Option(help="With --closed-loop: lag of the rotors [s]. Default: 0.05.")]
Delay = Annotated[_Number, Option(help="With --closed-loop: delay of the commands [s]. Default: 0.01.")]
LoadSag = Annotated[_Number, Option(help="With --closed-loop: share of a command lost for each further hover load.")]
GyroCutoff = Annotated[_Number, Option(help="With --closed-loop: cut-off of the gyro's filter [Hz]. Default: none.")]
GyroDelay = Annotated[_Number, Option(help="With --closed-loop: delay of the gyro [s]. Default: 0.")]
LogEvery = Annotated[int | None, Option(help="With --closed-loop: controller runs in a sample of the log. Default: 1.")]
Logged = Annotated[
    Sensors | None, Option(help="With --closed-loop: what is logged. Default: commands, if they can be.")
]
Slowest = Annotated[_Number, Option(help="Slowest rotor speed [rad/s].")]
Fastest = Annotated[_Number, Option(help="Fastest rotor speed [rad/s].")]
Slew = Annotated[_Number, Option(help="Fastest change of a rotor speed [rad/s^2].")]
Angle = Annotated[_Number, Option(help="Largest angle [rad]; with --closed-loop: of the references, by default 0.3.")]
Rate = Annotated[_Number, Option(help="Largest body rate [rad/s].")]
Velocity = Annotated[_Number, Option(help="Largest velocity [m/s].")]
Distance = Annotated[_Number, Option(help="Largest distance from the start [m].")]
Bandwidth = Annotated[_Number, Option(help="Highest frequency [Hz]. Default: 4; with --closed-loop: 6.")]
BestBy = Annotated[
    Criterion | None,
    Option(
        help="A: the mean squared bound; D: the volume of the confidence ellipsoid; worst: the largest bound. "
        "Default: A; with --closed-loop: D."
    ),
]
Accuracy = Annotated[
    _Number,
    Option(help="Wanted standard deviation [% of half a bracket]. Default: 1; with --closed-loop: 5 % of inertias."),
]

# Studies.
DryRun = Annotated[bool, Option("--dry-run", help="Only show the plan.")]
Scheduler = Annotated[str | None, Option(help="Address of a Dask scheduler. Default: this machine.")]
Quick = Annotated[bool, Option("--quick", help="Only body rates, 128 flights and four estimators.")]
