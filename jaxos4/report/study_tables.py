"""The tables of a study as rows of text, for the page and for the terminal."""

import json
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from rich.console import Group, RenderableType
from rich.text import Text

from ..study import OUTCOMES, metrics
from .study_data import bounds, names, scale_labels, scenarios
from .text import MISSING, Listing, percent, plain

# The mark after a number that is not a percentage, by the codes of `metrics.no_percentage`.
_MARKS = ("", "†", "‡")
# The table of coverage by parameter shows this level, or the nearest one in the study.
_LEVEL = 0.95
_MOST_LISTED = 20


class Cell(NamedTuple):
    """A number as text, with its interval and its mark."""

    text: str
    interval: str = ""
    mark: str = ""


class Row(NamedTuple):
    """One row. `estimator`: the index of its estimator, if it has one. The page hides the row with the estimator."""

    label: str
    cells: tuple[Cell, ...]
    estimator: int | None = None


class Table(NamedTuple):
    """Rows of text, in groups of one noise scale.

    - `headings`: of the columns after the first, each with its unit or an empty string.
    - `groups`: the label of each group, and its rows.
    - `notes`: the meaning of the marks.
    """

    headings: list[tuple[str, str]]
    groups: list[tuple[str, list[Row]]]
    notes: tuple[str, ...] = ()


def scenario_tables(data: xr.Dataset) -> dict[str, Table]:
    """The tables of one scenario, by name."""

    def table(found: xr.Dataset, measure: str, text: Callable[[float], str], headings: list[str]) -> Table:
        return _by_estimator(data, headings, lambda at: _with_intervals(found.isel(at), measure, text))

    parameters, levels = names(data, "parameter"), [f"{100 * x:g} %" for x in data["level"].values]
    return {
        "error": _error_table(data),
        "efficiency": table(metrics.efficiency(data), "efficiency", plain, parameters),
        "coverage": table(metrics.coverage(data).sel(level=shown_level(data)), "coverage", percent, parameters),
        "levels": table(metrics.mean_coverage(data), "coverage", percent, levels),
        "results": _result_table(data),
    }


def shown_level(data: xr.Dataset) -> float:
    """The level of the intervals in the table of coverage."""
    return min(data["level"].values.tolist(), key=lambda level: abs(level - _LEVEL))


def _error_table(data: xr.Dataset, *, digits: int = 3) -> Table:
    """RMS errors in percent of the truth, with rows for the bounds and for the centre of the bracket."""
    found, best, middle = metrics.estimator_error(data), metrics.bound_error(data), metrics.center_error(data)

    def cells(of: xr.Dataset) -> tuple[Cell, ...]:
        reasons = of["reason"].values.astype(int)
        values = np.where(reasons > 0, of["absolute"].values, of["percent"].values)
        marks = ("" if np.isnan(value) else _MARKS[reason] for value, reason in zip(values, reasons, strict=True))
        return tuple(Cell(plain(value, digits), mark=mark) for value, mark in zip(values, marks, strict=True))

    groups = []
    for place, label in enumerate(scale_labels(data)):
        rows = [Row(f"bound, {seen}", cells(best.isel(scale=place, estimator=at))) for seen, at in bounds(data).items()]
        for at, name in enumerate(names(data, "estimator")):
            rows.append(Row(name, cells(found.isel(scale=place, estimator=at)), at))
        groups.append((label, [*rows, Row("bracket centre", cells(middle.isel(scale=place)))]))
    used = {cell.mark for _, rows in groups for row in rows for cell in row.cells}
    notes = (
        f"{mark} absolute error, in the parameter's unit: {reason}, so a percentage is meaningless."
        for mark, reason in zip(_MARKS, metrics.NO_PERCENTAGE, strict=True)
        if mark and mark in used
    )
    return Table(list(zip(names(data, "parameter"), names(data, "unit"), strict=True)), groups, tuple(notes))


def _result_table(data: xr.Dataset) -> Table:
    """The number of flights by result, mean rollouts, and the share of seed brackets that hold the truth."""
    counts, hits, spent = metrics.result_counts(data), metrics.hit_rate(data), metrics.mean_rollouts(data)
    occurs = np.flatnonzero((counts > 0).any([name for name in counts.dims if name != "code"]).values)

    def cells(at: dict[str, int]) -> tuple[Cell, ...]:
        hit = _with_intervals(hits.isel(at).expand_dims("parameter"), "hit_rate", percent)
        numbers = [Cell(str(int(number))) for number in counts.isel(at).values[occurs]]
        return (*numbers, Cell(plain(float(spent.isel(at)))), *hit)

    headings = [names(counts, "code")[place].replace("_", " ") for place in occurs]
    return _by_estimator(data, [*headings, "rollouts", "seed hits"], cells)


def troubled_flights(data: xr.Dataset) -> dict[str, Any]:
    """The flights that were run and did not converge: the first 20 `listed`, and the `total`."""
    order = ("scale", "estimator", "flight")
    bad = (metrics.was_run(data) & ~metrics.converged(data)).transpose(*order).values
    results, places = data["result"].transpose(*order).values[bad], np.argwhere(bad)
    known = {code: name.replace("_", " ") for name, code in metrics.codes(data).items()}
    scales, estimators, flights = scale_labels(data), names(data, "estimator"), names(data, "flight")
    listed = [
        f"{scales[i]}, {estimators[j]}, flight {flights[k]}: {known.get(int(result), 'unknown result')}"
        for (i, j, k), result in zip(places[:_MOST_LISTED], results[:_MOST_LISTED], strict=True)
    ]
    return {"listed": listed, "total": len(places)}


def failed_cells(dataset: xr.Dataset) -> dict[str, Any]:
    """The cells of a study that raised an error, with its message: the first 20 `listed`, and the `total`."""
    failures = json.loads(dataset.attrs.get("failures", "[]"))
    shown = [name for name in metrics.SCENARIO if dataset.sizes[name] > 1] or ["estimator"]
    listed = [
        f"cell {failure['cell']}, {', '.join(f'{name} {failure[name]}' for name in shown)}: {failure['message']}"
        for failure in failures[:_MOST_LISTED]
    ]
    return {"listed": listed, "total": len(failures)}


def cells_not_run(dataset: xr.Dataset) -> tuple[int, int]:
    """The number of cells that have not been run, and the number of all cells."""
    missing = (dataset["result"] == metrics.codes(dataset)["not_run"]).all("flight")
    return int(missing.sum()), missing.size


def _by_estimator(data: xr.Dataset, headings: list[str], cells: Callable[[dict[str, int]], tuple[Cell, ...]]) -> Table:
    """A table with a row for each noise scale and estimator; `cells` gives the row's cells from its indices."""
    estimators = list(enumerate(names(data, "estimator")))
    groups = [
        (label, [Row(name, cells({"scale": scale, "estimator": at}), at) for at, name in estimators])
        for scale, label in enumerate(scale_labels(data))
    ]
    return Table([(heading, "") for heading in headings], groups)


def _with_intervals(one: xr.Dataset, measure: str, text: Callable[[float], str]) -> tuple[Cell, ...]:
    rows = (map(text, row) for row in zip(*(one[part].values for part in (measure, "low", "high")), strict=True))
    return tuple(Cell(value, "" if MISSING in (low, high) else f"{low} to {high}") for value, low, high in rows)


def count_outcomes(dataset: xr.Dataset) -> str:
    """The number of estimates in a study's Dataset, and how they ended, in words."""
    codes, counts = np.unique(dataset["result"].to_numpy(), return_counts=True)
    outcomes = ", ".join(f"{count} {OUTCOMES[code]}" for code, count in zip(codes, counts, strict=True))
    return f"{dataset['result'].size} estimates: {outcomes}"


def error_table(dataset: xr.Dataset) -> RenderableType:
    """The table of errors of each scenario, then the notes that explain the marks."""
    parts: list[RenderableType] = []
    notes: dict[str, None] = {}
    for scenario in scenarios(dataset):
        table, rows = _error_table(scenario.data, digits=2), []
        headings = [heading for heading, _ in table.headings]
        blank = [""] * len(headings)
        for label, group in table.groups:
            rows += [["", *blank]] * bool(rows) + [[label, *blank]]
            rows += [[row.label, *(cell.text + cell.mark for cell in row.cells)] for row in group]
        listing = Listing(["", *headings], rows, headings, apart=1)  # 80 columns must do
        parts += [Text(f"RMS error [%], {scenario.label}"), listing.table()]
        notes |= dict.fromkeys(table.notes)
    return Group(*parts, *(Text(note) for note in notes))
