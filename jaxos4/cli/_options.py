"""The values of options, the options that several commands share, and the checks of their values."""

from pathlib import Path
from typing import Annotated, Any, Literal

from typer import Argument, Option

from .._files import read_toml
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
Criterion = Literal["D", "A", "worst"]


def check_seed(seed: int) -> int:
    """Refuses a random seed that JAX cannot use."""
    if not 0 <= seed < 2**63:
        raise InputError(f"--seed: must lie in 0 to 2^63 - 1, got {seed}.")
    return seed


def check_estimator(name: str | None) -> str | None:
    """Refuses an estimator that neither this package nor another one has."""
    if name is not None and name not in ESTIMATORS:
        raise InputError(f"--estimator: must be one of {', '.join(ESTIMATORS)}, got {name!r}.")
    return name


EstimatorOption = Annotated[
    str | None,
    Option(
        metavar=f"[{'|'.join(ESTIMATORS.data)}]",  # to list those of other packages takes a tenth of a second
        help="The algorithm; default: ibss, or filter-error for a vehicle.",
        callback=check_estimator,
        autocompletion=lambda: list(ESTIMATORS),
    ),
]
FlightFile = Annotated[Path, Argument(metavar="FLIGHT.csv", help="The recorded flight.")]
ModelOption = Annotated[Model, Option(help="Equations of motion: as published, or corrected.")]
AirframeOption = Annotated[
    str, Option(help="A preset (os4, os4-simulator, voos, crazyflie, x500, ...), or a TOML file.")
]
BracketOption = Annotated[Path | None, Option(help="TOML file: alpha1 = [lower, upper], ...")]
ChannelsOption = Annotated[Channels | None, Option(help="Channels to fit. Default: all that were measured.")]
InitialStateOption = Annotated[InitialState, Option(help="free: estimated too; known: equal to the first sample.")]
WindowOption = Annotated[
    float | None, Option(help="Multiple shooting: windows of this length [s], each with its own initial state.")
]
SeedOption = Annotated[int, Option(help="Random seed.", callback=check_seed)]
ColumnsOption = Annotated[
    str | None,
    Option(
        metavar="MAP.toml",
        help="Which columns or topics of the logs hold what: a column map (docs/logs.md), or mavros, px4-ros2, ...",
    ),
]
OutOption = Annotated[Path | None, Option(help="JSON file to write.")]


def given(**settings: Any) -> dict[str, Any]:
    """The settings that have a value."""
    return {name: value for name, value in settings.items() if value is not None}


def read_bracket(path: Path | None) -> dict[str, Any] | None:
    """The table in the file of `--bracket`. Raises `InputError` if it is no TOML file."""
    return None if path is None else read_toml(path)
