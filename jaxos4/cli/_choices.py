"""The values of options, and the options that several commands share."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from ..estimators import ESTIMATORS

# The names in the library's tables, written out because an import of these tables takes seconds; a test compares them.
# `list(...)`: pyright takes the values of a written list for numbers.
Model = StrEnum("Model", list(("published", "corrected")))
Excitation = StrEnum("Excitation", list(("multisine", "doublet", "3211", "chirp")))
Method = StrEnum("Method", list(("euler", "rk4", "diffrax")))
Sensors = StrEnum("Sensors", list(("commands", "speeds")))
Channels = StrEnum("Channels", list(("rates", "attitude", "all")))
InitialState = StrEnum("InitialState", ["free", "known"])
Estimator = StrEnum("Estimator", list(ESTIMATORS))
Simulator = StrEnum("Simulator", list(("mujoco", "rotorpy", "sdf")))
Features = StrEnum("Features", list(("score", "raw")))
Approximator = StrEnum("Approximator", list(("mlp", "cmac")))

VehicleModel = StrEnum("VehicleModel", list((*Model, "flight")))
Loss = StrEnum("Loss", ["huber", "squares"])

FlightFile = Annotated[Path, typer.Argument(metavar="FLIGHT.csv", help="The recorded flight.")]
ModelOption = Annotated[Model, typer.Option(help="Equations of motion: as published, or corrected.")]
AirframeOption = Annotated[str, typer.Option(help="os4, os4-simulator, voos, or a TOML file.")]
BracketOption = Annotated[Path | None, typer.Option(help="TOML file: alpha1 = [lower, upper], ...")]
ChannelsOption = Annotated[Channels | None, typer.Option(help="Channels to fit. Default: all that were measured.")]
InitialStateOption = Annotated[
    InitialState, typer.Option(help="free: estimated too; known: equal to the first sample.")
]
WindowOption = Annotated[
    float | None,
    typer.Option(metavar="SECONDS", help="Multiple shooting: windows of this length, each with its own initial state."),
]
OutOption = Annotated[Path | None, typer.Option(help="JSON file to write.")]


def check_seed(seed: int) -> None:
    """Refuses a random seed that JAX cannot use."""
    if not 0 <= seed < 2**63:
        raise InputError(f"--seed: must lie in 0 to 2^63 - 1, got {seed}.")
