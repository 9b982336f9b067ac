"""`jaxos4 design`: the input that tells the most within an envelope."""

import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from .._files import read_toml
from ..errors import InputError
from ._choices import (
    AirframeOption,
    BracketOption,
    Channels,
    InitialState,
    InitialStateOption,
    Model,
    ModelOption,
    check_seed,
)
from ._messages import option_names
from ._output import check_different, check_output
from ._progress import stages


class Criterion(StrEnum):
    """The values of --criterion, in the spelling of the library."""

    D = "D"
    A = "A"
    worst = "worst"


def design(
    out: Annotated[Path, typer.Option(help="The rotor speeds to write (CSV: t, omega1..4).")],
    airframe: AirframeOption = "os4",
    model: ModelOption = Model["published"],
    duration: Annotated[float, typer.Option(help="Duration [s].", metavar="SECONDS")] = 5.0,
    dt: Annotated[float, typer.Option(help="Sample time [s].", metavar="SECONDS")] = 0.01,
    slowest: Annotated[float | None, typer.Option(help="Slowest rotor speed [rad/s].")] = None,
    fastest: Annotated[float | None, typer.Option(help="Fastest rotor speed [rad/s].")] = None,
    slew: Annotated[float | None, typer.Option(help="Fastest change of a rotor speed [rad/s^2].")] = None,
    angle: Annotated[float | None, typer.Option(help="Largest roll, pitch and yaw angle [rad].")] = None,
    rate: Annotated[float | None, typer.Option(help="Largest body rate [rad/s].")] = None,
    velocity: Annotated[float | None, typer.Option(help="Largest velocity [m/s].")] = None,
    distance: Annotated[float | None, typer.Option(help="Largest distance from the start [m].")] = None,
    bandwidth: Annotated[float, typer.Option(help="Highest frequency of the input [Hz].", metavar="HERTZ")] = 4.0,
    bracket: BracketOption = None,
    channels: Annotated[Channels, typer.Option(help="Channels that will be measured.")] = Channels["all"],
    initial_state: InitialStateOption = InitialState["free"],
    criterion: Annotated[
        Criterion, typer.Option(help="D: all parameters together; A: the mean squared bound; worst: the largest bound.")
    ] = Criterion["D"],
    accuracy: Annotated[
        float, typer.Option(help="Wanted standard deviation [% of the bracket's half-width].", metavar="PERCENT")
    ] = 1.0,
    figure: Annotated[Path | None, typer.Option(help="SVG file: the input, and the bounds over time.")] = None,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
) -> None:
    """Design the rotor speeds that tell the most, within the envelope of the standard multisine or the given limits."""
    check_output(out, Path(airframe), bracket)
    check_different(out=out, figure=figure)
    if figure is not None:
        check_output(figure, Path(airframe), bracket)
    check_seed(seed)
    if not 0 < accuracy < 1e6:
        raise InputError(f"--accuracy: must be positive and finite, got {accuracy:g}.")
    limits = {
        "slowest": slowest,
        "fastest": fastest,
        "slew": slew,
        "angle": angle,
        "rate": rate,
        "velocity": velocity,
        "distance": distance,
    }
    begin = time.perf_counter()
    with stages("loading the library") as progress, option_names(bracket=bracket):
        from ..airframe import load_airframe
        from ..design import design_and_compare, write_input
        from ..identification.problem import bracket_of
        from ..models import MODELS

        subject = MODELS[model](load_airframe(airframe))
        found = design_and_compare(
            subject,
            limits={name: value for name, value in limits.items() if value is not None},
            bracket=bracket_of(None if bracket is None else read_toml(bracket), subject),
            duration=duration,
            dt=dt,
            channels=channels.value,
            start_is_known=initial_state is InitialState["known"],
            criterion=criterion.value,
            bandwidth=bandwidth,
            seed=seed,
            progress=progress,
        )
        progress("writing")
        write_input(found.designed, out)
        if figure is not None:
            from ..report.figures_design import write_design

            write_design(found, figure)
    from rich.console import Console

    from ..report.design_page import print_design

    print_design(Console(highlight=False), found, accuracy / 100)
    samples = found.designed.omega.shape[0]
    typer.echo(f"{out}: {samples} samples of {dt:g} s, {model.value} model, {time.perf_counter() - begin:.0f} s")
