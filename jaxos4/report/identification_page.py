"""The page of an identified vehicle or OS4, which needs no other file: `jaxos4 estimate --report`."""

import json
import os
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from .._files import check_writable, write_file
from ..airframe import INERTIAS
from ..errors import printable
from ..identification.next_flight import next_flight, spreads_of
from ..identification.physical import centers_of_mass, physical_quantities
from ..identification.results import Identification
from ..identification.verdict import headline, statuses_of
from ..results import NINETY_FIVE, meaning
from .html import draw, render
from .identification_figures import (
    correlation_matrix,
    frequency_responses,
    inertias_by_sample_time,
    path_in_space,
    priors,
    residual_figure,
    strongest,
    vehicle,
)
from .identification_signals import BAND, identified_signals
from .style import drawing, styles
from .terminal import quantity_rows, warning_lines, why_no_value
from .text import DASH, plain

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
        verdict_lines=warning_lines(found),
        next_flight="".join(_next(found)),
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
        said = dict.fromkeys([note, "" if own is None else own.note])
        rows.append((cells, "; ".join(filter(None, said))))
    listed = {cells[0] for cells, _ in rows}
    for name, row in {} if found.is_vehicle else found.rigid_body.constants.items():
        if name not in listed:  # a J_R of -3 kg m^2 would be read as a value
            half = NINETY_FIVE * row.std
            interval = f"{row.estimate - half:.4g} to {row.estimate + half:.4g}"
            rows.append(((name, DASH, interval, row.unit), why_no_value(row)))
    for name in INERTIAS:
        if name in found.verdicts and name not in listed:
            rows.append(((name, DASH, "", "kg m^2"), found.verdicts[name].status))
    return sorted(rows, key=lambda row: INERTIAS.index(row[0][0]) if row[0][0] in INERTIAS else len(INERTIAS))


def identification_html(found: Identification) -> str:
    """Verdict, physical quantities and reservations, for a notebook."""
    rows = zip(*quantity_rows(physical_quantities(found)), strict=True)
    lines = [*warning_lines(found), *(f"note: {note}" for note in found.provenance.notes), *_next(found)]
    return render("summary.html.j2", verdict=verdict(found), rows=list(rows), lines=lines)


def _next(found: Identification) -> list[str]:
    return [next_flight([found], spreads_of(found))] if found.verdicts and found.has_answer else []


def verdict(found: Identification) -> str:
    """Whether to trust the quantities, in a sentence for each status. The page shows the reasons below it."""
    if not found.has_answer:
        return f"There is no answer: {meaning(found.result)}."
    if found.verdicts:
        return " ".join(headline(statuses_of(found.verdicts)).values())
    return "No quantity was judged." if found.successful else f"Not to be trusted: {meaning(found.result)}."


def _text(x: Any) -> str:
    return x if isinstance(x, str) else DASH if x is None else json.dumps(x, ensure_ascii=False)
