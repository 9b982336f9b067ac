"""`jaxos4 simulate`: a simulated flight as CSV."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option

from ..errors import InputError, named
from . import _options as options
from ._output import check_outputs, end, stages

if TYPE_CHECKING:
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
        Path | None, Option(help="With --closed-loop: CSV of references, as `design` writes it. Default: random ones.")
    ] = None,
) -> None:
    """Simulate a flight and write it as CSV: an OS4 in open loop, or a real vehicle in closed loop."""
    given = dict(locals())
    asked = options.of_kind(closed_loop, given)
    check_outputs(airframe, references, speeds, out=out)
    file, names = (references, ("duration", "dt")) if closed_loop else (speeds, ("duration", "excitation"))
    for name in names:
        if file is not None and given[name] is not None:
            raise InputError(f"--{name}: {file} has its own; leave it out.")
    if asked["dt"] > 0 and asked["duration"] / asked["dt"] > MOST_SAMPLES:
        many = f"more than {MOST_SAMPLES} samples of {asked['dt']:g} s; ask for fewer."
        raise InputError(f"--duration {asked['duration']:g}: {many}")
    with stages("loading the library") as progress:
        from ..airframe import load_airframe
        from ..logs import write_flight
        from ..results import result_names

        progress("compiling and simulating")
        flight, how = (_closed_loop if closed_loop else _open_loop)(asked)
        end(str(result_names(flight.result)))
        progress("writing")
        write_flight(flight, out, load_airframe(airframe))
    typer.echo(f"{out}: {flight.time.shape[0]} samples of {how}")


def _closed_loop(asked: dict[str, Any]) -> tuple["Flight", str]:
    """A flight of a real vehicle, and how it was made."""
    from ..closed_loop import fly_standard
    from ..design import read_references

    loop, references, dt = options.make_loop(asked), None, asked["dt"]
    with named("--closed-loop"):
        if asked["references"] is not None:
            references, dt = read_references(asked["references"])
        flight = fly_standard(loop, references=references, duration=asked["duration"], dt=dt, seed=asked["seed"])
    return flight, f"{dt:g} s, closed loop, {loop.logged}, gusts of {asked['gust']:g} rad/s^2"


def _open_loop(asked: dict[str, Any]) -> tuple["Flight", str]:
    """A flight with the rotor speeds of an excitation, or of a file, and how it was made."""
    from .._custom_types import as_float
    from ..airframe import load_airframe
    from ..design import read_input
    from ..excitation import EXCITATIONS
    from ..models import MODELS
    from ..noise import SENSOR_SIGMA, WhiteNoise, measure
    from ..simulation import simulate as fly

    model, shape, dt = MODELS[asked["model"]](load_airframe(asked["airframe"])), asked["excitation"], asked["dt"]
    with named("" if asked["speeds"] else f"--excitation {shape}"):
        if asked["speeds"] is None:
            omega = EXCITATIONS[shape](model.airframe, duration=asked["duration"], dt=dt)
        else:
            omega = as_float(read_input(asked["speeds"], dt))
        flight = fly(model, model.alpha, omega, dt=dt, method=asked["method"].value)
    flight = measure(flight, WhiteNoise(asked["noise"] * SENSOR_SIGMA), seed=asked["seed"])
    return flight, f"{dt:g} s, {asked['model']} model, {asked['method']}, noise {asked['noise']:g}"
