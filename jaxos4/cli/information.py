"""`jaxos4 inspect` and `jaxos4 identifiability`: what a log contains, and which parameters a flight can identify."""

import jaxos4

from .._files import read_toml, write_file
from ..errors import InputError
from . import options
from ._shared import check_outputs, command, console, showing_stages, write_json


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
