"""`jaxos4 inspect`: the contents of a log, its usable parts, and the identifiable parameters."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import InputError
from ._options import OutOption
from ._output import check_different, check_output, stages, write_json, write_text

if TYPE_CHECKING:
    from rich.console import Console

    from ..recording.inspection import IdentifiableParameters, Inspection

# At most so many parts are printed, the longest ones.
MOST_PARTS = 14
CHANNELS = (
    (("p", "q", "r"), "rad/s"),
    (("phi", "theta", "psi"), "rad"),
    (("x", "y", "z"), "m"),
    (("vx", "vy", "vz"), "m/s"),
    (("ax", "ay", "az"), "m/s^2"),
    (("rotor1", "rotor2", "rotor3", "rotor4"), "rad/s"),
)


def inspect(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A log: flight CSV, ULog, blackbox or Crazyflie.")],
    airframe: Annotated[
        str | None, typer.Option(help="os4, os4-simulator, voos, or a TOML file. Needed for torques and parameters.")
    ] = None,
    airframe_out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.toml", help="An airframe to write: what the log knows, and what must be measured."),
    ] = None,
    out: OutOption = None,
) -> None:
    """Show what a log contains, which parts of it can be used, and which parameters they identify."""
    for target in (out, airframe_out):
        if target is not None:
            check_output(target, log, None if airframe is None else Path(airframe))
    check_different(out=out, airframe_out=airframe_out)
    if airframe_out is not None and airframe_out.exists():
        raise InputError(
            f"{airframe_out}: exists, and may hold what you measured; give another name, and --airframe {airframe_out} "
            "to keep its values."
        )
    with stages("loading the library") as progress:
        from rich.console import Console

        from ..airframe import load_airframe
        from ..logs import log_format
        from ..recording import read_recording
        from ..recording.drafting import airframe_draft
        from ..recording.inspection import inspect_log

        progress("reading")
        vehicle = None if airframe is None else load_airframe(airframe)
        if vehicle is not None:
            progress("reading, and finding the identifiable parameters")
        recording = read_recording(log, vehicle, full_scale=1.0)
        found = inspect_log(recording, vehicle)
        draft = None if airframe_out is None else airframe_draft(recording, airframe)
    console = Console(highlight=False, markup=False)
    if out is not None:
        write_json(found.to_dict(), out)
    if draft is not None and airframe_out is not None:
        write_text(draft.text, airframe_out)
    _print_contents(console, found, log_format(log).label)
    _print_parts(console, found)
    if found.identifiable is not None:
        _print_identifiable(console, found.identifiable)
    elif found.findings:
        console.print("no parameter is identifiable, see the first lines.")
    elif vehicle is None:
        begins = "" if draft is not None else " (--airframe-out begins one)"
        console.print(f"give --airframe to see which parameters are identifiable{begins}.", soft_wrap=True)
    else:
        console.print("identifiable parameters are computed only if p, q and r were measured.")
    if draft is not None:
        still = f"; weigh or measure, and fill in: {', '.join(draft.missing)}" if draft.missing else ""
        console.print(f"airframe: {airframe_out}{still}", soft_wrap=True)


def _print_contents(console: "Console", found: "Inspection", label: str) -> None:
    console.print(
        f"{found.log}: {label}, {found.begin:.2f} to {found.end:.2f} s, {found.samples} samples, "
        f"one every {1e3 * found.sample_time:.4g} ms",
        soft_wrap=True,
    )
    for finding in found.findings:
        console.print(f"cannot identify a vehicle: {finding}.", soft_wrap=True)
    for names, unit in CHANNELS:
        measured = {name: found.measured[name] for name in names if name in found.measured}
        if not measured:
            continue
        largest = max(abs(end) for channel in measured.values() for end in (channel.least, channel.most))
        rate = min(channel.rate for channel in measured.values())
        gap = max(channel.longest_gap for channel in measured.values())
        gaps = f", at most {1e3 * gap:.3g} ms apart" if gap > 1.5 * found.sample_time else ""
        commands = "rotor1" in names and largest <= 1
        size = f"up to {largest:.3g} {'of full scale (commands)' if commands else unit}"
        console.print(f"  {' '.join(measured)}: {rate:.4g} Hz{gaps}, {size}")
    for note in found.notes:
        console.print(f"note: {note}")


def _print_parts(console: "Console", found: "Inspection") -> None:
    from ..report.text import Listing

    rows = []
    shown = sorted(found.parts, key=lambda part: part.begin - part.end)[:MOST_PARTS]
    for part in sorted(shown, key=lambda part: part.begin):
        axes = [a.verdict if a.rate is None else f"{a.verdict} ({a.rate:.2g})" for a in part.excitation.values()]
        rows.append((f"{part.begin:.2f}", f"{part.end:.2f}", part.reason or "usable", *(axes or ["", "", ""])))
    headings, numbers = ("from [s]", "to [s]", "use", "roll", "pitch", "yaw"), ("from [s]", "to [s]")
    Listing(headings, rows, numbers, wraps=("use",)).print_on(console)
    if len(found.parts) > len(shown):
        console.print(f"and {len(found.parts) - len(shown)} shorter parts")
    console.print("roll, pitch, yaw: the excitation, and the standard deviation of the body rate [rad/s].")


def _print_identifiable(console: "Console", found: "IdentifiableParameters") -> None:
    console.print(
        f"From the body rates between {found.begin:.2f} and {found.end:.2f} s, with the corrected model (how well: see "
        "jaxos4 estimate):"
    )
    names = [name for name, row in found.parameters.items() if row.identifiable]
    console.print(f"  identifiable: {', '.join(names) or 'nothing'}")
    for name, row in found.parameters.items():
        if row.note:
            console.print(f"  {name}: {row.note}")
