"""`jaxos4 estimate`: the parameters of a quadrotor from recorded flights, with 95 % intervals."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .._files import read_toml
from ..errors import InputError
from ._choices import (
    AirframeOption,
    BracketOption,
    ChannelsOption,
    Estimator,
    InitialState,
    InitialStateOption,
    Loss,
    OutOption,
    VehicleModel,
    WindowOption,
)
from ._messages import in_options, option_names
from ._output import check_output, write_json
from ._progress import stages

if TYPE_CHECKING:
    from ..identification import Identification


def estimate(
    flights: Annotated[list[Path], typer.Argument(metavar="FLIGHT...", help="A flight, or logs of one vehicle.")],
    estimator: Annotated[
        Estimator | None, typer.Option(help="The algorithm; default: ibss, or filter-error for a vehicle.")
    ] = None,
    model: Annotated[
        VehicleModel, typer.Option(help="The equations: as printed, corrected, or those of a real vehicle.")
    ] = VehicleModel["published"],
    airframe: AirframeOption = "os4",
    bracket: BracketOption = None,
    channels: ChannelsOption = None,
    initial_state: InitialStateOption = InitialState["free"],
    window: WindowOption = None,
    network: Annotated[
        Path | None, typer.Option(help="A network file from `jaxos4 train`; without it, a network is trained now.")
    ] = None,
    validate: Annotated[
        Path | None, typer.Option(metavar="OTHER.csv", help="Another flight: not fitted, but predicted.")
    ] = None,
    terms: Annotated[
        str | None, typer.Option(help="With --model flight: offset,damping,...; default: what the logs allow.")
    ] = None,
    begin: Annotated[
        float | None,
        typer.Option("--from", metavar="SECONDS", help="With --model flight: use the logs from this time on."),
    ] = None,
    end: Annotated[
        float | None, typer.Option("--to", metavar="SECONDS", help="With --model flight: use the logs up to this time.")
    ] = None,
    sample_time: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="With --model flight: the sample time to average to.")
    ] = None,
    holdout: Annotated[
        float | None, typer.Option(metavar="SHARE", help="With --model flight: the share to predict; default: 0.25.")
    ] = None,
    loss: Annotated[Loss | None, typer.Option(help="With --model flight: huber (default) cuts outliers.")] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="With --model flight: an HTML report to write.")
    ] = None,
    out: OutOption = None,
) -> None:
    """Estimate alpha_1..8 of a flight, or a real vehicle's parameters from its logs, with 95 % intervals."""
    for target in (out, report):
        if target is not None:
            check_output(target, *flights, Path(airframe), bracket, network, validate)
    if out is not None and report is not None and out.resolve() == report.resolve():
        raise InputError(f"{out}: --out and --report name one file; give them two.")
    is_vehicle = model == "flight"
    if report is not None and not is_vehicle:
        raise InputError(f"--report: is for --model flight, not {model}; leave it out.")
    options: dict[str, Any] = {
        "estimator": None if estimator is None else estimator.value,
        "bracket": None if bracket is None else read_toml(bracket),
        "channels": None if channels is None else channels.value,
        "initial_state": initial_state.value,
        "window": window,
        "network": network,
        "terms": None if terms is None else [name.strip() for name in terms.split(",") if name.strip()],
        "begin": begin,
        "end": end,
        "sample_time": sample_time,
        "holdout": holdout,
        "loss": None if loss is None else loss.value,
    }
    with stages("loading the library") as progress, option_names(bracket=bracket, network=network):
        from ..airframe import load_airframe
        from ..identification import identify
        from ..models import MODELS
        from ..recording import read_recording

        progress("reading")
        vehicle = load_airframe(airframe)
        recordings = [read_recording(path, vehicle) for path in flights]
        other = None if validate is None else read_recording(validate, vehicle)
        subject = vehicle if is_vehicle else MODELS[model](vehicle)
        found = identify(recordings, subject, validate=other, progress=progress, **options)
    _publish(_with_command(found, airframe), out, report, title=", ".join(path.name for path in flights))


def _with_command(found: "Identification", airframe: str) -> "Identification":
    """The identification with the command in its provenance, and its notes in the words of the command line."""
    import msgspec

    asked = {
        "airframe": airframe,
        "notes": [in_options(note) for note in found.provenance["notes"]],
        "command": shlex.join(["jaxos4", *sys.argv[1:]]),
    }
    return msgspec.structs.replace(found, provenance=found.provenance | asked)


def _publish(found: "Identification", out: Path | None, report: Path | None, *, title: str) -> None:
    """Writes and prints; ends with exit code 1 if the estimate cannot be trusted."""
    from rich.console import Console

    from ..identification import VehicleIdentification
    from ..report import print_identification
    from ..results import RESULTS

    console = Console()
    if out is not None:
        write_json(found.to_dict(), out)
    for note in found.provenance["notes"]:
        console.print(f"note: {note}", markup=False, highlight=False)
    print_identification(console, found)
    if report is not None and isinstance(found, VehicleIdentification):
        with stages("drawing"):
            from ..report import write_flight_page

            write_flight_page(report, found, title=title)
        console.print(f"report: {report}", markup=False, highlight=False)
    if not found.successful:
        typer.echo(f"jaxos4: {found.result}: {RESULTS[getattr(RESULTS, found.result)]}", err=True)
        raise typer.Exit(1)
