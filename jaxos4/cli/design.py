"""`jaxos4 design`: the most informative rotor speeds, or references of a controller, within an envelope."""

import time
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Option

from ..errors import InputError
from . import _options as options
from ._output import check_outputs, option_names, stages

if TYPE_CHECKING:
    from ..design import Design

# A list would make the names lower-case.
Criterion = StrEnum("Criterion", {"D": "D", "A": "A", "worst": "worst"})


def design(
    out: Annotated[Path, Option(help="The CSV to write: rotor speeds; with --closed-loop: references.")],
    airframe: options.AirframeOption = "os4",
    closed_loop: Annotated[
        bool, Option("--closed-loop", help="References for a real vehicle, which flies under its controller.")
    ] = False,
    model: options.OpenLoopModelOption = None,
    duration: options.DurationOption = None,
    dt: options.SampleTimeOption = None,
    slowest: Annotated[float | None, Option(help="Slowest rotor speed [rad/s].")] = None,
    fastest: Annotated[float | None, Option(help="Fastest rotor speed [rad/s].")] = None,
    slew: Annotated[float | None, Option(help="Fastest change of a rotor speed [rad/s^2].")] = None,
    angle: Annotated[
        float | None,
        Option(
            help="Largest roll, pitch and yaw angle [rad]; with --closed-loop: that of the references. Default: 0.3."
        ),
    ] = None,
    rate: Annotated[float | None, Option(help="Largest body rate [rad/s].")] = None,
    velocity: Annotated[float | None, Option(help="Largest velocity [m/s].")] = None,
    distance: Annotated[float | None, Option(help="Largest distance from the start [m].")] = None,
    bandwidth: Annotated[
        float | None, Option(help="Highest frequency [Hz]. Default: 4; with --closed-loop: 6.", metavar="HERTZ")
    ] = None,
    bracket: options.BracketOption = None,
    channels: Annotated[options.Channels | None, Option(help="Channels that will be measured. Default: all.")] = None,
    initial_state: Annotated[
        options.InitialState | None,
        Option(help="free: estimated too; known: equal to the first sample. Default: free."),
    ] = None,
    criterion: Annotated[
        Criterion, Option(help="D: all parameters together; A: the mean squared bound; worst: the largest bound.")
    ] = Criterion["D"],
    accuracy: Annotated[
        float | None,
        Option(
            help="Wanted standard deviation [% of the bracket's half-width]. Default: 1; "
            "with --closed-loop: 5 % of Ix, Iy and Iz.",
            metavar="PERCENT",
        ),
    ] = None,
    gust: options.GustOption = None,
    lag: options.LagOption = None,
    delay: options.DelayOption = None,
    sensors: options.SensorsOption = None,
    figure: Annotated[Path | None, Option(help="SVG file: what to fly, and the bounds over time.")] = None,
    seed: Annotated[int, Option(help="Random seed.")] = 0,
) -> None:
    """Design the most informative flight within limits: rotor speeds, or the references of a controller."""
    check_outputs(airframe, bracket, out=out, figure=figure)
    if figure is not None and figure.suffix != ".svg":
        raise InputError(f"--figure {figure}: the figure is an SVG file; give it a name that ends in .svg.")
    options.check_kind(
        closed_loop,
        open_only={"model": model, "slew": slew, "channels": channels, "initial-state": initial_state},
        closed_only={"gust": gust, "lag": lag, "delay": delay, "sensors": sensors},
    )
    options.check_seed(seed)
    accuracy = (5.0 if closed_loop else 1.0) if accuracy is None else accuracy
    if not 0 < accuracy < 1e6:
        raise InputError(f"--accuracy: must be positive and finite, got {accuracy:g}.")
    duration, dt = options.flight_times(closed_loop, duration, dt)
    limits = {"slowest": slowest, "fastest": fastest, "slew": slew, "rate": rate, "velocity": velocity}
    limits |= {"distance": distance, "angle": None if closed_loop else angle}
    settings = options.given(duration=duration, dt=dt, criterion=criterion.value, bandwidth=bandwidth, key=seed)
    begin = time.perf_counter()
    with stages("loading the library") as progress, option_names(bracket=bracket):
        from ..airframe import load_airframe
        from ..design import design_input, design_references, model_of
        from ..identification.problem import bracket_of
        from ..models import MODELS

        settings |= {"limits": options.given(**limits), "compare": True, "progress": progress}
        intervals = options.read_bracket(bracket)
        if closed_loop:
            loop = options.make_loop(airframe, gust, lag, delay, sensors)
            settings |= options.given(angle=angle)
            found = design_references(loop, bracket=bracket_of(intervals, model_of(loop)), **settings)
        else:
            subject = MODELS[model or "published"](load_airframe(airframe))
            settings |= {"channels": options.chosen(channels) or "all", "start_is_known": initial_state == "known"}
            found = design_input(subject, bracket=bracket_of(intervals, subject), **settings)
        progress("writing")
        found.task.write(found.designed, out)
    _show(found, accuracy / 100, figure)
    samples, kind = found.designed.inputs.shape[0], found.task.kind if closed_loop else f"{model or 'published'} model"
    typer.echo(f"{out}: {samples} samples of {dt:g} s, {kind}, {time.perf_counter() - begin:.0f} s")


def _show(found: "Design", accuracy: float, figure: Path | None) -> None:
    """Draw the figure, and print the table."""
    from rich.console import Console

    from ..report.design_page import print_design, write_design

    if figure is not None:
        with stages("drawing"):
            write_design(found, accuracy, figure)
    print_design(Console(highlight=False), found, accuracy)
