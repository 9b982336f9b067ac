"""What the options choose from, and the options that commands share."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from ..estimators import ESTIMATORS
from ..excitation import EXCITATIONS
from ..models import MODELS
from ..models.state import CHANNELS
from ..networks import APPROXIMATORS, FEATURES
from ..simulation import METHODS

Model = StrEnum("Model", list(MODELS))
Excitation = StrEnum("Excitation", list(EXCITATIONS))
Method = StrEnum("Method", list(METHODS))
Channels = StrEnum("Channels", list(CHANNELS))
InitialState = StrEnum("InitialState", ["free", "known"])
Estimator = StrEnum("Estimator", list(ESTIMATORS))
Features = StrEnum("Features", list(FEATURES))
Approximator = StrEnum("Approximator", list(APPROXIMATORS))

VehicleModel = StrEnum("VehicleModel", list((*MODELS, "flight")))
Loss = StrEnum("Loss", ["huber", "squares"])

FlightFile = Annotated[Path, typer.Argument(metavar="FLIGHT.csv", help="The recorded flight.")]
ModelOption = Annotated[Model, typer.Option(help="The equations: as printed, or corrected.")]
AirframeOption = Annotated[str, typer.Option(help="os4, os4-simulator, voos, or a TOML file.")]
BracketOption = Annotated[Path | None, typer.Option(help="TOML file: alpha1 = \\[lower, upper], ...")]
ChannelsOption = Annotated[Channels | None, typer.Option(help="What to compare; all that was measured without it.")]
InitialStateOption = Annotated[
    InitialState, typer.Option(help="free: estimated too; known: the first sample is exact.")
]
WindowOption = Annotated[
    float | None,
    typer.Option(metavar="SECONDS", help="Multiple shooting: windows of this length, each from a state of its own."),
]
OutOption = Annotated[Path | None, typer.Option(help="A JSON file to write.")]
