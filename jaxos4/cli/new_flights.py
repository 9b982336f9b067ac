"""`jaxos4 simulate` and `jaxos4 design`: a flight as CSV, and the best to fly; in open loop, or with a controller."""

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import typer

import jaxos4

from .._files import read_toml
from ..errors import InputError, named
from . import options
from ._shared import check_outputs, console, end, showing_stages

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
    out: options.FlightOut,
    airframe: options.Airframe = "os4",
    duration: options.Duration = None,
    dt: options.Step = None,
    seed: options.Seed = 0,
    model: options.OpenLoopEquations = None,
    excitation: options.Shape = None,
    speeds: options.Speeds = None,
    method: options.Integrator = None,
    noise: options.Noise = None,
    closed_loop: options.ClosedLoop = False,
    gust: options.Gust = None,
    lag: options.Lag = None,
    delay: options.Delay = None,
    load_sag: options.LoadSag = None,
    gyro_cutoff: options.GyroCutoff = None,
    gyro_delay: options.GyroDelay = None,
    log_every: options.LogEvery = None,
    sensors: options.Logged = None,
    references: options.References = None,
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
    with showing_stages("loading the library") as progress:
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
    out: options.DesignOut,
    result: options.Designed = None,
    airframe: options.Airframe = _PRESET,
    closed_loop: options.ClosedLoop = False,
    model: options.OpenLoopEquations = None,
    duration: options.Duration = None,
    dt: options.Step = None,
    slowest: options.Slowest = None,
    fastest: options.Fastest = None,
    slew: options.Slew = None,
    angle: options.Angle = None,
    rate: options.Rate = None,
    velocity: options.Velocity = None,
    distance: options.Distance = None,
    bandwidth: options.Bandwidth = None,
    bracket: options.Bracket = None,
    channels: options.MeasuredChannels = None,
    initial_state: options.DesignedFirstState = None,
    criterion: options.BestBy = None,
    accuracy: options.Accuracy = None,
    gust: options.Gust = None,
    lag: options.Lag = None,
    delay: options.Delay = None,
    sensors: options.Logged = None,
    figure: options.Figure = None,
    seed: options.Seed = 0,
) -> None:
    """Design the most informative flight within limits.

    Designs rotor speeds; with --closed-loop, references for a controller.
    """
    closed_loop = closed_loop or result is not None
    asked = of_kind(closed_loop, locals())
    if result is not None:
        if airframe != _PRESET:
            raise InputError(f"--airframe: {result} has its own; leave it out.")
        asked["gust"] = gust  # by default the result's
    check_outputs(result, None if result else airframe, bracket, out=out, figure=figure)
    begin = time.perf_counter()
    with showing_stages("loading the library") as progress:
        found = _find(asked, progress)
        progress("writing")
        found.task.write(found.designed, out)
    if figure is not None:
        with showing_stages("drawing"):
            jaxos4.report.write_design_figure(figure, found, asked["accuracy"] / 100)
    jaxos4.report.print_design(console(), found, asked["accuracy"] / 100)
    samples = f"{found.designed.inputs.shape[0]} samples of {asked['dt']:g} s"
    kind, seconds = found.task.kind if closed_loop else f"{asked['model']} model", time.perf_counter() - begin
    typer.echo(f"{out}: {samples}, {kind}, criterion {found.task.criterion}, {seconds:.0f} s")


def _find(asked: dict[str, Any], progress: Callable[[str], None]) -> "jaxos4.Design":
    """The design of the kind that was asked for, beside the standard inputs."""
    from ..design import model_of
    from ..identification.prepare_os4 import bracket_of
    from ..models import MODELS

    limits = {name: asked[name] for name in ("slowest", "fastest", "slew", "angle", "rate", "velocity", "distance")}
    settings = options.given(
        duration=asked["duration"], dt=asked["dt"], bandwidth=asked["bandwidth"], key=asked["seed"]
    )
    settings |= {"criterion": asked["criterion"], "compare": True, "progress": progress}
    intervals = asked["bracket"] and read_toml(asked["bracket"])
    if asked["closed_loop"]:
        loop = make_loop(asked)
        settings |= options.given(angle=limits.pop("angle"))
        bracket = bracket_of(intervals, model_of(loop))
        return jaxos4.design_references(loop, bracket=bracket, limits=options.given(**limits), **settings)
    subject, known = MODELS[asked["model"]](jaxos4.load_airframe(asked["airframe"])), asked["initial_state"] == "known"
    settings |= {"limits": options.given(**limits), "channels": asked["channels"], "start_is_known": known}
    return jaxos4.design_input(subject, bracket=bracket_of(intervals, subject), **settings)


def of_kind(closed_loop: bool, asked: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a command, with defaults. Refuses options of the other kind of flight, and values out of range."""
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
    """The vehicle in closed loop with these options, from a result if there is one."""
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
