"""`jaxos4 simulate`: a simulated flight as CSV."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Option

from ..errors import InputError
from . import _options as options
from ._output import check_outputs, stages

if TYPE_CHECKING:
    from ..airframe import Airframe
    from ..flight import Flight

MOST_SAMPLES = 5_000_000  # more do not fit into the memory of an ordinary machine


def simulate(
    out: Annotated[Path, Option(help="The flight file to write (CSV).")],
    airframe: options.AirframeOption = "os4",
    duration: options.DurationOption = None,
    dt: options.SampleTimeOption = None,
    seed: Annotated[int, Option(help="Random seed.")] = 0,
    model: options.OpenLoopModelOption = None,
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
    gust: options.GustOption = None,
    lag: options.LagOption = None,
    delay: options.DelayOption = None,
    sensors: options.SensorsOption = None,
    references: Annotated[
        Path | None,
        Option(help="With --closed-loop: CSV of references, as `design` writes it. Default: random ones."),
    ] = None,
) -> None:
    """Simulate a flight and write it as CSV: an OS4 in open loop, or a real vehicle in closed loop."""
    check_outputs(airframe, references, speeds, out=out)
    options.check_kind(
        closed_loop,
        open_only={"model": model, "excitation": excitation, "speeds": speeds, "method": method, "noise": noise},
        closed_only={"gust": gust, "lag": lag, "delay": delay, "sensors": sensors, "references": references},
    )
    _check_not_given(references, duration=duration, dt=dt)
    _check_not_given(speeds, duration=duration, excitation=excitation)
    duration, dt = options.flight_times(closed_loop, duration, dt)
    noise = 0.0 if noise is None else noise
    if not 0 <= noise <= 1e6:
        raise InputError(f"--noise: must lie in 0 to 1e+06, got {noise}.")
    options.check_seed(seed)
    if dt > 0 and duration / dt > MOST_SAMPLES:
        raise InputError(f"--duration {duration:g}: more than {MOST_SAMPLES} samples of {dt:g} s; ask for fewer.")
    with stages("loading the library") as progress:
        from ..airframe import load_airframe
        from ..logs import write_flight
        from ..results import RESULTS, result_names

        progress("compiling and simulating")
        vehicle = load_airframe(airframe)
        if closed_loop:
            try:
                from ..closed_loop import fly_standard
                from ..design import read_references

                loop = options.make_loop(airframe, gust, lag, delay, sensors)
                flown, dt = (None, dt) if references is None else read_references(references)
                flight = fly_standard(loop, references=flown, duration=duration, dt=dt, seed=seed)
            except ValueError as error:
                raise InputError(f"--closed-loop: {error}") from None
            how = f"closed loop, {loop.logged}, gusts of {5.0 if gust is None else gust:g} rad/s^2"
        else:
            model, method = model or options.Model["published"], method or options.Method["euler"]
            flight = _open_loop(vehicle, model, excitation, method, duration, dt, speeds)
            how = f"{model.value} model, {method.value}, noise {noise:g}"
        if flight.result != RESULTS.successful:
            typer.echo(f"jaxos4: {result_names(flight.result)}: {RESULTS[flight.result]}", err=True)
            raise typer.Exit(1)
        if not closed_loop:
            from ..noise import SENSOR_SIGMA, WhiteNoise, measure

            flight = measure(flight, WhiteNoise(noise * SENSOR_SIGMA), seed=seed)
        progress("writing")
        write_flight(flight, out, vehicle)
    typer.echo(f"{out}: {flight.time.shape[0]} samples of {dt:g} s, {how}")


def _check_not_given(file: Path | None, **given: object) -> None:
    """Refuses options if the file has their values."""
    for name, value in given.items():
        if file is not None and value is not None:
            raise InputError(f"--{name}: {file} has its own; leave it out.")


def _open_loop(
    airframe: "Airframe",
    model: options.Model,
    excitation: options.Excitation | None,
    method: options.Method,
    duration: float,
    dt: float,
    speeds: Path | None,
) -> "Flight":
    """A flight with the rotor speeds of an excitation, or of a file, without noise."""
    from .._custom_types import as_float
    from ..excitation import EXCITATIONS
    from ..models import MODELS
    from ..simulation import simulate as fly

    vehicle, shape = MODELS[model](airframe), excitation or options.Excitation["multisine"]
    try:
        if speeds is None:
            omega = EXCITATIONS[shape](airframe, duration=duration, dt=dt)
        else:
            from ..design import read_input

            omega = as_float(read_input(speeds, dt))
        return fly(vehicle, vehicle.alpha, omega, dt=dt, method=method.value)
    except ValueError as error:
        raise InputError(str(error) if speeds is not None else f"--excitation {shape.value}: {error}") from None
