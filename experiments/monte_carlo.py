"""The loop of experiments that simulate, fit and count: rows in a JSON file that is continued, and their table."""

import itertools
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
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
from jaxos4.errors import InputError
from jaxos4.results import NINETY_FIVE

Row = dict[str, Any]
LOST = "lost"  # the result of a vehicle that turned over: nobody has its log
Column = str | Callable[[Row], Any]  # the entry of a row that a table shows, or a function of the row


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


def product(**axes: Iterable[Any]) -> Iterator[Row]:
    """All combinations of the values on these axes, as trials or cases."""
    return (dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values()))


def study(
    out: Path | None, settings: Row, trials: Iterable[Row], row_of: Callable[..., Row], *, rows: str = "rows"
) -> list[Row]:
    """The rows of all trials, continued if `out` exists. See `continued` and `fill`."""
    report = continued(out, settings, rows)
    fill(out, report, report[rows], trials, row_of)
    return report[rows]


def groups(rows: Iterable[Row], *names: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by their values of these entries. Flights that were lost are left out."""
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        if row.get("result") != LOST:
            found.setdefault(tuple(row[name] for name in names), []).append(row)
    return found


def statistics(error: np.ndarray, std: np.ndarray) -> Row:
    """Figures over flights of an error and its standard deviation, with their Monte-Carlo errors.

    `std`: root mean square of the standard deviations. `covered`: share of the 95 % intervals that hold the truth.
    `width`: median half-width of these intervals.
    """
    count, covered = len(error), float(np.mean(np.abs(error) <= NINETY_FIVE * std))
    rmse, claimed = (float(np.sqrt(np.mean(np.square(x)))) for x in (error, std))
    return {
        "flights": count,
        "mean": float(error.mean()),
        "mean_error": float(error.std(ddof=1) / np.sqrt(count)) if count > 1 else None,
        "rmse": rmse,
        "std": claimed,
        "covered": covered,
        "covered_error": covered_error(covered, count),
        "width": float(NINETY_FIVE * np.median(std)),
    }


def covered_error(covered: float, count: int) -> float:
    """The Monte-Carlo error of a share of covered intervals, as if at most 95 % were covered."""
    return float(np.sqrt(max(covered * (1 - covered), 0.05 * 0.95) / count))


def share(part: int, whole: int) -> str:
    """A share with its Monte-Carlo error, of at least half an event [%]."""
    if not whole:
        return ""
    p = np.clip(part / whole, 0.5 / whole, 1 - 0.5 / whole)
    return f"{100 * part / whole:.3g} +- {100 * np.sqrt(p * (1 - p) / whole):.1f}"


def count_results(names: np.ndarray) -> dict[str, int]:
    """The number of estimates by result, from their `result_names`."""
    found, counts = np.unique(names, return_counts=True)
    return dict(zip(found.tolist(), counts.tolist(), strict=True))


def in_words(counts: dict[str, int]) -> str:
    """The counts of `count_results` as the text of a table cell."""
    return ", ".join(f"{count} {what}" for what, count in counts.items())


def plus_minus(row: Row, name: str = "mean", scale: float = 100.0) -> str:
    """A figure of `statistics` with its Monte-Carlo error, by default in percent, as the text of a table cell.

    The error has two digits, and the figure as many decimals.
    """
    value, error = scale * row[name], row[f"{name}_error"]
    if error is None or not 0 < error < math.inf:
        return number(value) + ("" if error is None else f" +- {number(scale * error, 2)}")
    decimals = max(1 - math.floor(math.log10(scale * error)), 0)
    return f"{value:.{decimals}f} +- {scale * error:.{decimals}f}"


def interval(value: Row | None, scale: float) -> str:
    """An estimate with its 95 % interval as the text of a table cell; empty if there is none."""
    if value is None or value.get("estimate") is None:
        return ""
    return f"{scale * value['estimate']:.2f} +- {NINETY_FIVE * scale * value['std']:.2f}"


def results_of(rows: list[Row]) -> str:
    """The results of flights as the text of a table cell."""
    return in_words(count_results(np.array([row["result"] for row in rows])))


def check_names(option: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Refuses a name of an option that is not in its table, before anything is computed."""
    known = list(known)
    if wrong := [name for name in names if name not in known]:
        raise InputError(f"--{option}: no {wrong[0]!r}; give one of {'; '.join(known)}.")


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


def print_rows(title: str, rows: Iterable[Row], columns: dict[str, Column], width: int = 170) -> None:
    """Prints a table of rows. `columns`: by their headings."""
    cells = ([text(row[one] if isinstance(one, str) else one(row)) for one in columns.values()] for row in rows)
    print_table(title, list(columns), cells, width)


def text(value: Any) -> str:
    """A value as a table cell: numbers have three digits, counts of results are words, and `None` is empty."""
    if value is None:
        return ""
    if isinstance(value, dict):
        return in_words(value)
    return number(value) if isinstance(value, float) else str(value)


def number(value: float, digits: int = 3) -> str:
    """A number with so many significant digits, or all of a whole number."""
    return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"
