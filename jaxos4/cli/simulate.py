"""`jaxos4 simulate`: a simulated flight as CSV."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import InputError
from ._choices import AirframeOption, Excitation, Method, Model, Sensors, check_seed
from ._output import check_output
from ._progress import stages

if TYPE_CHECKING:
    from ..airframe import Airframe
    from ..flight import Flight

MOST_SAMPLES = 5_000_000  # more do not fit into the memory of an ordinary machine


def simulate(
    out: Annotated[Path, typer.Option(help="The flight file to write (CSV).")],
    airframe: AirframeOption = "os4",
    duration: Annotated[
        float | None, typer.Option(help="Duration [s]. Default: 5; with --closed-loop: 20.", metavar="SECONDS")
    ] = None,
    dt: Annotated[
        float | None, typer.Option(help="Sample time [s]. Default: 0.01; with --closed-loop: 0.004.", metavar="SECONDS")
    ] = None,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
    model: Annotated[Model | None, typer.Option(help="Equations of motion. Default: published.")] = None,
    excitation: Annotated[Excitation | None, typer.Option(help="Shape of the inputs. Default: multisine.")] = None,
    method: Annotated[
        Method | None, typer.Option(help="Integrator of the equations of motion. Default: euler.")
    ] = None,
    noise: Annotated[
        float | None, typer.Option(help="White sensor noise, in multiples of the standard noise. Default: 0.")
    ] = None,
    closed_loop: Annotated[
        bool, typer.Option("--closed-loop", help="A controller flies a real vehicle through gusts.")
    ] = False,
    gust: Annotated[
        float | None,
        typer.Option(help="With --closed-loop: standard deviation of torque / inertia [rad/s^2]. Default: 5."),
    ] = None,
    lag: Annotated[
        float | None,
        typer.Option(help="With --closed-loop: lag of the rotors. Default: 0.05.", metavar="SECONDS"),
    ] = None,
    delay: Annotated[
        float | None,
        typer.Option(help="With --closed-loop: delay of the commands. Default: 0.01.", metavar="SECONDS"),
    ] = None,
    sensors: Annotated[
        Sensors | None,
        typer.Option(help="With --closed-loop: what is logged. Default: commands if the airframe has max_rotor_speed."),
    ] = None,
) -> None:
    """Simulate a flight and write it as CSV: an OS4 in open loop, or a real vehicle in closed loop."""
    check_output(out, Path(airframe))
    of_open = {"model": model, "excitation": excitation, "method": method, "noise": noise}
    of_closed = {"gust": gust, "lag": lag, "delay": delay, "sensors": sensors}
    for name, value in (of_open if closed_loop else of_closed).items():
        if value is not None:
            how = "without --closed-loop; leave it out" if closed_loop else "with --closed-loop; add that"
            raise InputError(f"--{name}: is for flights {how}.")
    model, excitation, method = (
        model or Model["published"],
        excitation or Excitation["multisine"],
        method or Method["euler"],
    )
    duration = (20.0 if closed_loop else 5.0) if duration is None else duration
    dt = (0.004 if closed_loop else 0.01) if dt is None else dt
    noise, gust = 0.0 if noise is None else noise, 5.0 if gust is None else gust
    lag, delay = 0.05 if lag is None else lag, 0.01 if delay is None else delay
    for name, value, most in (("noise", noise, 1e6), ("gust", gust, 1e6), ("lag", lag, 1), ("delay", delay, 1)):
        if not 0 <= value <= most:
            raise InputError(f"--{name}: must lie in 0 to {most:g}, got {value}.")
    check_seed(seed)
    if dt > 0 and duration / dt > MOST_SAMPLES:
        raise InputError(f"--duration {duration:g}: more than {MOST_SAMPLES} samples of {dt:g} s; ask for fewer.")
    with stages("loading the library") as progress:
        from ..airframe import load_airframe
        from ..logs import write_flight
        from ..noise import SENSOR_SIGMA, WhiteNoise, measure
        from ..results import RESULTS, result_names

        progress("compiling and simulating")
        vehicle = load_airframe(airframe)
        scaled = math.isfinite(float(vehicle.max_rotor_speed))
        if sensors == "commands" and not scaled:
            raise InputError(f"--sensors commands: {airframe} has no max_rotor_speed [rad/s]; set it, or log speeds.")
        logged = sensors.value if sensors else "commands" if scaled else "speeds"
        try:
            if closed_loop:
                flight = _closed_loop(vehicle, gust, lag, delay, logged, duration, dt, seed)
                how = f"closed loop, {logged}, gusts of {gust:g} rad/s^2"
            else:
                flight = _open_loop(vehicle, model, excitation, method, duration, dt)
                how = f"{model.value} model, {method.value}, noise {noise:g}"
        except ValueError as error:
            kind = "--closed-loop" if closed_loop else f"--excitation {excitation.value}"
            raise InputError(f"{kind}: {error}") from None
        if flight.result != RESULTS.successful:
            typer.echo(f"jaxos4: {result_names(flight.result)}: {RESULTS[flight.result]}", err=True)
            raise typer.Exit(1)
        if not closed_loop:
            flight = measure(flight, WhiteNoise(noise * SENSOR_SIGMA), seed=seed)
        progress("writing")
        write_flight(flight, out, vehicle)
    typer.echo(f"{out}: {flight.time.shape[0]} samples of {dt:g} s, {how}")


def _open_loop(
    airframe: "Airframe", model: Model, excitation: Excitation, method: Method, duration: float, dt: float
) -> "Flight":
    """A flight with designed rotor speeds, without noise."""
    from ..excitation import EXCITATIONS
    from ..models import MODELS
    from ..simulation import simulate as fly

    vehicle = MODELS[model](airframe)
    omega = EXCITATIONS[excitation](airframe, duration=duration, dt=dt)
    return fly(vehicle, vehicle.alpha, omega, dt=dt, method=method.value)


def _closed_loop(
    airframe: "Airframe", gust: float, lag: float, delay: float, logged: str, duration: float, dt: float, seed: int
) -> "Flight":
    """A standard flight of a controller."""
    from ..closed_loop import ClosedLoop, fly_standard

    loop = ClosedLoop(airframe, gust=gust, rotor_lag=lag, rotor_delay=delay, logged=logged)
    return fly_standard(loop, duration=duration, dt=dt, seed=seed)
