"""`jaxos4 estimate`: the parameters that a flight tells, with their intervals."""

import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import jax
import typer
from rich.console import Console

from ..errors import InputError
from ..identification.results import VehicleIdentification
from ..report.flight_page import write_flight_page
from ..report.identification_page import print_identification
from ..results import RESULTS
from ._check_output import check_output
from ._choices import (
    AirframeOption,
    BracketOption,
    ChannelsOption,
    Estimator,
    InitialState,
    InitialStateOption,
    Loss,
    Model,
    OutOption,
    VehicleModel,
    WindowOption,
)
from ._flight import identify_flight
from ._json import write_json
from ._page import typed
from ._recordings import HOLDOUT, WINDOW, Part
from ._vehicle import identify_vehicle


def estimate(
    flights: Annotated[list[Path], typer.Argument(metavar="FLIGHT...", help="A recorded flight; logs of one vehicle.")],
    estimator: Annotated[Estimator, typer.Option(help="The algorithm.")] = Estimator["ibss"],
    model: Annotated[
        VehicleModel, typer.Option(help="The equations: as printed, corrected, or of a real vehicle in flight.")
    ] = VehicleModel["published"],
    airframe: AirframeOption = "os4",
    bracket: BracketOption = None,
    channels: ChannelsOption = None,
    initial_state: InitialStateOption = InitialState["free"],
    window: WindowOption = None,
    network: Annotated[
        Path | None,
        typer.Option(help="A file from `jaxos4 train`, for the network and the hybrid; trained now without it."),
    ] = None,
    validate: Annotated[
        Path | None, typer.Option(metavar="OTHER.csv", help="A flight that is not fitted, to be predicted.")
    ] = None,
    terms: Annotated[
        str | None,
        typer.Option(help="With --model flight: offset,damping,... ; those that the logs allow without it."),
    ] = None,
    begin: Annotated[
        float | None, typer.Option("--from", metavar="SECONDS", help="With --model flight: use from there on.")
    ] = None,
    end: Annotated[
        float | None, typer.Option("--to", metavar="SECONDS", help="With --model flight: use up to there.")
    ] = None,
    sample_time: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="With --model flight: average to it; 0.004 where faster.")
    ] = None,
    holdout: Annotated[
        float | None, typer.Option(metavar="SHARE", help="With --model flight: kept back to be predicted; 0.25.")
    ] = None,
    loss: Annotated[
        Loss | None, typer.Option(help="With --model flight: whether outliers are cut; huber without it.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="With --model flight: a page to write.")
    ] = None,
    out: OutOption = None,
) -> None:
    """Estimate alpha_1..8 of a flight, or a real vehicle's parameters from its logs, with 95 % intervals."""
    console = Console()
    for target in (out, report):
        if target is not None:
            check_output(target, *flights, Path(airframe), bracket, network, validate)
    if out is not None and report is not None and out.resolve() == report.resolve():
        raise InputError(f"{out}: --out and --report name one file; give them two.")
    if model == "flight":
        refused = {"--channels": channels, "--network": network}
        _refuse(refused, "a flight model compares the rates and the specific force, and trains its own network")
        if initial_state == "known":
            raise InputError("--initial-state known: each window begins in a state of its own; leave it out.")
        kept_back = holdout if holdout is not None else 0.0 if validate is not None else HOLDOUT
        found, predicted = identify_vehicle(
            console,
            flights,
            estimator=estimator.value,
            airframe=airframe,
            bracket=bracket,
            terms=terms,
            part=Part(begin, end, WINDOW if window is None else window, sample_time, kept_back),
            validate=validate,
            huber=loss != "squares",
        )
    else:
        only = {"--terms": terms, "--from": begin, "--to": end, "--sample-time": sample_time}
        only |= {"--holdout": holdout, "--loss": loss, "--report": report}
        _refuse(only, f"is for --model flight, not {model}")
        if len(flights) > 1:
            raise InputError(f"{flights[1]}: --model {model} explains one flight; use --model flight for several.")
        predicted = None
        found = identify_flight(
            console,
            flights[0],
            estimator,
            Model(model.value),
            airframe,
            bracket=bracket,
            channels=channels,
            initial_state=initial_state,
            window=window,
            network=network,
            validate=validate,
        )
    found["provenance"] |= _provenance()
    if out is not None:
        write_json(found, out)
    identified = typed(found, predicted)
    print_identification(console, identified)
    if report is not None and isinstance(identified, VehicleIdentification):
        write_flight_page(report, identified, title=", ".join(path.name for path in flights))
        console.print(f"report: {report}", markup=False, highlight=False)
    if found["result"] != "successful":
        typer.echo(f"jaxos4: {found['result']}: {RESULTS[getattr(RESULTS, found['result'])]}", err=True)
        raise typer.Exit(1)


def _refuse(options: dict[str, Any], why: str) -> None:
    for name, value in options.items():
        if value is not None:
            raise InputError(f"{name}: {why}; leave it out.")


def _provenance() -> dict[str, str]:
    from .. import __version__

    return {
        "version": __version__,
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "precision": "float64",
        "command": shlex.join(["jaxos4", *sys.argv[1:]]),
    }
