"""The content of a log, and the parameters that a flight of an OS4 can identify, as text for a terminal."""

from rich.console import Console

from ..identification import FlightInformation
from ..recording.inspection import Inspection
from .text import Listing

_COMMANDS = "of full scale (commands)"
_UNITS = {"p q r": "rad/s", "phi theta psi": "rad", "x y z": "m", "vx vy vz": "m/s", "ax ay az": "m/s^2"}
_UNITS |= {"rotor1 rotor2 rotor3 rotor4": "rad/s"}


def unit_of(channel: str, commands: bool) -> str:
    """The unit of a channel. `commands`: whether rotors have commands."""
    unit = next(unit for names, unit in _UNITS.items() if channel in names.split())
    return _COMMANDS if commands and channel.startswith("rotor") else unit


def print_inspection(console: Console, found: Inspection, label: str) -> None:
    """Prints what was measured, whether the log agrees with itself, and its parts. `label`: of the log's format."""
    _print_contents(console, found, label)
    _print_parts(console, found)


def _print_contents(console: Console, found: Inspection, label: str) -> None:
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
        size = f"up to {largest:.3g} {_COMMANDS if commands else unit}"
        console.print(f"  {' '.join(measured)}: {rate:.4g} Hz{gaps}, {size}")
    for note in found.notes:
        console.print(f"note: {note}")


def _print_parts(console: Console, found: Inspection, *, most: int = 14) -> None:
    """Prints the parts of a log in order of time; if there are more than `most`, the longest."""
    rows = []
    shown = sorted(found.parts, key=lambda part: part.begin - part.end)[:most]
    for part in sorted(shown, key=lambda part: part.begin):
        axes = [a.verdict if a.rate is None else f"{a.verdict} ({a.rate:.2g})" for a in part.excitation.values()]
        rows.append((f"{part.begin:.2f}", f"{part.end:.2f}", part.reason or "usable", *(axes or ["", "", ""])))
    headings, numbers = ("from [s]", "to [s]", "use", "roll", "pitch", "yaw"), ("from [s]", "to [s]")
    Listing(headings, rows, numbers, wraps=("use",)).print_on(console)
    if len(found.parts) > len(shown):
        console.print(f"and {len(found.parts) - len(shown)} shorter parts")
    console.print("roll, pitch, yaw: the excitation, and the standard deviation of the body rate [rad/s].")


def print_information(console: Console, found: FlightInformation) -> None:
    """Prints a row for each parameter: its bound, and whether it is identifiable."""
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
