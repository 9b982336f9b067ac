"""The tables of a study as rows of text, for the page and for the terminal."""

import json
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from ..study import metrics
from .study_data import bounds, names
from .text import MISSING, percent, plain

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
    """One row. `estimator`: the index of its estimator, if any; the page hides the row with the estimator."""

    label: str
    cells: tuple[Cell, ...]
    estimator: int | None = None


class Group(NamedTuple):
    """Rows of one noise scale."""

    label: str
    rows: tuple[Row, ...]


class Table(NamedTuple):
    """Groups of rows under headings.

    - `source`: the variables and functions that the numbers come from.
    - `units`: of the columns; empty if they have none.
    - `notes`: the meaning of the marks.
    """

    name: str
    caption: str
    source: str
    headings: tuple[str, ...]
    groups: tuple[Group, ...]
    units: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def columns(self) -> list[tuple[str, str]]:
        """The headings of all columns, each with its unit or an empty string."""
        return [("estimator", ""), *zip(self.headings, self.units or [""] * len(self.headings), strict=True)]


def scenario_tables(data: xr.Dataset) -> dict[str, Table]:
    """The tables of one scenario, by name."""
    efficiency, coverage, levels = metrics.efficiency(data), metrics.coverage(data), metrics.mean_coverage(data)
    level = int(np.argmin(np.abs(data["level"].values - _LEVEL)))
    parameters, source = tuple(names(data, "parameter")), "estimate, truth, half_width, result (metrics.{})"
    tables = (
        error_table(data),
        Table(
            "efficiency",
            "RMSE / Cramer-Rao bound, with 95 % Monte-Carlo intervals; 1 is the best that an unbiased estimator can do",
            "estimate, truth, bound, result (metrics.efficiency)",
            parameters,
            _groups(data, lambda at: _with_intervals(efficiency.isel(at), "efficiency", plain)),
        ),
        Table(
            "coverage",
            f"Intervals of {100 * data['level'].values[level]:g} % that hold the truth [%], with 95 % Wilson intervals",
            source.format("coverage"),
            parameters,
            _groups(data, lambda at: _with_intervals(coverage.isel(at | {"level": level}), "coverage", percent)),
        ),
        Table(
            "levels",
            "Intervals that hold the truth [%] by the level that they claim, averaged over the parameters",
            source.format("mean_coverage"),
            tuple(f"{100 * level:g} %" for level in data["level"].values),
            _groups(data, lambda at: _with_intervals(levels.isel(at), "coverage", percent)),
        ),
        _result_table(data),
    )
    return {table.name: table for table in tables}


def error_table(data: xr.Dataset, *, digits: int = 3) -> Table:
    """RMS errors in percent of the truth, with rows for the bounds and for the centre of the bracket."""
    found, best, middle = metrics.estimator_error(data), metrics.bound_error(data), metrics.center_error(data)
    used: set[int] = set()

    def cells(of: xr.Dataset) -> tuple[Cell, ...]:
        made = []
        for place in range(data.sizes["parameter"]):
            one = of.isel(parameter=place)
            reason = int(one["reason"])
            value = float(one["absolute" if reason else "percent"])
            mark = "" if np.isnan(value) else _MARKS[reason]
            used.update({reason} if mark else ())
            made.append(Cell(plain(value, digits), mark=mark))
        return tuple(made)

    groups = []
    for place in range(data.sizes["scale"]):
        rows = [Row(f"bound, {seen}", cells(best.isel(scale=place, estimator=at))) for seen, at in bounds(data).items()]
        for at, name in enumerate(names(data, "estimator")):
            rows.append(Row(name, cells(found.isel(scale=place, estimator=at)), at))
        rows.append(Row("bracket centre", cells(middle.isel(scale=place))))
        groups.append(Group(_noise(data, place), tuple(rows)))
    return Table(
        "error",
        "RMS error [% of the truth; where marked, in the parameter's unit]",
        "estimate, truth, bound, center, result (metrics.estimator_error, bound_error, center_error)",
        tuple(names(data, "parameter")),
        tuple(groups),
        units=tuple(names(data, "unit")),
        notes=tuple(
            f"{_MARKS[code]} absolute error, in the parameter's unit: {metrics.NO_PERCENTAGE[code]}, so a percentage "
            "is meaningless."
            for code in sorted(used)
        ),
    )


def _result_table(data: xr.Dataset) -> Table:
    """The number of flights by result, mean rollouts, and the share of seed brackets that hold the truth."""
    counts, hits, spent = metrics.result_counts(data), metrics.hit_rate(data), metrics.mean_rollouts(data)
    known = names(counts, "code")
    occurs = [place for place in range(len(known)) if bool((counts.isel(code=place) > 0).any())]

    def cells(at: dict[str, int]) -> tuple[Cell, ...]:
        hit = _with_intervals(hits.isel(at).expand_dims("parameter"), "hit_rate", percent)
        numbers = [Cell(str(int(counts.isel(at).isel(code=place)))) for place in occurs]
        return (*numbers, Cell(plain(float(spent.isel(at)))), *hit)

    return Table(
        "results",
        "Flights by result, mean rollouts, and the hybrid's seed brackets that hold the truth [%]",
        "result, rollouts, hit (metrics.result_counts, mean_rollouts, hit_rate)",
        (*(known[place].replace("_", " ") for place in occurs), "rollouts", "seed hits"),
        _groups(data, cells),
    )


class Trouble(NamedTuple):
    """Flights or cells without numbers: a description of the first 20, and the total."""

    listed: tuple[str, ...]
    total: int


def troubled_flights(data: xr.Dataset) -> Trouble:
    """The flights that were run and did not converge."""
    bad = (metrics.was_run(data) & ~metrics.converged(data)).transpose("scale", "estimator", "flight").values
    known = {code: name.replace("_", " ") for name, code in metrics.codes(data).items()}
    results = data["result"].transpose("scale", "estimator", "flight").values
    estimators, flights = names(data, "estimator"), names(data, "flight")
    places = np.argwhere(bad).tolist()
    listed = tuple(
        f"{_noise(data, scale)}, {estimators[at]}, flight {flights[flight]}: "
        f"{known.get(int(results[scale, at, flight]), 'unknown result')}"
        for scale, at, flight in places[:_MOST_LISTED]
    )
    return Trouble(listed, len(places))


def failed_cells(dataset: xr.Dataset) -> Trouble:
    """The cells of a study that raised an error, with the error's message."""
    failures: list[dict[str, Any]] = json.loads(dataset.attrs.get("failures", "[]"))
    shown = [name for name in metrics.SCENARIO if dataset.sizes[name] > 1] or ["estimator"]
    listed = tuple(
        f"cell {failure['cell']}, {', '.join(f'{name} {failure[name]}' for name in shown)}: {failure['message']}"
        for failure in failures[:_MOST_LISTED]
    )
    return Trouble(listed, len(failures))


def cells_not_run(dataset: xr.Dataset) -> tuple[int, int]:
    """The number of cells that have not been run, and the number of all cells."""
    missing = (dataset["result"] == metrics.codes(dataset)["not_run"]).all("flight")
    return int(missing.sum()), missing.size


def _noise(data: xr.Dataset, place: int) -> str:
    return f"noise x {data['scale'].values[place]:g}"


def _groups(data: xr.Dataset, cells: Callable[[dict[str, int]], tuple[Cell, ...]]) -> tuple[Group, ...]:
    """The groups of a table; `cells` gives those of a row, from its indices along `scale` and `estimator`."""
    estimators = list(enumerate(names(data, "estimator")))
    return tuple(
        Group(
            _noise(data, place),
            tuple(Row(name, cells({"scale": place, "estimator": at}), at) for at, name in estimators),
        )
        for place in range(data.sizes["scale"])
    )


def _with_intervals(one: xr.Dataset, name: str, text: Callable[[float], str]) -> tuple[Cell, ...]:
    made = []
    for number, *ends in zip(*(one[part].values for part in (name, "low", "high")), strict=True):
        low, high = map(text, ends)
        made.append(Cell(text(number), "" if MISSING in (low, high) else f"{low} to {high}"))
    return tuple(made)
