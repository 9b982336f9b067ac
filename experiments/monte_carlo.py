"""The loop of experiments that simulate, fit and count: rows in a JSON file that is continued, and their table."""

import json
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

import jaxos4
from experiments.published import RECORDER, Table as Published, commit
from jaxos4.results import NINETY_FIVE

Row = dict[str, Any]


def continued(out: Path | None, settings: Row, rows: str) -> Row:
    """A report with these settings and a list of `rows`: that of the file `out` if it exists, or a new one.

    Ends the script if the file has other settings.
    """
    settings = settings | {"version": jaxos4.__version__, "precision": str(jnp.result_type(float))}
    report = {**settings, "commits": [], rows: []}
    if out is not None and out.exists():
        report = json.loads(out.read_text())
        if rows not in report or {name: report.get(name) for name in settings} != settings:
            raise SystemExit(f"{out}: has other settings; give --out another name.")
    RECORDER.commit = ", ".join(report.get("commits", []))
    return report


def machine() -> Row:
    """What computes: versions, device, cores and precision."""
    device = jax.devices()[0].device_kind
    versions = {"version": jaxos4.__version__, "jax": jax.__version__}
    return versions | {"device": device, "cores": os.cpu_count(), "precision": str(jnp.result_type(float))}


def write_report(out: Path | None, report: Row) -> None:
    """Writes what there is of a report, if it has a file."""
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(report, indent=1) + "\n")


def find(rows: list[Row], known: Row) -> Row | None:
    """The row that has the entries of `known`."""
    return next((row for row in rows if all(row.get(name) == value for name, value in known.items())), None)


def fill(out: Path | None, report: Row, rows: list[Row], trials: Iterable[Row], row_of: Callable[..., Row]) -> None:
    """Adds to `rows`, a list in `report`, those of the trials that are not there yet; written after each.

    `trials`: the entries of a row by which it is known, such as `{"flight": 3}`; `row_of(**trial)` gives the others.
    """
    for trial in trials:
        if find(rows, trial) is None:
            rows.append(trial | row_of(**trial))
            if commit() not in report["commits"]:
                report["commits"].append(commit())
            write_report(out, report)
    RECORDER.commit = ", ".join(report["commits"])


def monte_carlo(
    out: Path | None,
    settings: Row,
    cases: Iterable[Row],
    flights_of: Callable[..., Sequence[Any]],
    row_of: Callable[..., Row],
    summary: Callable[[list[Row]], Row],
) -> Row:
    """The report of all cases, with a row for each flight and a summary; continued if `out` exists.

    **Arguments:**

    - `cases`: the entries by which each case is known, such as `{"estimator": "ibss"}`.
    - `flights_of(**case)`: the flights of a case; `None`: one that was lost.
    - `row_of(flight, i, **case)`: the row of flight number `i`, without this number.
    - `summary`: of the rows of a case.
    """
    report = continued(out, settings, "cases")
    for known in cases:
        case = find(report["cases"], known)
        if case is None:
            case = {**known, "flights": [], "summary": {}}
            report["cases"].append(case)
        flights = flights_of(**known)

        def row(flight: int, flights=flights, known=known) -> Row:
            return row_of(flights[flight], flight, **known)

        flown = ({"flight": i} for i, flight in enumerate(flights) if flight is not None)
        fill(out, report, case["flights"], flown, row)
        case["summary"] = summary(case["flights"])
        write_report(out, report)
    return report


def covered_error(covered: float, count: int) -> float:
    """The Monte-Carlo error of a share of covered intervals, as if at most 95 % were covered."""
    return float(np.sqrt(max(covered * (1 - covered), 0.05 * 0.95) / count))


def count_results(names: np.ndarray) -> dict[str, int]:
    """The number of estimates by result, from their `result_names`."""
    found, counts = np.unique(names, return_counts=True)
    return dict(zip(found.tolist(), counts.tolist(), strict=True))


def in_words(counts: dict[str, int]) -> str:
    """The counts of `count_results` as the text of a table cell."""
    return ", ".join(f"{count} {what}" for what, count in counts.items())


def interval(value: Row | None, scale: float, digits: str = "2f", error_digits: str = "2f") -> str:
    """An estimate with its 95 % interval as the text of a table cell; empty if there is none."""
    if value is None or value["estimate"] is None:
        return ""
    estimate, half_width = scale * value["estimate"], NINETY_FIVE * scale * value["std"]
    return f"{estimate:.{digits}} +- {half_width:.{error_digits}}"


def results_of(case: Row) -> str:
    """The results of a case's flights as the text of a table cell."""
    return in_words(count_results(np.array([row["result"] for row in case["flights"]])))


def print_table(
    title: str,
    headings: Sequence[str],
    rows: Iterable[Sequence[str]],
    width: int = 150,
    *,
    tables: list[Published] = RECORDER.tables,
) -> None:
    """Prints a table of this many columns of the terminal. Only the cells of `results` are of several lines.

    `tables`: gets the table too, to be published, see `published.py`.
    """
    rows = [list(map(str, row)) for row in rows]
    tables.append(Published(title, list(headings), rows))
    table = Table(title=escape(title))
    for heading in headings:
        table.add_column(escape(heading), no_wrap=heading != "results")
    for row in rows:
        table.add_row(*map(escape, row))
    Console(width=width).print(table)
