"""The page of an identified vehicle or OS4, which needs no other file, and its figures: `jaxos4 estimate --report`."""

import json
import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MultipleLocator

from .._files import check_writable, write_file
from ..airframe import Airframe
from ..analysis.frequency_response import HIGHEST, FrequencyResponse
from ..analysis.inertia import CenterOfMass
from ..errors import printable
from ..identification.physical import centers_of_mass, physical_quantities
from ..identification.results import Constant, Identification, SampleTime
from ..identification.verdict import IDENTIFIED, RIGID_BODY, STATUSES, headline, reasons
from ..results import NINETY_FIVE, meaning
from .html import draw, render
from .identification_figures import (
    GAINS,
    INERTIAS,
    correlation_matrix,
    draw_response,
    gain_band,
    path_in_space,
    priors,
    residual_figure,
    strongest,
)
from .style import BOUND_DASHES, FAINT, INK, PAPER, Style, drawing, grid, label, styles, ticks_at
from .terminal import quantity_rows
from .text import MISSING, plain
from .timeline import BAND, identified_signals

# The page shows these entries of the provenance in a place of their own.
_ELSEWHERE = ("command", "notes")
_MARGINS = {"left": 0.06, "right": 0.99, "top": 0.94, "bottom": 0.12, "wspace": 0.2, "hspace": 0.6}


def write_flight_page(path: str | os.PathLike[str], found: Identification, *, title: str = "") -> None:
    """Writes the page of an identification, completely or not at all. Raises `OSError`.

    `title`: by default the names of the logs.
    """
    check_writable(path)
    look, used = styles([found.estimator])[found.estimator], found.provenance
    center = centers_of_mass(found)
    with drawing():
        figures = {"vehicle": vehicle(found.airframe, found.rigid_body.constants, center, look)}
        if found.sample_times:
            figures["sample-times"] = inertias_by_sample_time(found.sample_times, used.sample_time, look)
        if found.response is not None:
            figures["response"] = frequency_responses(found.response, look)
        if (figure := priors(found, look)) is not None:
            figures["priors"] = figure
        if found.correlations is not None:
            figures["residuals"] = residual_figure(found.correlations)
        if found.traces is not None and np.isfinite(found.traces.position).any():
            figures["path"] = path_in_space(found.traces, look)
        for figure in figures.values():
            # The page shows each panel by itself. To fit all labels exactly would take a third of the time.
            figure.set_layout_engine(None)
            figure.subplots_adjust(**_MARGINS)
        drawings = {name: draw(figure, name) for name, figure in figures.items()}
    text = render(
        "identification.html.j2",
        title=title or ", ".join(printable(Path(name).name) for name in found.logs),
        found=found,
        verdict=verdict(found),
        headline=headline(found.verdicts, found.doubts),
        center=[f"{x.axis} {plain(1e3 * x.value)} ± {plain(NINETY_FIVE * (1e3 * x.std), 2)} mm" for x in center],
        quantities=quantities(found),
        signals=identified_signals(found, look),
        band=f"{100 * BAND:g}",
        matrix=None if found.covariance is None or len(found.covariance) < 2 else correlation_matrix(found),
        strongest=[] if found.covariance is None else strongest(found),
        drawings=drawings,
        command=used.command or "",
        notes=[*used.notes, *filter(None, [found.motor_clock])],
        provenance=[
            (name.replace("_", " "), _text(x))
            for name, x in msgspec.to_builtins(used).items()
            if name not in _ELSEWHERE
        ],
    )
    write_file(path, text)


def quantities(found: Identification) -> list[tuple[tuple[str, ...], str]]:
    """The cells of each quantity, and of each moment of inertia even if it was not identified; and a note on each."""
    every, rows = physical_quantities(found), []
    for row, cells, note in zip(every, *quantity_rows(every), strict=True):
        own = found.parameters.get(row.name.replace(" ", "_"))
        small = row.judged == RIGID_BODY and abs(row.value) <= NINETY_FIVE * row.std
        causes = row.verdict.reasons if row.verdict is not None and row.name == row.judged else ()
        said = dict.fromkeys([note, "" if own is None else own.note, "below noise" if small else "", *causes])
        rows.append((cells, "; ".join(filter(None, said))))
    listed = {cells[0] for cells, _ in rows}
    for name in INERTIAS:
        if name in found.verdicts and name not in listed:
            why = found.verdicts[name]
            rows.append(((name, MISSING, "", "kg m^2"), "; ".join((why.status, *why.reasons))))
    return sorted(rows, key=lambda row: INERTIAS.index(row[0][0]) if row[0][0] in INERTIAS else len(INERTIAS))


def identification_html(found: Identification) -> str:
    """Verdict, physical quantities and reservations, for a notebook."""
    rows = zip(*quantity_rows(physical_quantities(found)), strict=True)
    lines = [*reasons(found.verdicts, found.doubts), *(f"note: {note}" for note in found.provenance.notes)]
    return render("summary.html.j2", verdict=verdict(found), rows=list(rows), lines=lines)


def verdict(found: Identification) -> str:
    """Whether to trust the identification, in one sentence. The page shows the verdicts below it."""
    if not found.has_answer:
        return f"There is no answer: {meaning(found.result)}."
    if found.successful:
        named = {each.status for each in found.verdicts.values() if each.trusted}
        said = (
            f"{status}: {_joined(name for name, each in found.verdicts.items() if each.status == status)}"
            for status in sorted(named, key=STATUSES.index)
        )
        return f"What was asked is {'; '.join(said) or IDENTIFIED}."
    refused = _joined(f"{name} is {each.status}" for name, each in found.verdicts.items() if not each.trusted)
    return f"Not to be trusted: {refused or meaning(found.result)}."


def _joined(words: Iterable[str]) -> str:
    *first, last = [*words] or [""]
    return f"{', '.join(first)} and {last}" if first else last


def _text(x: Any) -> str:
    return x if isinstance(x, str) else MISSING if x is None else json.dumps(x, ensure_ascii=False)


def vehicle(airframe: Airframe, constants: dict[str, Constant], center: Sequence[CenterOfMass], look: Style) -> Figure:
    """The vehicle as it was identified: left from above, front up, right its moments of inertia with 95 % intervals."""
    figure, (above, bars) = grid(2, columns=2, height=3.4)
    positions = 1e3 * np.asarray(airframe.rotor_positions, dtype=float)
    (x, y), distances = positions.T, np.linalg.norm(positions[:, None] - positions, axis=2)
    radius = 0.42 * distances[distances > 0].min()
    for i, spin in enumerate(np.asarray(airframe.rotor_spins)):
        end = 1 - 0.25 * radius / max(math.hypot(x[i], y[i]), radius)  # leaves room for the number
        above.plot([0, -end * y[i]], [0, end * x[i]], color=FAINT, linewidth=3, zorder=1)
        above.add_patch(Circle((-y[i], x[i]), radius, facecolor=PAPER, edgecolor=INK, linewidth=1.1))
        turn = np.radians(np.linspace(200, 200 + 280 * spin, 60))
        arc = 0.72 * radius * np.stack([np.cos(turn), np.sin(turn)], axis=1) + [-y[i], x[i]]
        above.plot(*arc.T, color=look.color, linewidth=1.2)
        above.annotate("", arc[-1], arc[-6], arrowprops={"arrowstyle": "-|>", "color": look.color, "shrinkA": 0})
        above.text(-y[i], x[i], f"{i + 1}", ha="center", va="center", fontsize=10, fontweight="bold")
    place = {each.axis: (1e3 * each.value, 1e3 * NINETY_FIVE * each.std) for each in center}
    (cx, ex), (cy, ey) = (place.get(axis, (0.0, 0.0)) for axis in "xy")
    above.errorbar(-cy, cx, xerr=ey or None, yerr=ex or None, color=INK, marker="P", markersize=6, capsize=2, zorder=4)
    above.margins(0.08)
    above.set_aspect("equal", adjustable="datalim")
    above.set_title("from above [mm], front up")
    for row, (name, given) in enumerate(zip(INERTIAS, np.asarray(airframe.inertia, dtype=float), strict=True)):
        bars.plot([given, given], [row - 0.36, row + 0.36], color=INK, linewidth=1.4, linestyle=BOUND_DASHES[2])
        if name not in constants:
            bars.text(0, row, "  not identified", va="center")
            continue
        value, half = constants[name].estimate, NINETY_FIVE * constants[name].std
        bars.barh(row, value, height=0.5, color=look.color, alpha=0.35)
        bars.errorbar(value, row, xerr=half, color=look.color, capsize=4, marker=look.marker)
    bars.set_yticks(range(3), INERTIAS)
    bars.tick_params(axis="y", length=0, pad=8)
    bars.set_ylim(2.6, -0.6)
    bars.set_xlim(left=0)
    bars.grid(axis="y", visible=False)
    bars.set_title("moments of inertia [kg m²], 95 %")
    return figure


def frequency_responses(found: FrequencyResponse, look: Style) -> Figure:
    """Gain, phase and coherence of each axis with 95 % bands, faint where they are not clear; dashed: the model."""
    figure, panels = grid(9, columns=3, height=1.9)
    top = min(HIGHEST, max(float(axis.frequency[-1]) if axis.frequency.size else 1.0 for axis in found))
    for row, (name, axis) in enumerate(found._asdict().items()):
        gain, phase, coherence = panels[3 * row : 3 * row + 3]
        degrees, spread = np.degrees(axis.phase), np.degrees(np.minimum(axis.half_width, math.pi))
        draw_response(gain, axis, axis.gain, gain_band(axis), 1.0, look.color)
        draw_response(phase, axis, degrees, np.array([degrees - spread, degrees + spread]), 0.0, look.color)
        coherence.plot(axis.frequency, axis.coherence, color=look.color)
        gain.set_yscale("log")
        gain.set_ylim(GAINS)
        ticks_at(gain.yaxis, (0.2, 0.5, 1, 2, 5))
        phase.set_ylim(-180, 180)
        phase.yaxis.set_major_locator(MultipleLocator(90))
        coherence.set_ylim(0, 1.03)
        for panel, title in ((gain, "gain"), (phase, "phase [degrees]"), (coherence, "coherence")):
            panel.set_title(f"{name}: {title}")
            panel.set_xscale("log")
            panel.set_xlim(1.0, top)
            ticks_at(panel.xaxis, (1, 2, 5, 10, 20, 40))
    label(figure, x="frequency [Hz]")
    return figure


def inertias_by_sample_time(answers: Sequence[SampleTime], chosen: float, look: Style) -> Figure:
    """Ix, Iy, Iz at each sample time with 95 % intervals. Lines: the `chosen` one [s], and its moments of inertia."""
    figure, panels = grid(3, columns=3, height=2.4)
    ticks = [1e3 * each.sample_time for each in answers]
    for panel, name in zip(panels, INERTIAS, strict=True):
        rows = {each.sample_time: each.constants[name] for each in answers if name in each.constants}
        for sample_time, row in rows.items():
            if math.isclose(sample_time, chosen):
                panel.axhline(row.estimate, color=FAINT, linewidth=0.9, linestyle=BOUND_DASHES[2])
        times, values = [1e3 * sample_time for sample_time in rows], [row.estimate for row in rows.values()]
        errors = [NINETY_FIVE * row.std for row in rows.values()]
        panel.errorbar(times, values, yerr=errors, markersize=4, capsize=3, **look.line)
        panel.axvline(1e3 * chosen, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[1])
        panel.set_title(f"{name} [kg m²]" if rows else f"{name}: not identified")
        panel.set_xscale("log")
        panel.set_xlim(0.8 * ticks[0], 1.25 * ticks[-1])
        ticks_at(panel.xaxis, ticks)
    label(figure, x="sample time [ms]")
    return figure
