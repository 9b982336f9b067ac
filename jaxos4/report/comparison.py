"""A comparison of results: its text for a terminal, and its page, which needs no other file."""

import math
import os
from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.console import Console

from .._files import check_writable, write_file
from ..airframe import INERTIAS
from ..comparison import ComparedQuantity, Comparison
from ..identification.verdict import ADVICE, RESERVED, STATUSES, headline
from .html import draw, render
from .style import BOUND_DASHES, FAINT, INK, Style, drawing, grid, style
from .text import DASH, Listing, plain, say


def print_comparison(console: Console, found: Comparison) -> None:
    """Prints the verdict on each mean, whether the results agree, the means, each result's inertias, what to fly next.

    Other quantities are listed result by result if the results differ in them.
    """
    for sentence in headline(found.statuses).values():
        say(console, sentence)
    say(console, agreement(found))
    count, rows = len(found.names), []
    for each in found.quantities:
        low, high = map(plain, each.ci95)
        interval = DASH if math.isnan(each.value) else f"{low} to {high}"
        unit = "" if each.unit == "1" else each.unit
        rows.append(
            (
                each.name,
                f"{sum(each.used)} of {count}",
                plain(each.value),
                interval,
                unit,
                plain(each.p, 2),
                *judged(found, each),
            )
        )
    headings = ("quantity", "results", "pooled", "95 % interval", "unit", "p", "results", "pooled value")
    Listing(headings, rows, ("results", "pooled", "p")).print_on(console)
    shown = [each for each in found.quantities if each.unit == "kg m^2" or each in found.different]
    for each in shown:
        rows = list(quantity_cells(found, each))
        headings = (f"{each.name} [{each.unit}]", "estimate", "95 % interval")
        Listing(headings, [row[:-1] for row in rows], ("estimate",), [row[-1] for row in rows]).print_on(console)
    for place, (name, flights) in enumerate(zip(found.names, found.flights, strict=True), start=1):
        say(console, f"result {place}: {name}, of {flights}")
    of_inertias = [reason for reason in found.reasons if reason.startswith(INERTIAS)]
    for reason in of_inertias:
        say(console, f"{reason}.")
    if len(of_inertias) < len(found.reasons):
        say(console, f"{len(found.reasons) - len(of_inertias)} reasons about other quantities: on the page of --report")
    for note in found.notes:
        say(console, f"note: {note}")
    say(console, f"p: the probability that results of one value scatter this much or more. {SHARED}")
    say(console, found.next_flight)


SHARED = "A wrong mass or arm length is wrong in all results and does not show."


def judged(found: Comparison, each: ComparedQuantity) -> tuple[str, str]:
    """Whether the results agree in a quantity, and whether to use its pooled value."""
    differs = each in found.different
    status = max(each.status, RESERVED, key=STATUSES.index) if differs else each.status
    return "differ" if differs else "agree" if math.isfinite(each.p) else "", ADVICE[status]


def agreement(found: Comparison) -> str:
    """Whether the results agree, in one sentence."""
    tested, different = found.tested, found.different
    if not tested:
        return "Nothing can be compared: no two results have a quantity that can be trusted."
    if not different:
        return (
            f"The results agree within their intervals in all {len(tested)} quantities that two results or more have."
        )
    which = ", ".join(f"{each.name} (p = {plain(each.p, 2)})" for each in different)
    return f"The results differ by more than chance in {len(different)} of {len(tested)} quantities: {which}."


def quantity_cells(found: Comparison, each: ComparedQuantity) -> Iterator[tuple[str, str, str, str]]:
    """The name of each result, its estimate, its interval, and whether it counts; then the airframe file's value."""
    for name, answer, used in zip(found.names, each.answers, each.used, strict=True):
        if answer is None:
            yield name, DASH, "", "not estimated"
            continue
        low, high = map(plain, answer.ci95)
        status = "" if answer.verdict is None else ADVICE[answer.verdict.status]
        said = status if used or not answer.trusted else "no interval"
        yield name, plain(answer.value), f"{low} to {high}", said if used else f"not counted: {said}"
    if math.isfinite(each.reference):
        yield "airframe's file", plain(each.reference), "", ""


def forest(found: Comparison, look: Style) -> Figure:
    """The 95 % intervals of each quantity by result, from top to bottom; band: pooled; grey, hollow: does not count.

    Dashed: the value in the airframe's file.
    """
    count, drawn = len(found.names), [each for each in found.quantities if any(each.answers)]
    figure, panels = grid(len(drawn), columns=3, height=0.9 + 0.19 * count)
    for panel, each in zip(panels, drawn, strict=True):
        ends = [end for row, used in zip(each.answers, each.used, strict=True) if row and used for end in row.ci95]
        ends = ends or [end for row in each.answers if row for end in row.ci95]
        low, high = min(ends), max(ends)
        room = max(high - low, 1e-9 * max(abs(low), abs(high)), 1e-300)
        # Answers that do not count may reach far; the figure shows twice the room of those that do.
        panel.set_xlim(low - room / 2, high + room / 2)
        if math.isfinite(each.value):
            panel.axvspan(*each.ci95, color=look.color, alpha=0.18, linewidth=0)
            panel.axvline(each.value, color=look.color, linewidth=1.1)
        if low - room / 2 < each.reference < high + room / 2:
            panel.axvline(each.reference, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[2])
        for place, (row, used) in enumerate(zip(each.answers, each.used, strict=True)):
            if row is not None:
                color = INK if used else FAINT
                panel.plot(row.ci95, [place, place], color=color, linewidth=1.4 if used else 0.9)
                panel.plot([row.value], [place], "o", color=color, markersize=4, fillstyle="full" if used else "none")
        panel.set_yticks(range(count), [f"{place + 1}" for place in range(count)])
        panel.set_ylim(count - 0.4, -0.6)
        panel.grid(axis="y", visible=False)
        panel.xaxis.set_major_locator(MaxNLocator(4))
        unit = "" if each.unit == "1" else f" [{each.unit}]"
        panel.set_title(f"{each.name}{unit}{': differ' if each in found.different else ''}")
    return figure


def write_comparison(path: str | os.PathLike[str], found: Comparison, *, command: str = "") -> None:
    """Writes the page of a comparison, completely or not at all. `command`: that makes it again. Raises `OSError`."""
    check_writable(path)
    figures = []
    if any(any(each.answers) for each in found.quantities):
        with drawing():
            figures = [draw(forest(found, style(0)), "forest")]
    write_file(
        path,
        render(
            "comparison.html.j2",
            title=f"{len(found.names)} results compared",
            found=found,
            figures=figures,
            headline=" ".join(headline(found.statuses).values()),
            agreement=agreement(found),
            rows=[(each, judged(found, each), list(quantity_cells(found, each))) for each in found.quantities],
            shared=SHARED,
            isfinite=np.isfinite,
            command=command,
            notes=found.notes,
            provenance=[(f"result {place}", name) for place, name in enumerate(found.names, start=1)],
        ),
    )
