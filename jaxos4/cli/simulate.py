"""`jaxos4 simulate`: a simulated flight as CSV."""

from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from ._choices import AirframeOption, Excitation, Method, Model, ModelOption
from ._output import check_output
from ._progress import stages

MOST_SAMPLES = 5_000_000  # more do not fit into the memory of an ordinary machine


def simulate(
    out: Annotated[Path, typer.Option(help="The flight file to write (CSV).")],
    model: ModelOption = Model["published"],
    airframe: AirframeOption = "os4",
    excitation: Annotated[Excitation, typer.Option(help="Shape of the inputs.")] = Excitation["multisine"],
    duration: Annotated[float, typer.Option(help="Duration [s].")] = 5.0,
    dt: Annotated[float, typer.Option(help="Sample time [s].")] = 0.01,
    method: Annotated[Method, typer.Option(help="Integrator of the equations of motion.")] = Method["euler"],
    noise: Annotated[float, typer.Option(help="White sensor noise, in multiples of the standard noise.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Random seed for the noise.")] = 0,
) -> None:
    """Simulate a flight and write it as CSV."""
    check_output(out, Path(airframe))
    if not 0 <= noise <= 1e6:
        raise InputError(f"--noise: must lie in 0 to 1e6, got {noise}.")
    if not 0 <= seed < 2**63:
        raise InputError(f"--seed: must lie in 0 to 2^63 - 1, got {seed}.")
    if dt > 0 and duration / dt > MOST_SAMPLES:
        raise InputError(f"--duration {duration:g}: more than {MOST_SAMPLES} samples of {dt:g} s; ask for fewer.")
    with stages("loading the library") as progress:
        from ..airframe import load_airframe
        from ..excitation import EXCITATIONS
        from ..logs import write_flight
        from ..models import MODELS
        from ..noise import SENSOR_SIGMA, WhiteNoise, measure
        from ..results import RESULTS, result_names
        from ..simulation import simulate as fly

        progress("compiling and simulating")
        vehicle = MODELS[model](load_airframe(airframe))
        try:
            omega = EXCITATIONS[excitation](vehicle.airframe, duration=duration, dt=dt)
        except ValueError as error:
            raise InputError(f"--excitation {excitation.value}: {error}") from None
        flight = fly(vehicle, vehicle.alpha, omega, dt=dt, method=method.value)
        if flight.result != RESULTS.successful:
            typer.echo(f"jaxos4: {result_names(flight.result)}: {RESULTS[flight.result]}", err=True)
            raise typer.Exit(1)
        flight = measure(flight, WhiteNoise(noise * SENSOR_SIGMA), seed=seed)
        progress("writing")
        write_flight(flight, out)
    typer.echo(f"{out}: {omega.shape[0]} samples of {dt:g} s, {model.value} model, {method.value}, noise {noise:g}")
