"""`jaxos4 simulate` and `jaxos4 design`: a flight as CSV, and the best to fly; in open loop, or with a controller."""

import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

import jaxos4

from ..errors import InputError, named
from . import _shared as options
from ._shared import check_outputs, end, stages

OpenLoopModelOption = Annotated[options.Model | None, Option(help="Equations of motion. Default: published.")]
DurationOption = Annotated[float | None, Option(help="Duration [s]. Default: 5; with --closed-loop: 20.")]
SampleTimeOption = Annotated[float | None, Option(help="Sample time [s]. Default: 0.01; with --closed-loop: 0.004.")]
AccuracyOption = Annotated[
    float | None,
    Option(help="Wanted standard deviation [% of half a bracket]. Default: 1; with --closed-loop: 5 % of inertias."),
]
GustOption = Annotated[
    float | None, Option(help="With --closed-loop: standard deviation of torque / inertia [rad/s^2]. Default: 5.")
]
LagOption = Annotated[float | None, Option(help="With --closed-loop: lag of the rotors [s]. Default: 0.05.")]
DelayOption = Annotated[float | None, Option(help="With --closed-loop: delay of the commands [s]. Default: 0.01.")]
LoadSagOption = Annotated[
    float | None,
    Option(help="With --closed-loop: share of a command that the battery loses for each further load of hover."),
]
GyroCutoffOption = Annotated[
    float | None, Option(help="With --closed-loop: cut-off of the gyro's first-order filter [Hz]. Default: no filter.")
]
GyroDelayOption = Annotated[float | None, Option(help="With --closed-loop: delay of the gyro [s]. Default: 0.")]
LogEveryOption = Annotated[
    int | None, Option(help="With --closed-loop: runs of the controller in each sample of the log. Default: 1.")
]
SensorsOption = Annotated[
    options.Sensors | None,
    Option(help="With --closed-loop: what is logged. Default: commands if the airframe has max_rotor_speed."),
]

# The options of flights in open loop, and those of flights in closed loop, with their defaults. `None`: the library's.
_OPEN = {"duration": 5.0, "dt": 0.01, "accuracy": 1.0, "slew": None, "speeds": None, "noise": 0.0, "method": "euler"}
_OPEN |= {"model": "published", "excitation": "multisine", "channels": "all", "initial_state": "free", "criterion": "A"}
_PRESET = "os4"
_CLOSED = {"duration": 20.0, "dt": 0.004, "accuracy": 5.0, "gust": 5.0, "lag": None, "delay": None}
_CLOSED |= {"sensors": None, "references": None, "criterion": "D"}
_CLOSED |= {"load_sag": None, "gyro_cutoff": None, "gyro_delay": None, "log_every": None}
_RANGES = {"gust": (0, 1e6), "lag": (0, 1), "delay": (0, 1), "noise": (0, 1e6), "accuracy": (1e-6, 1e6)}
_RANGES |= {"angle": (1e-3, 10), "rate": (1e-3, 1e3), "velocity": (1e-3, 1e3), "distance": (1e-3, 1e5)}
_RANGES |= {"slowest": (1e-3, 1e5), "fastest": (1e-3, 1e5), "slew": (1e-3, 1e8), "bandwidth": (1e-3, 1e3)}
_RANGES |= {"load_sag": (0, 0.5), "gyro_cutoff": (0.1, 1e6), "gyro_delay": (0, 1), "log_every": (1, 100)}


def simulate(
    out: Annotated[Path, Option(help="The flight file to write (CSV).")],
    airframe: options.AirframeOption = "os4",
    duration: DurationOption = None,
    dt: SampleTimeOption = None,
    seed: options.SeedOption = 0,
    model: OpenLoopModelOption = None,
    excitation: Annotated[options.Excitation | None, Option(help="Shape of the inputs. Default: multisine.")] = None,
    speeds: Annotated[
        Path | None, Option(help="CSV of rotor speeds to fly, as `design` writes it, instead of an excitation.")
    ] = None,
    method: Annotated[
        options.Method | None, Option(help="Integrator of the equations of motion. Default: euler.")
    ] = None,
    noise: Annotated[
        float | None, Option(help="White sensor noise, in multiples of the standard noise. Default: 0.")
    ] = None,
    closed_loop: Annotated[
        bool, Option("--closed-loop", help="A controller flies a real vehicle through gusts.")
    ] = False,
    gust: GustOption = None,
    lag: LagOption = None,
    delay: DelayOption = None,
    load_sag: LoadSagOption = None,
    gyro_cutoff: GyroCutoffOption = None,
    gyro_delay: GyroDelayOption = None,
    log_every: LogEveryOption = None,
    sensors: SensorsOption = None,
    references: Annotated[
        Path | None, Option(help="With --closed-loop: CSV of references, as `design` writes it. Default: random ones.")
    ] = None,
) -> None:
    """Simulate a flight and write it as CSV.

    An OS4 flies in open loop. With --closed-loop, a controller flies a real vehicle.
    """
    given = dict(locals())
    asked = of_kind(closed_loop, given)
    check_outputs(airframe, references, speeds, out=out)
    file, names = (references, ("duration", "dt")) if closed_loop else (speeds, ("duration", "excitation"))
    for name in names:
        if file is not None and given[name] is not None:
            raise InputError(f"--{name}: {file} has its own; leave it out.")
    most = 5_000_000  # more do not fit into the memory of an ordinary machine
    if asked["dt"] > 0 and asked["duration"] / asked["dt"] > most:
        many = f"more than {most} samples of {asked['dt']:g} s; ask for fewer."
        raise InputError(f"--duration {asked['duration']:g}: {many}")
    with stages("loading the library") as progress:
        progress("compiling and simulating")
        flight, how = (_closed_loop if closed_loop else _open_loop)(asked)
        end(str(jaxos4.result_names(flight.result)))
        progress("writing")
        jaxos4.write_flight(flight, out, jaxos4.load_airframe(airframe))
    typer.echo(f"{out}: {flight.time.shape[0]} samples of {how}")


def _closed_loop(asked: dict[str, Any]) -> tuple["jaxos4.Flight", str]:
    """A flight of a real vehicle, and how it was made."""
    from ..closed_loop import fly_standard
    from ..design import read_references

    loop, references, dt = make_loop(asked), None, asked["dt"]
    with named("--closed-loop"):
        if asked["references"] is not None:
            references, dt = read_references(asked["references"])
        flight = fly_standard(loop, references=references, duration=asked["duration"], dt=dt, seed=asked["seed"])
    return flight, f"{dt:g} s, closed loop, {loop.logged}, gusts of {asked['gust']:g} rad/s^2"


def _open_loop(asked: dict[str, Any]) -> tuple["jaxos4.Flight", str]:
    """A flight with the rotor speeds of an excitation, or of a file, and how it was made."""
    from .._custom_types import as_float
    from ..design import read_input
    from ..excitation import EXCITATIONS
    from ..models import MODELS
    from ..noise import measure

    model, shape, dt = MODELS[asked["model"]](jaxos4.load_airframe(asked["airframe"])), asked["excitation"], asked["dt"]
    with named("" if asked["speeds"] else f"--excitation {shape}"):
        if asked["speeds"] is None:
            omega = EXCITATIONS[shape](model.airframe, duration=asked["duration"], dt=dt)
        else:
            omega = as_float(read_input(asked["speeds"], dt))
        flight = jaxos4.simulate(model, model.alpha, omega, dt=dt, method=asked["method"])
    flight = measure(flight, jaxos4.WhiteNoise(asked["noise"] * jaxos4.SENSOR_SIGMA), seed=asked["seed"])
    return flight, f"{dt:g} s, {asked['model']} model, {asked['method']}, noise {asked['noise']:g}"


def design(
    out: Annotated[Path, Option(help="The CSV to write: rotor speeds; with --closed-loop: references.")],
    result: Annotated[
        Path | None,
        Argument(metavar="[RESULT.json]", help="A vehicle: a file of `jaxos4 estimate --out`. With it, --closed-loop."),
    ] = None,
    airframe: options.AirframeOption = _PRESET,
    closed_loop: Annotated[
        bool, Option("--closed-loop", help="References for a real vehicle, which flies under its controller.")
    ] = False,
    model: OpenLoopModelOption = None,
    duration: DurationOption = None,
    dt: SampleTimeOption = None,
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
        options.Criterion | None,
        Option(
            help="A: the mean squared bound; D: the volume of the confidence ellipsoid; worst: the largest bound. "
            "Default: A; with --closed-loop: D."
        ),
    ] = None,
    accuracy: AccuracyOption = None,
    gust: GustOption = None,
    lag: LagOption = None,
    delay: DelayOption = None,
    sensors: SensorsOption = None,
    figure: Annotated[Path | None, Option(help="SVG file: what to fly, and the bounds over time.")] = None,
    seed: options.SeedOption = 0,
) -> None:
    """Design the most informative flight within limits.

    Designs rotor speeds; with --closed-loop, references for a controller.
    """
    closed_loop = closed_loop or result is not None
    asked = of_kind(closed_loop, locals())
    if result is not None:
        if airframe != _PRESET:
            raise InputError(f"--airframe: {result} has its own; leave it out.")
        asked["gust"] = gust  # that of the result, if none is given
    check_outputs(result, None if result else airframe, bracket, out=out, figure=figure)
    begin = time.perf_counter()
    with stages("loading the library") as progress:
        found = _find(asked, progress)
        progress("writing")
        found.task.write(found.designed, out)
    from rich.console import Console

    from ..report.design import print_design, write_design

    if figure is not None:
        with stages("drawing"):
            write_design(found, asked["accuracy"] / 100, figure)
    print_design(Console(highlight=False), found, asked["accuracy"] / 100)
    samples = f"{found.designed.inputs.shape[0]} samples of {asked['dt']:g} s"
    kind, seconds = found.task.kind if closed_loop else f"{asked['model']} model", time.perf_counter() - begin
    typer.echo(f"{out}: {samples}, {kind}, criterion {found.task.criterion}, {seconds:.0f} s")


def _find(asked: dict[str, Any], progress: Callable[[str], None]) -> "jaxos4.Design":
    """The design of the kind that was asked for, beside the standard inputs."""
    from ..design import model_of
    from ..identification.problem import bracket_of
    from ..models import MODELS

    limits = {name: asked[name] for name in ("slowest", "fastest", "slew", "angle", "rate", "velocity", "distance")}
    settings = options.given(
        duration=asked["duration"], dt=asked["dt"], bandwidth=asked["bandwidth"], key=asked["seed"]
    )
    settings |= {"criterion": asked["criterion"], "compare": True, "progress": progress}
    intervals = options.read_bracket(asked["bracket"])
    if asked["closed_loop"]:
        loop = make_loop(asked)
        settings |= options.given(angle=limits.pop("angle"))
        bracket = bracket_of(intervals, model_of(loop))
        return jaxos4.design_references(loop, bracket=bracket, limits=options.given(**limits), **settings)
    subject, known = MODELS[asked["model"]](jaxos4.load_airframe(asked["airframe"])), asked["initial_state"] == "known"
    settings |= {"limits": options.given(**limits), "channels": asked["channels"], "start_is_known": known}
    return jaxos4.design_input(subject, bracket=bracket_of(intervals, subject), **settings)


def of_kind(closed_loop: bool, asked: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a command with the defaults of its kind of flight. Refuses those of the other, or out of range."""
    own, others = (_CLOSED, _OPEN) if closed_loop else (_OPEN, _CLOSED)
    for name, value in options.given(**asked).items():
        if name in others and name not in own:
            how = "without --closed-loop; leave it out" if closed_loop else "with --closed-loop; add that"
            raise InputError(f"--{name.replace('_', '-')}: is for flights {how}.")
        low, high = _RANGES.get(name, (None, None))
        if low is not None and not low <= value <= high:
            raise InputError(f"--{name.replace('_', '-')}: must lie in {low:g} to {high:g}, got {value}.")
    return dict(asked) | {name: default for name, default in own.items() if asked.get(name) is None}


def make_loop(asked: Mapping[str, Any]) -> "jaxos4.ClosedLoop":
    """The vehicle in closed loop with these options; that of a result, if there is one."""
    settings = options.given(
        rotor_lag=asked["lag"],
        rotor_delay=asked["delay"],
        load_sag=asked["load_sag"],
        log_every=asked["log_every"],
    )
    cutoff = asked["gyro_cutoff"]
    gyro = options.given(gyro_filter=cutoff and 1 / (2 * math.pi * cutoff), gyro_delay=asked["gyro_delay"])
    if gyro:
        settings["sensors"] = jaxos4.Sensors(**gyro)
    if asked.get("result") is not None:
        from ..export import found_loop

        return found_loop(asked["result"], **settings, **options.given(gust=asked["gust"], logged=asked["sensors"]))
    vehicle = jaxos4.load_airframe(asked["airframe"])
    logged, scaled = asked["sensors"], vehicle.has_full_scale
    if logged == "commands" and not scaled:
        raise InputError(
            f"--sensors commands: {asked['airframe']} has no max_rotor_speed [rad/s]; set it, or log speeds."
        )
    return jaxos4.ClosedLoop(
        vehicle, logged=logged or ("commands" if scaled else "speeds"), gust=asked["gust"], **settings
    )
