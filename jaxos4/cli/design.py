"""`jaxos4 design`: the most informative rotor speeds, or references of a controller, within an envelope."""

import time
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .._files import read_toml
from ..errors import InputError
from ._options import (
    AirframeOption,
    BracketOption,
    Channels,
    DelayOption,
    DurationOption,
    GustOption,
    InitialState,
    LagOption,
    Model,
    SampleTimeOption,
    SensorsOption,
    check_kind,
    check_seed,
    loop_of,
    times_of,
)
from ._output import check_different, check_output, option_names, stages

if TYPE_CHECKING:
    from ..closed_loop import ClosedLoop
    from ..design import Design


class Criterion(StrEnum):
    """The values of --criterion, in the spelling of the library."""

    D = "D"
    A = "A"
    worst = "worst"


SlowestOption = Annotated[float | None, typer.Option(help="Slowest rotor speed [rad/s].")]
FastestOption = Annotated[float | None, typer.Option(help="Fastest rotor speed [rad/s].")]
SlewOption = Annotated[float | None, typer.Option(help="Fastest change of a rotor speed [rad/s^2].")]
AngleOption = Annotated[
    float | None,
    typer.Option(
        help="Largest roll, pitch and yaw angle [rad]; with --closed-loop: that of the references. Default: 0.3."
    ),
]
RateOption = Annotated[float | None, typer.Option(help="Largest body rate [rad/s].")]
VelocityOption = Annotated[float | None, typer.Option(help="Largest velocity [m/s].")]
DistanceOption = Annotated[float | None, typer.Option(help="Largest distance from the start [m].")]
BandwidthOption = Annotated[
    float | None, typer.Option(help="Highest frequency [Hz]. Default: 4; with --closed-loop: 6.", metavar="HERTZ")
]
StartOption = Annotated[
    InitialState | None, typer.Option(help="free: estimated too; known: equal to the first sample. Default: free.")
]
CriterionOption = Annotated[
    Criterion, typer.Option(help="D: all parameters together; A: the mean squared bound; worst: the largest bound.")
]
AccuracyOption = Annotated[
    float | None,
    typer.Option(
        help="Wanted standard deviation [% of the bracket's half-width]. Default: 1; "
        "with --closed-loop: 5 % of Ix, Iy and Iz.",
        metavar="PERCENT",
    ),
]


def design(
    out: Annotated[Path, typer.Option(help="The CSV to write: rotor speeds; with --closed-loop: references.")],
    airframe: AirframeOption = "os4",
    closed_loop: Annotated[
        bool, typer.Option("--closed-loop", help="References for a real vehicle, which flies under its controller.")
    ] = False,
    model: Annotated[Model | None, typer.Option(help="Equations of motion. Default: published.")] = None,
    duration: DurationOption = None,
    dt: SampleTimeOption = None,
    slowest: SlowestOption = None,
    fastest: FastestOption = None,
    slew: SlewOption = None,
    angle: AngleOption = None,
    rate: RateOption = None,
    velocity: VelocityOption = None,
    distance: DistanceOption = None,
    bandwidth: BandwidthOption = None,
    bracket: BracketOption = None,
    channels: Annotated[Channels | None, typer.Option(help="Channels that will be measured. Default: all.")] = None,
    initial_state: StartOption = None,
    criterion: CriterionOption = Criterion["D"],
    accuracy: AccuracyOption = None,
    gust: GustOption = None,
    lag: LagOption = None,
    delay: DelayOption = None,
    sensors: SensorsOption = None,
    figure: Annotated[Path | None, typer.Option(help="SVG file: what to fly, and the bounds over time.")] = None,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
) -> None:
    """Design the most informative flight within limits: rotor speeds, or the references of a controller."""
    _check_files(out, figure, Path(airframe), bracket)
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
    settings = {"duration": duration, "dt": dt, "criterion": criterion.value, "compare": True, "key": seed}
    settings |= {"limits": {name: value for name, value in limits.items() if value is not None}}
    settings |= {} if bandwidth is None else {"bandwidth": bandwidth}
    begin = time.perf_counter()
    with stages("loading the library") as progress, option_names(bracket=bracket):
        settings["progress"] = progress
        intervals = None if bracket is None else read_toml(bracket)
        if closed_loop:
            settings |= {} if angle is None else {"angle": angle}
            found = _references(loop_of(airframe, gust, lag, delay, sensors), intervals, settings)
            described = found.task.kind
        else:
            model, channels = model or Model["published"], channels or Channels["all"]
            settings |= {"channels": channels.value, "start_is_known": initial_state is InitialState["known"]}
            found = _rotor_speeds(airframe, model, intervals, settings)
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


def _check_files(out: Path, figure: Path | None, *inputs: Path | None) -> None:
    """Refuse files that cannot be written, or that would overwrite an input or each other."""
    check_output(out, *inputs)
    check_different(out=out, figure=figure)
    if figure is not None:
        check_output(figure, *inputs)
        if figure.suffix != ".svg":
            raise InputError(f"--figure {figure}: the figure is an SVG file; give it a name that ends in .svg.")


def _rotor_speeds(airframe: str, model: Model, intervals: dict[str, Any] | None, settings: dict[str, Any]) -> "Design":
    """Design rotor speeds. An angle is a limit."""
    from ..airframe import load_airframe
    from ..design import design_input
    from ..identification.problem import bracket_of
    from ..models import MODELS

    subject = MODELS[model](load_airframe(airframe))
    return design_input(subject, bracket=bracket_of(intervals, subject), **settings)


def _references(loop: "ClosedLoop", intervals: dict[str, Any] | None, settings: dict[str, Any]) -> "Design":
    """Design references. An angle is the largest one of the references."""
    from ..design import design_references, model_of
    from ..identification.problem import bracket_of

    return design_references(loop, bracket=bracket_of(intervals, model_of(loop)), **settings)
