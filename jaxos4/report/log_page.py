"""The contents of a log, before anything is fitted: the text and the page of `jaxos4 inspect`."""

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup
from rich.console import Console

from .._files import check_writable
from ..airframe import MOTIONS, Airframe
from ..errors import InputError, counted, printable
from ..flight import RATES, SIGNALS, UNITS, Flight
from ..logs import Recording, Source, as_recording, read_recording
from ..recording.checks import Evidence
from ..recording.inspection import Inspection, inspect_log
from ..recording.prepared import prepare
from ..recording.stretches import Stretch, cut
from .log_figures import is_share, logged, motors, spectra
from .page import Section, picture, signals, table, text, write_page
from .text import Listing, plain, say
from .timeline import spans

_LONGEST, _PRINTED = 60, 14  # parts in the table of the page, and on the terminal, at most: the longest
_USUAL = 0.9  # of the time the rotors turn at speeds in the band of the spectra
_COMMANDS = "of full scale (commands)"
_TOGETHER = ["p q r", "phi theta psi", "x y z", "vx vy vz"]
_TOGETHER += [
    " ".join(signal.columns)
    for name, signal in SIGNALS.items()
    if signal.columns and name != "states" and not signal.is_input
]
# The unit of channels that are shown together.
_UNITS = {names: UNITS[names.split()[0]] for names in _TOGETHER} | {"rotor1 rotor2 rotor3 rotor4": "rad/s"}


def print_inspection(console: Console, found: Inspection, label: str) -> None:
    """Prints the channels of a log, the findings of its checks, and its longest parts. `label`: its format."""
    say(
        console,
        f"{found.log}: {label}, {found.begin:.2f} to {found.end:.2f} s, {found.samples} samples, "
        f"one every {1e3 * found.sample_time:.4g} ms",
        soft_wrap=True,
    )
    for refusal in found.refusals:
        say(console, f"cannot identify a vehicle: {refusal}.", soft_wrap=True)
    for each in found.findings:
        verb = "contradicts" if each.contradicted else "concerns"
        say(console, f"{verb} {', '.join(each.quantities)}: {each}.", soft_wrap=True)
    for names, unit in _UNITS.items():
        measured = {name: found.channels[name] for name in names.split() if name in found.channels}
        if not measured:
            continue
        largest = max(abs(end) for channel in measured.values() for end in (channel.least, channel.most))
        rate = min(channel.rate for channel in measured.values())
        gap = max(channel.longest_gap for channel in measured.values())
        gaps = f", at most {1e3 * gap:.3g} ms apart" if gap > 1.5 * found.sample_time else ""
        commands = "rotor1" in names and 0 < largest <= 1
        size = f"up to {largest:.3g} {_COMMANDS if commands else unit}"
        say(console, f"  {' '.join(measured)}: {rate:.4g} Hz{gaps}, {size}")
    for note in found.notes:
        say(console, f"note: {note}")
    rows = _part_rows(found, _PRINTED)
    headings, numbers = ("from [s]", "to [s]", "use", *MOTIONS), ("from [s]", "to [s]")
    Listing(headings, rows, numbers).print_on(console)
    if len(found.stretches) > len(rows):
        say(console, f"and {len(found.stretches) - len(rows)} shorter parts")
    say(console, "roll, pitch, yaw: the excitation, and the standard deviation of the body rate [rad/s].")


def _part_rows(found: Inspection, most: int) -> list[tuple[str, ...]]:
    """The cells of the `most` longest parts of a log, in order of time: from, to, use, and the excitation by axis."""
    rows = []
    longest = sorted(found.stretches, key=lambda part: part.begin - part.end)[:most]
    for part in sorted(longest, key=lambda part: part.begin):
        axes = [a.verdict if a.rate is None else f"{a.verdict} ({a.rate:.2g})" for a in part.excitation.values()]
        rows.append((f"{part.begin:.2f}", f"{part.end:.2f}", part.reason or "usable", *(axes or ["", "", ""])))
    return rows


def write_log_page(
    path: str | os.PathLike[str],
    log: Source,
    airframe: Airframe | None = None,
    *,
    found: Inspection | None = None,
    command: str = "",
) -> None:
    """Writes the page of a log, completely or not at all.

    - `log`: a recording, or the path of a log. `airframe`: of its vehicle; without it, torques are unknown.
    - `found`: the inspection, if it was made before. `command`: the one that makes the page again.

    **Raises:** `OSError` if the page cannot be written; `InputError` if the log cannot be read.
    """
    check_writable(path)
    given = isinstance(log, Recording | Flight)
    recording = as_recording(log) if given else read_recording(log, airframe, full_scale=1.0)
    found = inspect_log(recording, airframe) if found is None else found
    plausible = Evidence(recording, airframe).recording
    flown = [cut(plausible, Stretch(part.begin, part.end)) for part in found.stretches if part.usable]
    full = 1.0 if is_share(recording) else float("inf") if airframe is None else float(airframe.max_rotor_speed)
    label = recording.facts.format.label if recording.facts.format else "recording"
    sampled = f"{found.samples} samples, one every {plain(1e3 * found.sample_time)} ms"
    top = [
        text(verdict(found), f"verdict{' warning' if found.refusals else ''}"),
        text([f"Cannot identify a vehicle: {line}." for line in found.refusals]),
    ]
    sections = [
        Section("signals", "Logged signals", _signals(recording, airframe, found), "Signals"),
        Section("checks", "Failed checks", _checks(found), "Checks"),
        Section("parts", "Parts that can be used", [_parts(found)], "Parts"),
        Section("measured", "Sampling, gaps and ranges", [_measured(found, is_share(recording))], "Measured"),
        Section("motors", "Motors and their limits", _motors(flown, full), "Motors"),
        Section("spectra", "Vibration", _spectra(flown, full), "Spectra"),
    ]
    write_page(
        path,
        title=printable(Path(recording.name).name),
        about=f"{label}, {found.begin:.2f} to {found.end:.2f} s, {sampled}. Nothing was fitted.",
        top=top,
        sections=sections,
        command=command,
        end=[text(found.notes)],
        provenance=[("log", recording.name)],
    )


def _signals(recording: Recording, airframe: Airframe | None, found: Inspection) -> list[Markup]:
    drawn, block = logged(recording, found)
    caption = (
        "Horizontal: time [s]. Grey: not usable, for the reason in the table of parts. The options above the figure "
        "name the part that is in sight, for jaxos4 estimate."
    )
    if block > 1:
        blocks = f"{plain(1e3 * recording.dt * block)} ms"
        caption += f" Signals are drawn by their least and largest values in blocks of {blocks}."
    return [signals(drawn, caption, names_part=True), text(fit_note(recording, airframe), id="fitted")]


def _checks(found: Inspection) -> list[Markup]:
    status = {True: "contradicted", False: "concerned"}
    rows = [
        (", ".join(each.quantities), status[each.contradicted], each.cause, each.size, each.remedy)
        for each in found.findings
    ]
    headings = ("quantity", "", "cause", "size", "what to do")
    return [table("checks-table", "Checks that found something", headings, rows)]


def _parts(found: Inspection) -> Markup:
    rows = _part_rows(found, _LONGEST)
    shorter = len(found.stretches) - len(rows)
    note = (
        "Roll, pitch, yaw: the excitation, and the standard deviation of the body rate [rad/s]. An axis that is weak "
        f"or none is not identified by this part.{f' {shorter} shorter parts are not listed.' if shorter else ''}"
    )
    headings = ("from [s]", "to [s]", "use", *MOTIONS)
    return table("parts-table", "Parts of the log in order of time", headings, rows, [note])


def _measured(found: Inspection, commands: bool) -> Markup:
    rows = []
    for name, one in found.channels.items():
        unit = _COMMANDS if commands and name.startswith("rotor") else UNITS.get(name, "rad/s")
        numbers = plain(one.rate, 4), plain(1e3 * one.longest_gap, 3), plain(one.least, 4), plain(one.most, 4)
        rows.append((name, unit, *numbers))
    headings = ("channel", "unit", "rate [Hz]", "longest gap [ms]", "least", "largest")
    return table("measured-table", "What was measured, and how often", headings, rows)


def _motors(flown: Sequence[Recording], full: float) -> list[Markup]:
    if not flown:
        return []
    kind = "command, as a share of full scale" if full == 1 else "speed [rad/s]"
    caption = (
        f"The share of the usable time that each motor spends at each {kind}. Motors at a limit cannot answer the "
        "controller, and their parts are not used."
    )
    return [picture(motors(flown, full), caption)]


def _spectra(flown: Sequence[Recording], full: float) -> list[Markup]:
    if not flown:
        return []
    band, turns = None, ""
    if full != 1:
        speeds, rare = np.concatenate([each.omega for each in flown]), (1 - _USUAL) / 2
        low, high = np.quantile(speeds, [rare, 1 - rare]).tolist()
        band = low / (2 * math.pi), high / (2 * math.pi)
        turns = f" The rotors turn {band[0]:.0f} to {band[1]:.0f} Hz; their blades pass twice as often or more."
    if (figure := spectra(flown, band)) is None:
        return []
    caption = (
        f"Amplitude spectral density in the usable parts.{turns} Motion of a vehicle lies below about 20 Hz. A peak "
        "above is vibration; vibration above half the sampling rate folds down into the motion, and no setting removes "
        "it."
    )
    return [picture(figure, caption)]


def verdict(found: Inspection) -> str:
    """The usable share of a log, and the axes that it excites, in one sentence."""
    used = [part for part in found.stretches if part.usable]
    seconds = sum(part.end - part.begin for part in used)
    if not used:
        return "No part of this log can be used."
    rank = ("not measured", "none", "weak", "good")
    best = {axis: max((part.excitation[axis].verdict for part in used), key=rank.index) for axis in used[0].excitation}
    axes = ", ".join(f"{axis} {each}" for axis, each in best.items())
    parts = counted(len(used), "part")
    return f"{seconds:.1f} of {found.end - found.begin:.1f} s can be used, in {parts}; excitation: {axes}."


def fit_note(recording: Recording, airframe: Airframe | None) -> str:
    """The parts that `jaxos4 estimate` would fit and hold out, in words."""
    if airframe is None:
        return "Give --airframe to see here what would be fitted, and what held out."
    if recording.commanded and not airframe.has_full_scale:
        what = "this log has commands, and the rotor speed of full command is not known"
        return f"Nothing can be fitted: {what}; set max_rotor_speed [rad/s] in the airframe's file."
    try:
        ready = prepare([recording], airframe)[0]
    except InputError as error:
        return f"Nothing can be fitted: {error}"
    used = f"{ready.seconds[0]:.1f} s would be fitted, in samples of {1e3 * float(ready.fitted.dt):.3g} ms"
    if ready.tested is None:
        return f"{used}, and nothing held out."
    held_out = spans(ready.time, np.isfinite(np.asarray(ready.tested.states)[:, RATES[0]]))
    parts = ", ".join(f"{begin:.1f} to {end:.1f}" for begin, end in held_out[:8]) + ", ..." * (len(held_out) > 8)
    return f"{used}; {ready.seconds[1]:.1f} s would be held out and predicted: {parts} s."
