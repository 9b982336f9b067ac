"""A comparison of results: its text for a terminal, and its page, which needs no other file."""

import math
import os
from collections.abc import Iterator

from markupsafe import Markup
from rich.console import Console

from ..airframe import INERTIAS
from ..comparison import ComparedQuantity, Comparison
from ..errors import counted
from ..identification.verdict import ADVICE, RESERVED, STATUSES, headline
from .page import Section, folded, picture, table, text, write_page
from .panels import BOUND_DASHES, EVERYWHERE, FAINT, INK, Band, Figure, Line, Panel, Scale, Style, across, style
from .text import DASH, Listing, plain, say, span, with_unit


def print_comparison(console: Console, found: Comparison) -> None:
    """Prints the verdict on each mean, whether the results agree, the means, each result's inertias, what to fly next.

    Other quantities are listed result by result if the results differ in them.
    """
    for sentence in headline(found.statuses).values():
        say(console, sentence)
    say(console, agreement(found))
    count, rows = len(found.names), []
    for each in found.quantities:
        interval, unit = DASH if math.isnan(each.value) else span(each.ci95, 3), "" if each.unit == "1" else each.unit
        values = f"{sum(each.used)} of {count}", plain(each.value), interval, unit, plain(each.p, 2)
        rows.append((each.name, *values, *judged(found, each)))
    headings = ("quantity", "used", "pooled", "95 % interval", "unit", "p", "agreement", "pooled value")
    Listing(headings, rows, ("used", "pooled", "p")).print_on(console)
    shown = [each for each in found.quantities if each.unit == "kg m^2" or each in found.different]
    for each in shown:
        rows = list(quantity_cells(found, each))
        headings = (with_unit(each.name, each.unit), "estimate", "95 % interval", "note")
        Listing(headings, rows, ("estimate",)).print_on(console)
    for place, (name, flights) in enumerate(zip(found.names, found.flights, strict=True), start=1):
        say(console, f"result {place}: {name}, of {flights}")
    of_inertias = [reason for reason in found.reasons if reason.startswith(INERTIAS)]
    for reason in of_inertias:
        say(console, f"{reason}.")
    if len(of_inertias) < len(found.reasons):
        others = counted(len(found.reasons) - len(of_inertias), "reason")
        say(console, f"{others} about other quantities: on the page of --report")
    for note in found.notes:
        say(console, f"note: {note}")
    say(console, f"p: the probability that results of one value scatter this much or more. {SHARED}")
    say(console, f"next: {found.next_flight}")


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
        status = "" if answer.verdict is None else ADVICE[answer.verdict.status]
        said = status if used or not answer.trusted else "no interval"
        yield name, plain(answer.value), span(answer.ci95, 3), said if used else f"not counted: {said}"
    if math.isfinite(each.reference):
        yield "airframe's file", plain(each.reference), "", ""


def forest(found: Comparison, look: Style) -> Figure:
    """The 95 % intervals of each quantity by result, from top to bottom; band: pooled; grey, hollow: does not count.

    Dashed: the value in the airframe's file.
    """
    count, panels = len(found.names), []
    y = Scale(ends=(count - 0.4, -0.6), ticks={place: f"{place + 1}" for place in range(count)}, lines=False)
    for each in found.quantities:
        ends = [end for row, used in zip(each.answers, each.used, strict=True) if row and used for end in row.ci95]
        ends = ends or [end for row in each.answers if row for end in row.ci95]
        if not ends:
            continue
        low, high = min(ends), max(ends)
        room = max(high - low, 1e-9 * max(abs(low), abs(high)), 1e-300)
        # Answers that do not count may reach far; the figure shows twice the room of those that do.
        x, marks = Scale(ends=(low - room / 2, high + room / 2)), []
        if math.isfinite(each.value):
            marks += [Band(each.ci95, 2 * [-math.inf], 2 * [math.inf], look.color, 0.18, name="pooled, 95 %")]
            marks += [Line(2 * [each.value], EVERYWHERE, look.color, 1.4)]
        if low - room / 2 < each.reference < high + room / 2:
            marks += [Line(2 * [each.reference], EVERYWHERE, width=1.2, dash=BOUND_DASHES[2], name="airframe's file")]
        for place, (row, used) in enumerate(zip(each.answers, each.used, strict=True)):
            if row is not None:
                color, name = (INK, "95 % interval") if used else (FAINT, "refused by a verdict: does not count")
                marks += [across([place], *([end] for end in row.ci95), color=color, width=1.8 if used else 1.2)]
                marks += [Line([row.value], [place], color, 0, marker="o", size=6, hollow=not used)]
                marks += [Line([], [], color, 1.8, marker="o", hollow=not used, name=name)]
        title = with_unit(each.name, each.unit) + ": differ" * (each in found.different)
        panels.append(Panel(title, marks, x, y, height=70 + 20 * count))
    return Figure("forest", panels)


def write_comparison(path: str | os.PathLike[str], found: Comparison, *, command: str = "") -> None:
    """Writes the page of a comparison, completely or not at all. `command`: that makes it again. Raises `OSError`."""
    said = f"{' '.join(headline(found.statuses).values())} {agreement(found)}"
    top = [text(said, f"verdict{' warning' if found.different else ''}")]
    if found.reasons:
        lines = text([f"{line}." for line in found.reasons])
        top.append(folded(counted(len(found.reasons), "reason"), lines, id="reasons"))
    top.append(text([f"{note}." for note in found.notes], id="notes"))
    top.append(text(f"Next: {found.next_flight}", id="next"))
    write_page(
        path,
        title=f"{len(found.names)} results compared",
        about=f"The same quantities in {len(found.names)} results, each with its 95 % interval; whether the results "
        "agree, and their pooled value.",
        top=top,
        sections=[
            Section("forest", "Each quantity in each result", _forest(found), "Figure"),
            Section("pooled", "Pooled values", [_pooled(found)], "Pooled"),
            Section("each", "Each result", [_each(found)], "Each result"),
        ],
        command=command,
        provenance=[(f"result {place}", name) for place, name in enumerate(found.names, start=1)],
    )


def _forest(found: Comparison) -> list[Markup]:
    if not any(any(each.answers) for each in found.quantities):
        return []
    of = enumerate(zip(found.names, found.flights, strict=True), start=1)
    caption = f"{'; '.join(f'{place}: {name}, of {flights}' for place, (name, flights) in of)}."
    return [picture(forest(found, style(0)), f"Each quantity in each result, with 95 % intervals. {caption}")]


def _pooled(found: Comparison) -> Markup:
    rows = []
    for each in found.quantities:
        ends = span(each.ci95) if math.isfinite(each.value) else ""
        used = f"{sum(each.used)} of {len(found.names)}"
        tested = plain(each.chi2), plain(each.p, 2)
        rows.append((each.name, each.unit, used, plain(each.value, 4), ends, *tested, *judged(found, each)))
    note = (
        "The mean of the results that count, weighted by 1 / variance. p: the probability that results of one value "
        "scatter this much or more (chi-squared). If they scatter more than their intervals say, the pooled interval "
        "is widened to fit. All quantities are tested together: one of them is said to differ by chance in "
        f"{100 * found.level:g} % of comparisons. {SHARED}"
    )
    headings = ("quantity", "unit", "used", "pooled", "95 % interval", "chi²", "p", "agreement", "pooled value")
    return table("pooled-table", "Pooled value of each quantity", headings, rows, [note])


def _each(found: Comparison) -> Markup:
    rows: list[str | tuple[str, ...]] = []
    for each in found.quantities:
        rows += [with_unit(each.name, each.unit), *quantity_cells(found, each)]
    return table("each-table", "Each quantity in each result", ("result", "estimate", "95 % interval", "note"), rows)
