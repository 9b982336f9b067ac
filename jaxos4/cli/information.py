"""`jaxos4 inspect` and `jaxos4 identifiability`: what a log contains, and which parameters a flight can identify."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from .._files import write_file
from ..errors import InputError
from . import _options as options
from ._output import check_outputs, option_names, stages, write_json

if TYPE_CHECKING:
    from rich.console import Console

    from ..recording.inspection import Inspection

# If a log has more parts, only the longest are printed.
_MOST_PARTS = 14
_UNITS = {"p q r": "rad/s", "phi theta psi": "rad", "x y z": "m", "vx vy vz": "m/s", "ax ay az": "m/s^2"}
_UNITS |= {"rotor1 rotor2 rotor3 rotor4": "rad/s"}


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
    out: options.OutOption = None,
) -> None:
    """Show what a log contains, whether it agrees with itself, which parts can be used, and how much they excite."""
    check_outputs(log, airframe, columns, out=out, airframe_out=airframe_out)
    if airframe_out is not None and airframe_out.exists():
        raise InputError(f"{airframe_out}: exists, and may hold what you measured; give another name.")
    if airframe is not None and airframe_out is not None:
        raise InputError("--airframe-out: begins an airframe from the log alone; leave out --airframe.")
    with stages("loading the library") as progress:
        from rich.console import Console

        from ..airframe import load_airframe
        from ..recording import read_recording
        from ..recording.inspection import airframe_draft, inspect_log

        progress("reading")
        vehicle = None if airframe is None else load_airframe(airframe)
        recording = read_recording(log, vehicle, full_scale=1.0, columns=columns)
        found = inspect_log(recording, vehicle)
        text, missing = ("", ()) if airframe_out is None else airframe_draft(recording)
    console = Console(highlight=False, markup=False)
    if out is not None:
        write_json(found.to_dict(), out)
    if airframe_out is not None:
        write_file(airframe_out, text)
    _print_contents(console, found, recording.facts.format.label if recording.facts.format else "")
    _print_parts(console, found)
    if airframe_out is not None:
        still = f"; weigh or measure, and fill in: {', '.join(missing)}"
        console.print(f"airframe: {airframe_out}{still}", soft_wrap=True)


def _print_contents(console: "Console", found: "Inspection", label: str) -> None:
    console.print(
        f"{found.log}: {label}, {found.begin:.2f} to {found.end:.2f} s, {found.samples} samples, "
        f"one every {1e3 * found.sample_time:.4g} ms",
        soft_wrap=True,
    )
    for finding in found.findings:
        console.print(f"cannot identify a vehicle: {finding}.", soft_wrap=True)
    for each in found.checks:
        verb = "contradicts" if each.contradicted else "concerns"
        console.print(f"{verb} {', '.join(each.quantities)}: {each}.", soft_wrap=True)
    for names, unit in _UNITS.items():
        measured = {name: found.measured[name] for name in names.split() if name in found.measured}
        if not measured:
            continue
        largest = max(abs(end) for channel in measured.values() for end in (channel.least, channel.most))
        rate = min(channel.rate for channel in measured.values())
        gap = max(channel.longest_gap for channel in measured.values())
        gaps = f", at most {1e3 * gap:.3g} ms apart" if gap > 1.5 * found.sample_time else ""
        commands = "rotor1" in names and 0 < largest <= 1
        size = f"up to {largest:.3g} {'of full scale (commands)' if commands else unit}"
        console.print(f"  {' '.join(measured)}: {rate:.4g} Hz{gaps}, {size}")
    for note in found.notes:
        console.print(f"note: {note}")


def _print_parts(console: "Console", found: "Inspection") -> None:
    from ..report.text import Listing

    rows = []
    shown = sorted(found.parts, key=lambda part: part.begin - part.end)[:_MOST_PARTS]
    for part in sorted(shown, key=lambda part: part.begin):
        axes = [a.verdict if a.rate is None else f"{a.verdict} ({a.rate:.2g})" for a in part.excitation.values()]
        rows.append((f"{part.begin:.2f}", f"{part.end:.2f}", part.reason or "usable", *(axes or ["", "", ""])))
    headings, numbers = ("from [s]", "to [s]", "use", "roll", "pitch", "yaw"), ("from [s]", "to [s]")
    Listing(headings, rows, numbers, wraps=("use",)).print_on(console)
    if len(found.parts) > len(shown):
        console.print(f"and {len(found.parts) - len(shown)} shorter parts")
    console.print("roll, pitch, yaw: the excitation, and the standard deviation of the body rate [rad/s].")


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
    """Find which of alpha_1..8 a flight can identify, and why not the others."""
    check_outputs(flight, airframe, bracket, out=out)
    with stages("loading the library") as progress, option_names(bracket=bracket):
        from rich.console import Console

        from ..airframe import load_airframe
        from ..identification import assess
        from ..models import MODELS
        from ..recording import read_recording
        from ..report.text import Listing

        progress("reading")
        subject = MODELS[model](load_airframe(airframe))
        recording = read_recording(flight, subject.airframe)
        found = assess(
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
    if not found.fitted:
        console.print("note: no fit; all numbers below hold at the bracket's centre")
    rows = []
    for name, row in found.parameters.items():
        bound, alone = (float("inf") if x is None else x for x in (row.bound, row.others_known))
        limit = f"{row.noise_limit:.2g} x" if bound <= row.half_width and row.noise_limit else "-"
        rows.append((name, row.unit, f"{bound:.2g}", f"{alone:.2g}", f"{bound / row.half_width:.2g}", limit))
    numbers = ("bound", "others known", "of bracket", "noise limit")
    notes = [row.note for row in found.parameters.values()]
    Listing(("parameter", "unit", *numbers), rows, numbers, notes).print_on(console)
    console.print(
        "bound: the smallest possible standard deviation at the noise that was found; others known: the same if all "
        "other parameters were known; of bracket: bound / half-width of the bracket, above 1 the parameter is not "
        "identifiable; noise limit: the largest noise, in multiples of the noise that was found, at which the "
        "airframe's value can be distinguished from 0."
    )
