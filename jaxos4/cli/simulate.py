"""`jaxos4 simulate`: a simulated flight as CSV."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import InputError
from ._choices import AirframeOption, Excitation, Method, Model, check_seed
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
from ._output import check_output
from ._progress import stages

if TYPE_CHECKING:
    from ..airframe import Airframe
    from ..flight import Flight

MOST_SAMPLES = 5_000_000  # more do not fit into the memory of an ordinary machine


def simulate(
    out: Annotated[Path, typer.Option(help="The flight file to write (CSV).")],
    airframe: AirframeOption = "os4",
    duration: DurationOption = None,
    dt: SampleTimeOption = None,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
    model: Annotated[Model | None, typer.Option(help="Equations of motion. Default: published.")] = None,
    excitation: Annotated[Excitation | None, typer.Option(help="Shape of the inputs. Default: multisine.")] = None,
    speeds: Annotated[
        Path | None,
        typer.Option(help="CSV of rotor speeds to fly, as `design` writes it, instead of an excitation."),
    ] = None,
    method: Annotated[
        Method | None, typer.Option(help="Integrator of the equations of motion. Default: euler.")
    ] = None,
    noise: Annotated[
        float | None, typer.Option(help="White sensor noise, in multiples of the standard noise. Default: 0.")
    ] = None,
    closed_loop: Annotated[
        bool, typer.Option("--closed-loop", help="A controller flies a real vehicle through gusts.")
    ] = False,
    gust: GustOption = None,
    lag: LagOption = None,
    delay: DelayOption = None,
    sensors: SensorsOption = None,
    references: Annotated[
        Path | None,
        typer.Option(help="With --closed-loop: CSV of references, as `design` writes it. Default: random ones."),
    ] = None,
) -> None:
    """Simulate a flight and write it as CSV: an OS4 in open loop, or a real vehicle in closed loop."""
    check_output(out, Path(airframe), references, speeds)
    check_kind(
        closed_loop,
        of_open={"model": model, "excitation": excitation, "speeds": speeds, "method": method, "noise": noise},
        of_closed={"gust": gust, "lag": lag, "delay": delay, "sensors": sensors, "references": references},
    )
    for name, value in (("duration", duration), ("dt", dt)):
        if references is not None and value is not None:
            raise InputError(f"--{name}: {references} has its own; leave it out.")
    for name, value in (("duration", duration), ("excitation", excitation)):
        if speeds is not None and value is not None:
            raise InputError(f"--{name}: {speeds} has its own; leave it out.")
    model, excitation, method = (
        model or Model["published"],
        excitation or Excitation["multisine"],
        method or Method["euler"],
    )
    duration, dt = times_of(closed_loop, duration, dt)
    noise = 0.0 if noise is None else noise
    if not 0 <= noise <= 1e6:
        raise InputError(f"--noise: must lie in 0 to 1e+06, got {noise}.")
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
        try:
            if closed_loop:
                from ..closed_loop import fly_standard

                loop, flown = loop_of(airframe, gust, lag, delay, sensors), None
                if references is not None:
                    from ..design import read_references

                    flown, dt = read_references(references)
                flight = fly_standard(loop, references=flown, duration=duration, dt=dt, seed=seed)
                how = f"closed loop, {loop.logged}, gusts of {5.0 if gust is None else gust:g} rad/s^2"
            else:
                flight = _open_loop(vehicle, model, excitation, method, duration, dt, speeds)
                how = f"{model.value} model, {method.value}, noise {noise:g}"
        except ValueError as error:
            kind = "--closed-loop" if closed_loop else f"--excitation {excitation.value}"
            raise InputError(str(error) if speeds is not None else f"{kind}: {error}") from None
        if flight.result != RESULTS.successful:
            typer.echo(f"jaxos4: {result_names(flight.result)}: {RESULTS[flight.result]}", err=True)
            raise typer.Exit(1)
        if not closed_loop:
            flight = measure(flight, WhiteNoise(noise * SENSOR_SIGMA), seed=seed)
        progress("writing")
        write_flight(flight, out, vehicle)
    typer.echo(f"{out}: {flight.time.shape[0]} samples of {dt:g} s, {how}")


def _open_loop(
    airframe: "Airframe",
    model: Model,
    excitation: Excitation,
    method: Method,
    duration: float,
    dt: float,
    speeds: Path | None,
) -> "Flight":
    """A flight with the rotor speeds of an excitation, or of a file, without noise."""
    from .._custom_types import as_float
    from ..excitation import EXCITATIONS
    from ..models import MODELS
    from ..simulation import simulate as fly

    vehicle = MODELS[model](airframe)
    if speeds is None:
        omega = EXCITATIONS[excitation](airframe, duration=duration, dt=dt)
    else:
        from ..design import read_input

        omega = as_float(read_input(speeds, dt))
    return fly(vehicle, vehicle.alpha, omega, dt=dt, method=method.value)
