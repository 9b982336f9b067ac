"""Commands on recorded flights: `jaxos4 estimate`, `train`, `inspect` and `identifiability`."""

import shlex
import time
from pathlib import Path

import typer

import jaxos4

from .._files import read_toml, write_file
from ..errors import InputError, named, printable
from . import options
from ._shared import check_outputs, command, console, end, showing_stages, write_json

_OS4, _PUBLISHED = "os4", "published"
# The defaults of `NetworkEstimator`, written out because its import takes seconds; a test compares them.
NOISE, STEPS = (0.1, 10.0), 4000


def estimate(
    flights: options.Flights,
    estimator: options.Estimator = None,
    model: options.VehicleEquations = None,
    airframe: options.VehicleAirframe = None,
    columns: options.Columns = None,
    bracket: options.Bracket = None,
    channels: options.FittedChannels = None,
    initial_state: options.FirstState = "free",
    window: options.Window = None,
    network: options.Network = None,
    validate: options.Validate = None,
    terms: options.Terms = None,
    begin: options.Begin = None,
    end: options.End = None,
    sample_time: options.SampleTime = None,
    holdout: options.Holdout = None,
    report: options.Page = None,
    out: options.Json = None,
    verbose: options.Verbose = False,
) -> None:
    """Estimate the parameters of a vehicle from its logs.

    Prints each with its 95 % interval: alpha_1..8 of an OS4; constants and verdicts of a real vehicle.
    """
    check_outputs(*flights, airframe, columns, bracket, network, validate, out=out, report=report)
    listed = None if terms is None else [name.strip() for name in terms.split(",") if name.strip()]
    asked = {"channels": channels, "initial_state": initial_state, "window": window}
    asked |= {"terms": listed, "begin": begin, "end": end, "sample_time": sample_time, "holdout": holdout}
    with showing_stages("loading the library") as progress:
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
            bracket=bracket and read_toml(bracket),
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
    if out is not None:
        write_json(found.to_dict(), out)
    if report is not None:
        with showing_stages("drawing"):
            jaxos4.report.write_flight_page(report, found)
    shown = console()
    jaxos4.report.print_identification(shown, found, verbose=verbose)
    if found.is_vehicle and found.has_answer and not verbose:
        shown.print("--verbose shows all parameters, the noise, and how well rates are predicted")
    if report is not None:
        shown.print(f"report: {report}")
    end(found.result)


def train(
    flight: options.TrainedFlight,
    out: options.NetworkOut,
    model: options.Equations = "published",
    airframe: options.Airframe = "os4",
    bracket: options.Bracket = None,
    initial_state: options.FirstState = "free",
    features: options.SeenFeatures = "score",
    architecture: options.NetworkKind = "mlp",
    noise: options.TrainedNoise = NOISE,
    channels: options.SeenChannels = None,
    steps: options.Steps = STEPS,
    seed: options.Seed = 0,
) -> None:
    """Train a network for the inputs of a flight.

    The network then identifies any flight with these inputs.
    """
    with showing_stages("loading the library") as progress:
        from ..identification.prepare_os4 import train_network
        from ..models import MODELS
        from ..recording import read_recording

        with named(""):
            settings = jaxos4.NetworkEstimator(features=features, architecture=architecture, noise=noise, steps=steps)
        check_outputs(flight, airframe, bracket, out=out)
        progress("reading")
        subject = MODELS[model](jaxos4.load_airframe(airframe))
        recording = read_recording(flight, subject.airframe)
        given = bracket and read_toml(bracket)
        begin = time.perf_counter()
        progress("training the network")
        network = train_network(
            recording, subject, settings, bracket=given, channels=channels, initial_state=initial_state, seed=seed
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


def inspect(
    log: options.Log,
    airframe: options.VehicleAirframe = None,
    columns: options.Columns = None,
    airframe_out: options.AirframeOut = None,
    report: options.Page = None,
    out: options.Json = None,
) -> None:
    """Check a log: its content, consistency and usable parts.

    Also shows how much each part excites each axis.
    """
    check_outputs(log, airframe, columns, out=out, airframe_out=airframe_out, report=report)
    if airframe_out is not None and airframe_out.exists():
        raise InputError(f"{airframe_out}: exists, and may hold what you measured; give another name.")
    if airframe is not None and airframe_out is not None:
        raise InputError("--airframe-out: begins an airframe from the log alone; leave out --airframe.")
    with showing_stages("loading the library") as progress:
        from ..recording import read_recording
        from ..recording.inspection import airframe_draft, inspect_log

        progress("reading")
        vehicle = None if airframe is None else jaxos4.load_airframe(airframe)
        recording = read_recording(log, vehicle, full_scale=1.0, columns=columns)
        progress("checking")
        found = inspect_log(recording, vehicle)
        text, missing = ("", ()) if airframe_out is None else airframe_draft(recording)
    if out is not None:
        write_json(found.to_dict(), out)
    if airframe_out is not None:
        write_file(airframe_out, text)
    if report is not None:
        with showing_stages("drawing"):
            jaxos4.report.write_log_page(report, recording, vehicle, found=found, command=command())
    shown = console()
    jaxos4.report.print_inspection(shown, found, recording.facts.format.label if recording.facts.format else "")
    if report is not None:
        shown.print(f"report: {report}", soft_wrap=True)
    if airframe_out is not None:
        still = f"; weigh or measure, and fill in: {', '.join(missing)}"
        shown.print(f"airframe: {airframe_out}{still}", soft_wrap=True)


def identifiability(
    flight: options.OneFlight,
    model: options.Equations = "published",
    airframe: options.Airframe = "os4",
    bracket: options.Bracket = None,
    channels: options.FittedChannels = None,
    initial_state: options.FirstState = "free",
    window: options.Window = None,
    out: options.Json = None,
) -> None:
    """Find which parameters a flight can identify.

    Says for each of the others (alpha_1..8) why not.
    """
    check_outputs(flight, airframe, bracket, out=out)
    with showing_stages("loading the library") as progress:
        from ..models import MODELS
        from ..recording import read_recording

        progress("reading")
        subject = MODELS[model](jaxos4.load_airframe(airframe))
        recording = read_recording(flight, subject.airframe)
        found = jaxos4.assess(
            recording,
            subject,
            bracket=bracket and read_toml(bracket),
            channels=channels,
            initial_state=initial_state,
            window=window,
            progress=progress,
        )
    if out is not None:
        write_json(found.to_dict(), out)
    shown = console()
    for note in recording.notes:
        shown.print(f"note: {note}")
    jaxos4.report.print_information(shown, found)
