"""`jaxos4 inspect` and `jaxos4 identifiability`: what a log contains, and which parameters a flight can identify."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

import jaxos4

from .._files import write_file
from ..errors import InputError
from . import _shared as options
from ._shared import check_outputs, command, stages, write_json


def inspect(
    log: Annotated[Path, Argument(metavar="LOG", help="A flight in one of the formats of docs/logs.md.")],
    airframe: Annotated[
        str | None,
        Option(help="A preset (os4, crazyflie, x500, ...) or a TOML file. Needed to compare torques and motion."),
    ] = None,
    columns: options.ColumnsOption = None,
    airframe_out: Annotated[
        Path | None,
        Option(metavar="FILE.toml", help="An airframe to write: what the log knows, and what must be measured."),
    ] = None,
    report: Annotated[
        Path | None, Option(metavar="LOG.html", help="A page to write: signals over time, parts, checks, spectra.")
    ] = None,
    out: options.OutOption = None,
) -> None:
    """Check a log: its content, consistency and usable parts.

    Also shows how much each part excites each axis.
    """
    check_outputs(log, airframe, columns, out=out, airframe_out=airframe_out, report=report)
    if airframe_out is not None and airframe_out.exists():
        raise InputError(f"{airframe_out}: exists, and may hold what you measured; give another name.")
    if airframe is not None and airframe_out is not None:
        raise InputError("--airframe-out: begins an airframe from the log alone; leave out --airframe.")
    with stages("loading the library") as progress:
        from rich.console import Console

        from ..recording import read_recording
        from ..recording.inspection import airframe_draft, inspect_log
        from ..report.terminal import print_inspection

        progress("reading")
        vehicle = None if airframe is None else jaxos4.load_airframe(airframe)
        recording = read_recording(log, vehicle, full_scale=1.0, columns=columns)
        progress("checking")
        found = inspect_log(recording, vehicle)
        text, missing = ("", ()) if airframe_out is None else airframe_draft(recording)
    console = Console(highlight=False, markup=False)
    if out is not None:
        write_json(found.to_dict(), out)
    if airframe_out is not None:
        write_file(airframe_out, text)
    if report is not None:
        with stages("drawing"):
            jaxos4.report.write_log_page(report, recording, vehicle, found=found, command=command())
    print_inspection(console, found, recording.facts.format.label if recording.facts.format else "")
    if report is not None:
        console.print(f"report: {report}", soft_wrap=True)
    if airframe_out is not None:
        still = f"; weigh or measure, and fill in: {', '.join(missing)}"
        console.print(f"airframe: {airframe_out}{still}", soft_wrap=True)


def identifiability(
    flight: options.FlightFile,
    model: options.ModelOption = "published",
    airframe: options.AirframeOption = "os4",
    bracket: options.BracketOption = None,
    channels: options.ChannelsOption = None,
    initial_state: options.InitialStateOption = "free",
    window: options.WindowOption = None,
    out: options.OutOption = None,
) -> None:
    """Find which parameters a flight can identify.

    Says for each of the others (alpha_1..8) why not.
    """
    check_outputs(flight, airframe, bracket, out=out)
    with stages("loading the library") as progress:
        from rich.console import Console

        from ..models import MODELS
        from ..recording import read_recording
        from ..report.terminal import print_information

        progress("reading")
        subject = MODELS[model](jaxos4.load_airframe(airframe))
        recording = read_recording(flight, subject.airframe)
        found = jaxos4.assess(
            recording,
            subject,
            bracket=options.read_bracket(bracket),
            channels=channels,
            initial_state=initial_state,
            window=window,
            progress=progress,
        )
    if out is not None:
        write_json(found.to_dict(), out)
    console = Console(highlight=False, markup=False)
    for note in recording.notes:
        console.print(f"note: {note}")
    print_information(console, found)
