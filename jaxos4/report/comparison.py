"""A comparison of results: its text for a terminal, and its page, which needs no other file."""

import math
import os
from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.console import Console

from .._files import check_writable, write_file
from ..comparison import ComparedQuantity, Comparison
from .html import draw, render
from .style import FAINT, INK, Style, drawing, grid, style
from .text import DASH, Listing, plain, say


def print_comparison(console: Console, found: Comparison) -> None:
    """Prints whether the results agree, the pooled value of each quantity, and each result's inertias.

    Other quantities are listed result by result if the results differ in them.
    """
    say(console, agreement(found))
    count, rows = len(found.names), []
    for each in found.quantities:
        low, high = map(plain, each.ci95)
        p = DASH if math.isnan(each.p) else "differ" if each in found.different else "agree"
        interval = DASH if math.isnan(each.value) else f"{low} to {high}"
        unit = "" if each.unit == "1" else each.unit
        rows.append((each.name, f"{sum(each.used)} of {count}", plain(each.value), interval, unit, plain(each.p, 2), p))
    headings = ("quantity", "results", "pooled", "95 % interval", "unit", "p", "")
    Listing(headings, rows, ("results", "pooled", "p")).print_on(console)
    shown = [each for each in found.quantities if each.unit == "kg m^2" or each in found.different]
    for each in shown:
        rows = list(quantity_cells(found, each))
        headings = (f"{each.name} [{each.unit}]", "estimate", "95 % interval")
        Listing(headings, [row[:-1] for row in rows], ("estimate",), [row[-1] for row in rows]).print_on(console)
    for note in found.notes:
        say(console, f"note: {note}")
    say(
        console,
        "p: the probability that results of one value scatter this much or more. Agreement says nothing about what all "
        "results share: mass, arms, and the model.",
    )


def agreement(found: Comparison) -> str:
    """Whether the results agree, in one sentence."""
    tested, different = found.tested, found.different
    if not tested:
        return "Nothing can be compared: no quantity is identified in two results."
    if not different:
        return f"The results agree in all {len(tested)} quantities that are identified in two results or more."
    which = ", ".join(f"{each.name} (p = {plain(each.p, 2)})" for each in different)
    return f"The results differ by more than chance in {len(different)} of {len(tested)} quantities: {which}."


def quantity_cells(found: Comparison, each: ComparedQuantity) -> Iterator[tuple[str, str, str, str]]:
    """The name of each result, its estimate, its interval, and why it does not count."""
    for name, answer, used in zip(found.names, each.answers, each.used, strict=True):
        if answer is None:
            yield name, DASH, "", "not estimated"
            continue
        low, high = map(plain, answer.ci95)
        status = "" if used else answer.verdict.status if answer.verdict and not answer.trusted else "no interval"
        yield name, plain(answer.value), f"{low} to {high}", f"not counted: {status}" if status else ""


def forest(found: Comparison, look: Style) -> Figure:
    """The 95 % intervals of each quantity by result, from top to bottom; band: pooled; grey, hollow: does not count."""
    count = len(found.names)
    figure, panels = grid(len(found.quantities), columns=3, height=0.9 + 0.19 * count)
    for panel, each in zip(panels, found.quantities, strict=True):
        ends = [end for row, used in zip(each.answers, each.used, strict=True) if row and used for end in row.ci95]
        ends = ends or [end for row in each.answers if row for end in row.ci95]
        low, high = min(ends), max(ends)
        room = max(high - low, 1e-9 * max(abs(low), abs(high)), 1e-300)
        # Answers that do not count may reach far; the figure shows twice the room of those that do.
        panel.set_xlim(low - room / 2, high + room / 2)
        if math.isfinite(each.value):
            panel.axvspan(*each.ci95, color=look.color, alpha=0.18, linewidth=0)
            panel.axvline(each.value, color=look.color, linewidth=1.1)
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
    if found.quantities:
        with drawing():
            figures = [draw(forest(found, style(0)), "forest")]
    write_file(
        path,
        render(
            "comparison.html.j2",
            title=f"{len(found.names)} results compared",
            found=found,
            figures=figures,
            agreement=agreement(found),
            rows=[(each, list(quantity_cells(found, each))) for each in found.quantities],
            isfinite=np.isfinite,
            command=command,
            notes=found.notes,
            provenance=[(f"result {place}", name) for place, name in enumerate(found.names, start=1)],
        ),
    )
