"""`jaxos4 design`: the rotor speeds, or the references of a controller, that tell the most within an envelope."""

import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from .._files import read_toml
from ..errors import InputError
from ._choices import AirframeOption, BracketOption, Channels, InitialState, Model, check_seed
from ._loop import (
    DelayOption,
    DurationOption,
    GustOption,
    LagOption,
    SampleTimeOption,
    SensorsOption,
    check_kind,
    loop_of,
    times_of,
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
    out: Annotated[Path, typer.Option(help="The CSV to write: rotor speeds; with --closed-loop: references.")],
    airframe: AirframeOption = "os4",
    closed_loop: Annotated[
        bool, typer.Option("--closed-loop", help="References for a real vehicle, which flies under its controller.")
    ] = False,
    model: Annotated[Model | None, typer.Option(help="Equations of motion. Default: published.")] = None,
    duration: DurationOption = None,
    dt: SampleTimeOption = None,
    slowest: Annotated[float | None, typer.Option(help="Slowest rotor speed [rad/s].")] = None,
    fastest: Annotated[float | None, typer.Option(help="Fastest rotor speed [rad/s].")] = None,
    slew: Annotated[float | None, typer.Option(help="Fastest change of a rotor speed [rad/s^2].")] = None,
    angle: Annotated[
        float | None,
        typer.Option(
            help="Largest roll, pitch and yaw angle [rad]; with --closed-loop: that of the references. Default: 0.3."
        ),
    ] = None,
    rate: Annotated[float | None, typer.Option(help="Largest body rate [rad/s].")] = None,
    velocity: Annotated[float | None, typer.Option(help="Largest velocity [m/s].")] = None,
    distance: Annotated[float | None, typer.Option(help="Largest distance from the start [m].")] = None,
    bandwidth: Annotated[
        float | None, typer.Option(help="Highest frequency [Hz]. Default: 4; with --closed-loop: 6.", metavar="HERTZ")
    ] = None,
    bracket: BracketOption = None,
    channels: Annotated[Channels | None, typer.Option(help="Channels that will be measured. Default: all.")] = None,
    initial_state: Annotated[
        InitialState | None, typer.Option(help="free: estimated too; known: equal to the first sample. Default: free.")
    ] = None,
    criterion: Annotated[
        Criterion, typer.Option(help="D: all parameters together; A: the mean squared bound; worst: the largest bound.")
    ] = Criterion["D"],
    accuracy: Annotated[
        float | None,
        typer.Option(
            help="Wanted standard deviation [% of the bracket's half-width]. Default: 1; "
            "with --closed-loop: 5 % of Ix, Iy and Iz.",
            metavar="PERCENT",
        ),
    ] = None,
    gust: GustOption = None,
    lag: LagOption = None,
    delay: DelayOption = None,
    sensors: SensorsOption = None,
    figure: Annotated[Path | None, typer.Option(help="SVG file: what to fly, and the bounds over time.")] = None,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
) -> None:
    """Design what to fly, within limits: the rotor speeds, or the references of a controller, that tell the most."""
    check_output(out, Path(airframe), bracket)
    check_different(out=out, figure=figure)
    if figure is not None:
        check_output(figure, Path(airframe), bracket)
        if figure.suffix != ".svg":
            raise InputError(f"--figure {figure}: the figure is an SVG file; give it a name that ends in .svg.")
    check_kind(
        closed_loop,
        of_open={"model": model, "slew": slew, "channels": channels, "initial-state": initial_state},
        of_closed={"gust": gust, "lag": lag, "delay": delay, "sensors": sensors},
    )
    check_seed(seed)
    accuracy = (5.0 if closed_loop else 1.0) if accuracy is None else accuracy
    if not 0 < accuracy < 1e6:
        raise InputError(f"--accuracy: must be positive and finite, got {accuracy:g}.")
    limits = {"slowest": slowest, "fastest": fastest, "slew": slew, "rate": rate}
    limits |= {"velocity": velocity, "distance": distance} | ({} if closed_loop else {"angle": angle})
    duration, dt = times_of(closed_loop, duration, dt)
    begin = time.perf_counter()
    with stages("loading the library") as progress, option_names(bracket=bracket):
        from ..airframe import load_airframe
        from ..design import design_input, design_references, model_of
        from ..identification.problem import bracket_of
        from ..models import MODELS

        intervals = None if bracket is None else read_toml(bracket)
        settings = {
            "limits": {name: value for name, value in limits.items() if value is not None},
            "duration": duration,
            "dt": dt,
            "criterion": criterion.value,
            "compare": True,
            "key": seed,
            "progress": progress,
        }
        settings |= {} if bandwidth is None else {"bandwidth": bandwidth}
        if closed_loop:
            loop = loop_of(airframe, gust, lag, delay, sensors)
            settings |= {} if angle is None else {"angle": angle}
            found = design_references(loop, bracket=bracket_of(intervals, model_of(loop)), **settings)
            described = found.task.kind
        else:
            model = model or Model["published"]
            subject = MODELS[model](load_airframe(airframe))
            settings["start_is_known"] = initial_state is InitialState["known"]
            settings["channels"] = (channels or Channels["all"]).value
            found = design_input(subject, bracket=bracket_of(intervals, subject), **settings)
            described = f"{model.value} model"
        progress("writing")
        found.task.write(found.designed, out)
        from ..report.design_page import print_design, write_design

        if figure is not None:
            write_design(found, accuracy / 100, figure)
    from rich.console import Console

    print_design(Console(highlight=False), found, accuracy / 100)
    samples = found.designed.inputs.shape[0]
    typer.echo(f"{out}: {samples} samples of {dt:g} s, {described}, {time.perf_counter() - begin:.0f} s")
