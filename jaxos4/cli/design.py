"""`jaxos4 design`: the most informative rotor speeds, or references of a controller, within an envelope."""

import time
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
        float | None, Option(help="Largest angle [rad]; with --closed-loop: of the references, by default 0.3.")
    ] = None,
    rate: Annotated[float | None, Option(help="Largest body rate [rad/s].")] = None,
    velocity: Annotated[float | None, Option(help="Largest velocity [m/s].")] = None,
    distance: Annotated[float | None, Option(help="Largest distance from the start [m].")] = None,
    bandwidth: Annotated[
        float | None, Option(help="Highest frequency [Hz]. Default: 4; with --closed-loop: 6.")
    ] = None,
    bracket: options.BracketOption = None,
    channels: Annotated[options.Channels | None, Option(help="Channels that will be measured. Default: all.")] = None,
    initial_state: Annotated[
        options.InitialState | None, Option(help="free: estimated too; known: as the first sample. Default: free.")
    ] = None,
    criterion: Annotated[
        Criterion, Option(help="D: all parameters together; A: the mean squared bound; worst: the largest bound.")
    ] = Criterion["D"],
    accuracy: Annotated[
        float | None,
        Option(
            help="Wanted standard deviation [% of half a bracket]. Default: 1; with --closed-loop: 5 % of inertias."
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
    asked = options.of_kind(closed_loop, locals())
    check_outputs(airframe, bracket, out=out, figure=figure)
    if not 0 < asked["accuracy"] < 1e6:
        raise InputError(f"--accuracy: must be positive and finite, got {asked['accuracy']:g}.")
    begin = time.perf_counter()
    with stages("loading the library") as progress, option_names(bracket=bracket):
        found = _find(asked, progress)
        progress("writing")
        found.task.write(found.designed, out)
    from rich.console import Console

    from ..report.design_page import print_design, write_design

    if figure is not None:
        with stages("drawing"):
            write_design(found, asked["accuracy"] / 100, figure)
    print_design(Console(highlight=False), found, asked["accuracy"] / 100)
    kind, rows = found.task.kind if closed_loop else f"{asked['model']} model", found.designed.inputs.shape[0]
    typer.echo(f"{out}: {rows} samples of {asked['dt']:g} s, {kind}, {time.perf_counter() - begin:.0f} s")


def _find(asked: dict[str, Any], progress: Callable[[str], None]) -> "Design":
    """The design of the kind that was asked for, beside the standard inputs."""
    from ..airframe import load_airframe
    from ..design import design_input, design_references, model_of
    from ..identification.problem import bracket_of
    from ..models import MODELS

    limits = {name: asked[name] for name in ("slowest", "fastest", "slew", "angle", "rate", "velocity", "distance")}
    settings = options.given(
        duration=asked["duration"], dt=asked["dt"], bandwidth=asked["bandwidth"], key=asked["seed"]
    )
    settings |= {"criterion": asked["criterion"].value, "compare": True, "progress": progress}
    intervals = options.read_bracket(asked["bracket"])
    if asked["closed_loop"]:
        loop = options.make_loop(asked)
        settings |= options.given(angle=limits.pop("angle"))
        bracket = bracket_of(intervals, model_of(loop))
        return design_references(loop, bracket=bracket, limits=options.given(**limits), **settings)
    subject, known = MODELS[asked["model"]](load_airframe(asked["airframe"])), asked["initial_state"] == "known"
    settings |= {"limits": options.given(**limits), "channels": asked["channels"].value, "start_is_known": known}
    return design_input(subject, bracket=bracket_of(intervals, subject), **settings)
