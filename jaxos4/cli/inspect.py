"""`jaxos4 inspect`: what is in a log, which parts of it are flown and excited, and what they can tell."""

import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import rich.box
import typer
from rich.console import Console
from rich.table import Table

from ..airframe import Airframe, load_airframe
from ..analysis.identifiability import Identifiability, identifiability
from ..bracket import Bracket
from ..flight import STATE_NAMES, Flight
from ..logs import log_format, read_log
from ..models.corrected import CorrectedOS4
from ..noise import SENSOR_SIGMA
from ..recording import stretches
from ..recording.excited import Excitation, excitation
from ..recording.usable import Stretch, cut
from ..shooting import ShootingProblem
from ._check_output import check_output
from ._choices import OutOption
from ._json import finite, write_json

FORMATS = {
    "ULog": "PX4 ULog",
    "Crazyflie": "Crazyflie micro-SD log",
    "blackbox": "blackbox CSV",
    "CSV": "flight CSV",
}
# Of the flight's parts, how many are shown.
MOST_PARTS = 14
# What can be identified is asked of this much of a stretch [s], in windows of that length [s].
LONGEST, WINDOW = 20.0, 0.5
RATES = ("p", "q", "r")
CHANNELS = (
    (RATES, "rad/s"),
    (("phi", "theta", "psi"), "rad"),
    (("x", "y", "z"), "m"),
    (("vx", "vy", "vz"), "m/s"),
    (("ax", "ay", "az"), "m/s^2"),
    (("rotor1", "rotor2", "rotor3", "rotor4"), "rad/s"),
)


def inspect(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A flight's log: CSV, ULog, blackbox CSV, Crazyflie.")],
    airframe: Annotated[
        str | None,
        typer.Option(help="os4, os4-simulator, voos, or a TOML file; without it, no torques and no parameters."),
    ] = None,
    out: OutOption = None,
) -> None:
    """What is in a log, which of it is in flight and excited enough, and what can be identified from it."""
    console = Console()
    vehicle = None if airframe is None else load_airframe(airframe)
    if out is not None:
        check_output(out, log, None if airframe is None else Path(airframe))
    kind = log_format(log)
    flight, notes = read_log(log, vehicle, full_scale=1.0)
    parts = stretches(flight, vehicle)
    usable = [part for part in parts if not part.reason]
    moved = {part: excitation(cut(flight, part), vehicle) for part in usable}

    report: dict[str, Any] = {
        "log": str(log),
        "format": kind,
        "samples": int(flight.time.shape[0]),
        "begin": float(flight.time[0]),
        "end": float(flight.time[-1]),
        "sample_time": float(flight.dt),
        "measured": _measured(flight),
        "notes": list(notes),
        "parts": [_part(part, moved.get(part)) for part in parts],
        "identifiable": None,
    }
    _print_contents(console, report, kind)
    _print_parts(console, parts, moved)
    longest = max(usable, key=lambda part: part.length, default=None)
    if longest is None:
        console.print("nothing to identify from: no part of the log is usable.", highlight=False)
    elif vehicle is None:
        console.print("what can be identified is told with --airframe.", highlight=False)
    elif any(np.isnan(np.asarray(flight.states)[:, STATE_NAMES.index(name)]).all() for name in RATES):
        console.print("what can be identified is told where p, q and r were measured.", highlight=False)
    else:
        report["identifiable"] = _identifiable(console, flight, longest, vehicle)
    if out is not None:
        write_json(report, out)


def _measured(flight: Flight) -> dict[str, dict[str, float]]:
    """Of each channel that was measured: samples a second, the longest time without one [s], and the range."""
    duration = float(flight.time[-1] - flight.time[0])
    columns: dict[str, np.ndarray] = {}
    columns.update(zip(STATE_NAMES, np.asarray(flight.states).T, strict=True))
    if flight.specific_force is not None:
        columns.update(zip(("ax", "ay", "az"), np.asarray(flight.specific_force).T, strict=True))
    columns.update((f"rotor{i + 1}", speed) for i, speed in enumerate(np.asarray(flight.omega).T))
    time, out = np.asarray(flight.time), {}
    for name, values in columns.items():
        at = np.flatnonzero(np.isfinite(values))
        if at.size == 0:
            continue
        edges = np.concatenate([time[:1], time[at], time[-1:]])
        out[name] = {
            "rate": at.size / duration,
            "longest_gap": float(np.diff(edges).max()),
            "least": float(values[at].min()),
            "most": float(values[at].max()),
        }
    return out


def _part(part: Stretch, moved: tuple[Excitation, ...] | None) -> dict[str, Any]:
    axes = {
        each.axis: {
            "torque": finite(each.torque),
            "rate": finite(each.rate),
            "noise": finite(each.noise),
            "verdict": each.verdict,
        }
        for each in moved or ()
    }
    return {"begin": part.begin, "end": part.end, "usable": not part.reason, "reason": part.reason, "excitation": axes}


def _print_contents(console: Console, report: dict[str, Any], kind: str) -> None:
    dt, measured = report["sample_time"], report["measured"]
    console.print(
        f"{report['log']}: {FORMATS[kind]}, {report['begin']:.2f} to {report['end']:.2f} s, {report['samples']} "
        f"samples, one every {1e3 * dt:.4g} ms",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
    for names, unit in CHANNELS:
        there = [name for name in names if name in measured]
        if there:
            rows = [measured[name] for name in there]
            size = max(abs(row[end]) for row in rows for end in ("least", "most"))
            rate, gap = min(row["rate"] for row in rows), max(row["longest_gap"] for row in rows)
            gaps = f", at most {1e3 * gap:.3g} ms apart" if gap > 1.5 * dt else ""
            unit = "of full scale (commands)" if "rotor1" in names and size <= 1 else unit
            text = f"  {' '.join(there)}: {rate:.4g} Hz{gaps}, up to {size:.3g} {unit}"
            console.print(text, markup=False, highlight=False)
    for note in report["notes"]:
        console.print(f"note: {note}", markup=False, highlight=False)


def _print_parts(
    console: Console, parts: tuple[Stretch, ...], moved: dict[Stretch, tuple[Excitation, Excitation, Excitation]]
) -> None:
    table = Table(box=rich.box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in ("from [s]", "to [s]", "use"):
        table.add_column(heading, justify="left" if heading == "use" else "right", no_wrap=heading != "use")
    for heading in ("roll", "pitch", "yaw"):
        table.add_column(heading, no_wrap=True)
    shown = sorted(sorted(parts, key=lambda part: -part.length)[:MOST_PARTS])
    for part in shown:
        axes = [_shown(each) for each in moved.get(part, ())] or ["", "", ""]
        table.add_row(f"{part.begin:.2f}", f"{part.end:.2f}", part.reason or "usable", *axes)
    console.print(table, markup=False)
    if len(parts) > len(shown):
        console.print(f"and {len(parts) - len(shown)} shorter parts", highlight=False)
    key = "roll, pitch, yaw: excitation, and the standard deviation of the body rate [rad/s]."
    console.print(key, markup=False, highlight=False)


def _shown(each: Excitation) -> str:
    return each.verdict if math.isnan(each.rate) else f"{each.verdict} ({each.rate:.2g})"


def _identifiable(console: Console, flight: Flight, stretch: Stretch, airframe: Airframe) -> dict[str, Any]:
    """What the body rates of a stretch tell of alpha_1..8, at the gyro's noise."""
    stretch = Stretch(stretch.begin, min(stretch.end, stretch.begin + LONGEST))
    part, model = cut(flight, stretch), CorrectedOS4(airframe)
    sigma = np.asarray(SENSOR_SIGMA, dtype=float).copy()
    for each, name in zip(excitation(part), RATES, strict=True):
        column = STATE_NAMES.index(name)
        sigma[column] = max(float(np.nan_to_num(each.noise)), sigma[column])
    windows = min(max(round(stretch.length / WINDOW), 1), part.time.shape[0] // 2)
    problem = ShootingProblem(model, part, sigma=sigma, channels="rates", windows=windows)
    known = identifiability(problem, Bracket.default(model), model.alpha)
    names, notes = model.parameter_names, known.notes(model.parameter_names)
    noise = {name: float(sigma[STATE_NAMES.index(name)]) for name in RATES}
    _print_identifiable(console, stretch, noise, known, names, notes)
    return {
        "begin": stretch.begin,
        "end": stretch.end,
        "sigma": noise,
        "parameters": {
            name: {
                "airframe": float(model.alpha[i]),
                "bound": finite(known.std[i]),
                "unit": model.parameter_units[i],
                "note": notes.get(name, ""),
            }
            for i, name in enumerate(names)
        },
    }


def _print_identifiable(
    console: Console,
    stretch: Stretch,
    noise: dict[str, float],
    known: Identifiability,
    names: tuple[str, ...],
    notes: dict[str, str],
) -> None:
    levels = ", ".join(f"{name} {level:.2g}" for name, level in noise.items())
    console.print(
        f"from the rates of {stretch.begin:.2f} to {stretch.end:.2f} s, corrected model, noise [rad/s] {levels} (the "
        f"gyro's, or {SENSOR_SIGMA[STATE_NAMES.index('p')]:g} where that is less); a vehicle that does what the model "
        "lacks tells less:",
        markup=False,
        highlight=False,
    )
    told = []
    for i, name in enumerate(names):
        nominal, std = abs(float(known.nominal[i])), float(known.std[i])
        if name not in notes:
            told.append(f"{name} to {100 * std / nominal:.2g} %" if nominal > 3 * std else f"{name} to {std:.2g}")
    console.print(f"  identifiable: {', '.join(told) or 'nothing'}", highlight=False)
    for name, note in notes.items():
        console.print(f"  {name}: {note}", highlight=False)
