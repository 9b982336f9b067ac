"""`jaxos4 estimate` and `jaxos4 train`: parameters from recorded flights, with 95 % intervals; a network for these."""

import shlex
import time
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

import jaxos4

from ..errors import InputError, named, printable
from . import _shared as options
from ._shared import check_outputs, command, end, stages, write_json

_OS4, _PUBLISHED = "os4", "published"
# The defaults of `NetworkEstimator`, written out because its import takes seconds; a test compares them.
NOISE, STEPS = (0.1, 10.0), 4000


def estimate(
    flights: Annotated[list[Path], Argument(metavar="FLIGHT...", help="A flight, or logs of one vehicle.")],
    estimator: options.EstimatorOption = None,
    model: Annotated[
        options.VehicleModel | None,
        Option(help="Equations: as published, corrected, or of a real vehicle. Default: by the log."),
    ] = None,
    airframe: Annotated[
        str | None,
        Option(help="A preset (os4, crazyflie, x500, ...) or a TOML file. Default: os4; a vehicle needs one."),
    ] = None,
    columns: options.ColumnsOption = None,
    bracket: options.BracketOption = None,
    channels: options.ChannelsOption = None,
    initial_state: options.InitialStateOption = "free",
    window: options.WindowOption = None,
    network: Annotated[
        Path | None, Option(help="A network file from `jaxos4 train`; without it, a network is trained now.")
    ] = None,
    validate: Annotated[Path | None, Option(help="Another flight: not fitted, but predicted.")] = None,
    terms: Annotated[str | None, Option(help="Real vehicle: offset,damping,...; default: what the logs allow.")] = None,
    begin: Annotated[float | None, Option("--begin", "--from", help="Real vehicle: first time to use [s].")] = None,
    end: Annotated[float | None, Option("--end", "--to", help="Real vehicle: last time to use [s].")] = None,
    sample_time: Annotated[float | None, Option(help="Real vehicle: the sample time to average to [s].")] = None,
    holdout: Annotated[float | None, Option(help="Real vehicle: the share to predict; default: 0.25.")] = None,
    report: Annotated[Path | None, Option(help="An HTML report to write.")] = None,
    out: options.OutOption = None,
    verbose: Annotated[
        bool, Option("--verbose", "-v", help="Real vehicle: all parameters, noise and predictions.")
    ] = False,
) -> None:
    """Estimate the parameters of a vehicle from its logs.

    Prints each with its 95 % interval: alpha_1..8 of an OS4; constants and verdicts of a real vehicle.
    """
    check_outputs(*flights, airframe, columns, bracket, network, validate, out=out, report=report)
    listed = None if terms is None else [name.strip() for name in terms.split(",") if name.strip()]
    asked = {"channels": channels, "initial_state": initial_state, "window": window}
    asked |= {"terms": listed, "begin": begin, "end": end, "sample_time": sample_time, "holdout": holdout}
    with stages("loading the library") as progress:
        from msgspec.structs import replace

        from ..identification import settings_for
        from ..recording import read_recording

        vehicle = jaxos4.load_airframe(airframe or _OS4)
        # Without an airframe, commands are read only to find out that one is needed.
        full_scale = 1.0 if airframe is None and model in (None, "flight") else None
        recordings = []
        for number, path in enumerate(flights, start=1):
            progress(f"reading {printable(path.name)} ({number} of {len(flights)})")
            recordings.append(read_recording(path, vehicle, full_scale=full_scale, columns=columns))
        subject, evidence = _subject(recordings, model, vehicle, given=airframe is not None)
        found = jaxos4.identify(
            recordings,
            subject,
            settings=settings_for(subject, asked),
            estimator=estimator,
            bracket=options.read_bracket(bracket),
            network=network,
            validate=None if validate is None else read_recording(validate, vehicle, columns=columns),
            progress=progress,
        )
    taken = [f"{evidence}: taken as a real vehicle's (--model flight)"] if evidence else []
    notes = [*taken, *found.provenance.notes]
    asked = {"airframe": printable(airframe or _OS4), "notes": notes, "command": command()}
    found = replace(found, provenance=replace(found.provenance, **asked))
    _publish(found, out, report, verbose=verbose)


def _subject(
    recordings: "list[jaxos4.Recording]", model: options.VehicleModel | None, vehicle: "jaxos4.Airframe", *, given: bool
) -> "tuple[jaxos4.Airframe | jaxos4.AbstractModel, str]":
    """An airframe or an OS4 model; and why a log is evidently of a vehicle. `given`: whether the airframe was."""
    from ..models import MODELS

    shown = (f"{each.name} {why}" for each in recordings if (why := each.vehicle_evidence))
    evidence = next(shown, "") if model is None else ""
    if model != "flight" and not evidence:
        return MODELS[model or _PUBLISHED](vehicle), ""
    if not given:
        begin_one = f"`jaxos4 inspect {shlex.quote(recordings[0].name)} --airframe-out mine.toml` begins one"
        raise InputError(f"{evidence or '--model flight'}: a real vehicle needs --airframe; {begin_one}.")
    return vehicle, evidence


def _publish(found: "jaxos4.Identification", out: Path | None, report: Path | None, *, verbose: bool) -> None:
    """Writes and prints; ends with exit code 1 if the estimate cannot be trusted."""
    from rich.console import Console

    console = Console()
    if out is not None:
        write_json(found.to_dict(), out)
    if report is not None:
        with stages("drawing"):
            jaxos4.report.write_flight_page(report, found)
    jaxos4.report.print_identification(console, found, verbose=verbose)
    if found.is_vehicle and found.has_answer and not verbose:
        console.print("--verbose shows all parameters, the noise, and how well rates are predicted", highlight=False)
    if report is not None:
        console.print(f"report: {report}", markup=False, highlight=False)
    end(found.result)


def train(
    flight: Annotated[Path, Argument(metavar="FLIGHT.csv", help="A flight with the inputs to train for.")],
    out: Annotated[Path, Option(help="The network file to write.")],
    model: options.ModelOption = "published",
    airframe: options.AirframeOption = "os4",
    bracket: options.BracketOption = None,
    initial_state: options.InitialStateOption = "free",
    features: Annotated[options.Features, Option(help="What the network sees.")] = "score",
    architecture: Annotated[
        options.Architecture, Option(help="A multilayer perceptron, or CMAC: tables of weights.")
    ] = "mlp",
    noise: Annotated[
        tuple[float, float],
        Option(help="Lowest and highest noise to train for, in multiples of the standard sensors' noise."),
    ] = NOISE,
    channels: Annotated[
        options.Channels | None,
        Option(
            help="The channels that the network sees. Default: the rates, and the attitude if a rate was not measured."
        ),
    ] = None,
    steps: Annotated[int, Option(help="Number of training steps.")] = STEPS,
    seed: options.SeedOption = 0,
) -> None:
    """Train a network for the inputs of a flight.

    The network then identifies any flight with these inputs.
    """
    with stages("loading the library") as progress:
        from ..identification.problem import train_network
        from ..models import MODELS
        from ..recording import read_recording

        with named("options"):
            settings = jaxos4.NetworkEstimator(features=features, architecture=architecture, noise=noise, steps=steps)
        check_outputs(flight, airframe, bracket, out=out)
        progress("reading")
        subject = MODELS[model](jaxos4.load_airframe(airframe))
        recording = read_recording(flight, subject.airframe)
    begin = time.perf_counter()
    with stages("training the network"):
        network = train_network(
            recording,
            subject,
            settings,
            bracket=options.read_bracket(bracket),
            channels=channels,
            initial_state=initial_state,
            seed=seed,
        )
    jaxos4.save_network(network, out)
    for note in recording.notes:
        typer.echo(f"note: {note}")
    low, high = noise
    typer.echo(
        f"{out}: {architecture}, {features} features of the {network.channels}, noise {low:g} to {high:g} times the "
        f"standard one, {model} model, {recording.flight.time.shape[0]} samples, loss "
        f"{network.history[:, 1].min():.4g}, {time.perf_counter() - begin:.0f} s"
    )
