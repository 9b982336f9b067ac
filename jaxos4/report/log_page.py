"""The page of a log, before anything is fitted: `jaxos4 inspect --report`. It needs no other file."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float, Int
from matplotlib.figure import Figure

from .._files import check_writable, write_file
from ..airframe import MOTIONS, Airframe
from ..errors import InputError, printable
from ..flight import ANGLES, POSITION, RATES, STATE_NAMES, VELOCITY, Flight
from ..logs import Recording, Source, as_recording, read_recording
from ..logs.sampling import filled
from ..logs.table import counted
from ..recording.checks import Evidence
from ..recording.inspection import Inspection, inspect_log
from ..recording.prepared import prepare
from ..recording.stretches import Stretch, cut
from .html import draw, render
from .style import BOUND_DASHES, FAINT, INK, drawing, grid, label, log_axis, style
from .terminal import unit_of
from .timeline import Axis, Line, Panel, View, signals, spans, thinned


class PageRules(NamedTuple):
    """Sizes and limits of the page of a log.

    - `samples`: of each signal at most; a page then has less than 600 kB.
    - `parts`: rows of the table of parts at most, the longest parts.
    - `segment`: of which the spectra are means [s]. `slowest`: the lowest frequency of a spectrum [Hz].
    - `bins`: of the motors' speeds. `usual`: the share of the time in which the rotors' speeds lie in the
      band of the spectra.
    """

    samples: int = 5000
    parts: int = 60
    segment: float = 1.0
    slowest: float = 1.0
    bins: int = 60
    usual: float = 0.9


RULES = PageRules()
_SIGNALS = (
    ("rate [rad/s]", RATES, ("p", "q", "r")),
    ("force [m/s²]", np.arange(12, 15), ("ax", "ay", "az")),
    ("attitude [rad]", ANGLES, MOTIONS),
    ("velocity [m/s]", VELOCITY, ("vx", "vy", "vz")),
    ("position [m]", POSITION, ("x", "y", "z")),
)


def write_log_page(
    path: str | os.PathLike[str],
    log: Source,
    airframe: Airframe | None = None,
    *,
    found: Inspection | None = None,
    command: str = "",
    rules: PageRules = RULES,
) -> None:
    """Writes the page of a log, completely or not at all.

    - `log`: a recording, or the path of a log. `airframe`: of its vehicle; without it, torques are unknown.
    - `found`: of `inspect_log`, if it was computed before. `command`: that makes the page again.

    **Raises:** `OSError` if the page cannot be written; `InputError` if the log cannot be read.
    """
    check_writable(path)
    given = isinstance(log, Recording | Flight)
    recording = as_recording(log) if given else read_recording(log, airframe, full_scale=1.0)
    found = inspect_log(recording, airframe) if found is None else found
    full = 1.0 if is_share(recording) else float("inf") if airframe is None else float(airframe.max_rotor_speed)
    plausible = Evidence(recording, airframe).plausible.recording
    flown = [cut(plausible, Stretch(part.begin, part.end)) for part in found.parts if part.usable]
    band = None if is_share(recording) or not flown else rotor_band(flown, rules)
    with drawing():
        figures = {"motors": motors(flown, full, rules), "spectra": spectra(flown, band, rules)} if flown else {}
        drawings = {name: draw(figure, name) for name, figure in figures.items() if figure is not None}
    longest = sorted(found.parts, key=lambda part: part.begin - part.end)[: rules.parts]
    shown, block = logged(recording, found, rules)
    text = render(
        "log.html.j2",
        title=printable(Path(recording.name).name),
        found=msgspec.structs.replace(found, parts=tuple(sorted(longest, key=lambda part: part.begin))),
        shorter=len(found.parts) - len(longest),
        format=recording.facts.format.label if recording.facts.format else "recording",
        verdict=verdict(found),
        signals=shown,
        block=1e3 * recording.dt * block if block > 1 else None,
        fitted=fitted(recording, airframe),
        measured=[
            (name, unit_of(name, recording.commanded and full == 1), one) for name, one in found.measured.items()
        ],
        drawings=drawings,
        limited=np.isfinite(full),
        shares=is_share(recording),
        rotor_band=band,
        command=command,
        provenance=[("log", recording.name)],
    )
    write_file(path, text)


def verdict(found: Inspection) -> str:
    """The usable share of a log, and the axes that it excites, in one sentence."""
    used = [part for part in found.parts if part.usable]
    seconds = sum(part.end - part.begin for part in used)
    if not used:
        return "No part of this log can be used."
    rank = ("not measured", "none", "weak", "good")
    best = {axis: max((part.excitation[axis].verdict for part in used), key=rank.index) for axis in used[0].excitation}
    axes = ", ".join(f"{axis} {each}" for axis, each in best.items())
    parts = counted(len(used), "part")
    return f"{seconds:.1f} of {found.end - found.begin:.1f} s can be used, in {parts}; excitation: {axes}."


def is_share(recording: Recording) -> bool:
    """Whether the motors are commands as a share of full scale."""
    return recording.commanded and float(np.nanmax(recording.omega, initial=0.0)) <= 1.0


def logged(recording: Recording, found: Inspection, rules: PageRules = RULES) -> tuple[str, int]:
    """All signals of a log for the time axis, grey where it is not usable, and the `thinned` samples of a block."""
    panels, width = [], 0
    motor = ("command" if is_share(recording) else "motor [rad/s]", recording.omega, tuple("1234"))
    groups = [(title, _sensed(recording, which), names) for title, which, names in _SIGNALS]
    groups = [groups[0], motor, *groups[1:]]
    if recording.voltage is not None:
        groups.append(("battery [V]", recording.voltage[:, None], ("battery",)))
    groups = [group for group in groups if np.isfinite(group[1]).any()]
    every = [
        thinned(recording.time, bridged(recording.time, column)[:, None], rules.samples)
        for _, measured, _ in groups
        for column in measured.T
    ]
    time, _, block = every[0]
    values = np.hstack([fewer for _, fewer, _ in every])
    for title, _, names in groups:
        lines = (Line(name, values[:, width + i], style(i)) for i, name in enumerate(names))
        panels.append(Panel(title, [line for line in lines if np.isfinite(line.values).any()]))
        width += len(names)
    axis = Axis.of(recording.time[[0, -1]], np.zeros(2, int), longest=np.inf)
    begin = recording.time[0]
    shaded = [(part.begin - begin, part.end - begin) for part in found.parts if not part.usable]
    return signals(axis, [View("", time - begin, panels)], shaded=shaded), block


def _sensed(recording: Recording, which: Int[np.ndarray, " columns"]) -> Float[np.ndarray, "samples columns"]:
    """Some of the channels, without a copy of all."""
    states, force = recording.states, recording.specific_force
    if which[0] < len(STATE_NAMES):
        return states[:, which]
    return np.full((len(states), len(which)), np.nan) if force is None else force


def bridged(
    time: Float[np.ndarray, " samples"], values: Float[np.ndarray, " samples"], *, steps: float = 3.0
) -> Float[np.ndarray, " samples"]:
    """A signal with straight lines between its samples, unless they are apart by more than this many usual steps."""
    at = np.flatnonzero(np.isfinite(values))
    if at.size < 2 or at.size == values.size:
        return values
    apart = np.diff(time[at])
    place = np.clip(np.searchsorted(time[at], time, side="right") - 1, 0, at.size - 2)
    near = (apart[place] <= steps * np.median(apart)) & (time >= time[at[0]]) & (time <= time[at[-1]])
    return np.where(near | np.isfinite(values), np.interp(time, time[at], values[at]), np.nan)


def fitted(recording: Recording, airframe: Airframe | None) -> str:
    """The parts that `jaxos4 estimate` would fit and hold out, in words."""
    if airframe is None:
        return "Give the airframe (--airframe) to see here what would be fitted, and what held out."
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
    held = spans(ready.time, np.isfinite(np.asarray(ready.tested.states)[:, RATES[0]]))
    parts = ", ".join(f"{begin:.1f} to {end:.1f}" for begin, end in held[:8]) + ", ..." * (len(held) > 8)
    return f"{used}; {ready.seconds[1]:.1f} s would be held out and predicted: {parts} s."


def rotor_band(flown: Sequence[Recording], rules: PageRules = RULES) -> tuple[float, float]:
    """The usual frequencies of the rotors [Hz]: the ends of the band of most speeds."""
    speeds, beyond = np.concatenate([each.omega for each in flown]), (1 - rules.usual) / 2
    low, high = np.quantile(speeds, [beyond, 1 - beyond]) / (2 * np.pi)
    return float(low), float(high)


def motors(flown: Sequence[Recording], full: float, rules: PageRules = RULES) -> Figure:
    """The share of the time that each motor spends at each speed; dashed: full speed."""
    figure, panels = grid(4, columns=4, height=1.9)
    omega = np.concatenate([each.omega for each in flown])
    largest = float(omega.max())
    top = full if np.isfinite(full) and full < 3 * largest else largest
    edges = np.linspace(0.0, max(top, largest, 1e-9), rules.bins + 1)
    shares = [np.histogram(column, edges)[0] / len(omega) for column in omega.T]
    for i, (panel, share) in enumerate(zip(panels, shares, strict=True)):
        panel.fill_between(
            edges, np.append(100 * share, 0.0), step="post", color=style(i).color, alpha=0.3, linewidth=0
        )
        panel.step(edges, np.append(100 * share, 0.0), where="post", color=style(i).color, linewidth=1.1)
        if top == full:
            panel.axvline(full, color=INK, linewidth=1.1, linestyle=BOUND_DASHES[2])
        panel.set_title(f"motor {i + 1}: time [%]")
        panel.set_ylim(0, 105 * max(each.max() for each in shares))
    label(figure, x="command" if full == 1.0 else "speed [rad/s]")
    return figure


def spectra(flown: Sequence[Recording], band: tuple[float, float] | None, rules: PageRules = RULES) -> Figure | None:
    """Amplitude spectral densities of gyro and accelerometer; band: how often the rotors turn."""
    kinds = {"gyro [rad/s/√Hz]": RATES, "accelerometer [m/s²/√Hz]": np.arange(12, 15)}
    sensed = (np.hstack([_sensed(each, which) for which in kinds.values()]) for each in flown)
    frequency, whole = amplitude_density(sensed, flown[0].dt, rules)
    found = {title: whole[:, 3 * i : 3 * i + 3] for i, title in enumerate(kinds)}
    found = {title: density for title, density in found.items() if np.isfinite(density).any()}
    if not found:
        return None
    figure, panels = grid(len(found), columns=2, width=4.5 * len(found), height=2.6)
    for panel, (title, density) in zip(panels, found.items(), strict=True):
        for column, look, dash in zip(density.T, map(style, range(3)), (0, 2, 1), strict=True):
            panel.plot(frequency, column, color=look.color, linestyle=BOUND_DASHES[dash])
        if band is not None:
            panel.axvspan(*band, color=FAINT, alpha=0.25, linewidth=0)
        panel.set_title(title)
        panel.set_xlim(rules.slowest, frequency[-1])
        for which in ("x", "y"):
            log_axis(panel, which)
    label(figure, x="frequency [Hz]")
    return figure


def amplitude_density(
    parts: Iterable[Float[np.ndarray, "_ channels"]], dt: float, rules: PageRules = RULES
) -> tuple[Float[np.ndarray, " frequencies"], Float[np.ndarray, "frequencies channels"]]:
    """Frequencies [Hz] and the amplitude spectral density of signals, by Welch's means of overlapping segments.

    A channel has the mean over the segments in which it was measured, or NaN. Reference: Welch 1967, IEEE
    Trans. Audio Electroacoustics 15.
    """
    size = max(round(rules.segment / dt), 8)
    window, frequency = np.hanning(size)[:, None], np.fft.rfftfreq(size, dt)
    total = measured = np.zeros((frequency.size, 1))
    for part in parts:
        total, measured = (np.broadcast_to(each, (frequency.size, part.shape[1])).copy() for each in (total, measured))
        for begin in range(0, len(part) - size + 1, size // 2):
            piece = filled(part[begin : begin + size])
            power = np.abs(np.fft.rfft(window * (piece - piece.mean(axis=0)), axis=0)) ** 2
            measured += np.isfinite(power)
            total += np.nan_to_num(power)
    mean = np.where(measured, total / np.maximum(measured, 1), np.nan)
    density, kept = 2 * dt * mean / np.square(window).sum(), frequency >= rules.slowest
    return frequency[kept], np.sqrt(density[kept])
