"""The scenarios of a study, and their tables as rows of text, for the page and for the terminal."""

import csv
import io
import itertools
import json
from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr
from rich.console import Group, RenderableType
from rich.text import Text

from ..study import OUTCOMES, metrics
from .text import DASH, Listing, plain, span, with_unit

_PHRASES = {
    "model": "{} model",
    "airframe": "airframe {}",
    "excitation": "{}",
    "duration": "{:g} s",
    "method": "truth by {}",
    "noise": "{} noise",
    "width": "bracket x {:g}",
    "channels": "{} channels",
}
# The mark after a number that is not a percentage, by the codes of `metrics.no_percentage`.
_MARKS = ("", "†", "‡")
_MOST_LISTED = 20
Rows = list[str | tuple[str, ...]]
Table = tuple[str, Sequence[str], Rows, list[str]]
"""The caption, the headings, the rows and the notes of a table; see `page.table`."""


def scenarios(dataset: xr.Dataset) -> list[tuple[str, xr.Dataset]]:
    """All scenarios: all noise scales and estimators, and one value on each other axis.

    Each has a label that names the dimensions that differ, or all if there is one scenario.
    """
    fixed = [name for name in metrics.SCENARIO if name in _PHRASES]
    varied = [name for name in fixed if dataset.sizes[name] > 1] or fixed
    places = itertools.product(*(range(dataset.sizes[name]) for name in fixed))
    every = [dataset.isel(dict(zip(fixed, at, strict=True))) for at in places]
    return [(", ".join(_PHRASES[name].format(data[name].item()) for name in varied), data) for data in every]


def names(data: xr.Dataset | xr.DataArray, dimension: str) -> list[str]:
    """The labels along a dimension."""
    return [str(name) for name in data[dimension].values]


def scale_labels(data: xr.Dataset) -> list[str]:
    """The noise scales in words."""
    return [f"noise x {scale:g}" for scale in data["scale"].values]


def bounds(data: xr.Dataset) -> dict[str, int]:
    """The channels that estimators look at, each with the index of an estimator that has their bound."""
    found: dict[str, int] = {}
    known = data["bound"].notnull().any([name for name in data["bound"].dims if name != "estimator"])
    for place in np.argsort(~known.values, kind="stable").tolist():  # first those that were run
        found.setdefault(str(data["seen"].isel(estimator=place).item()), place)
    return dict(sorted(found.items(), key=lambda item: item[1]))


def positive_scales(data: xr.Dataset) -> xr.Dataset:
    """The data without the noise scale 0, which a logarithmic axis cannot show."""
    return data.isel(scale=np.flatnonzero(data["scale"].values > 0))


def error_unit(data: xr.Dataset, parameter: int) -> tuple[str, str, str]:
    """The scale of a parameter's errors, absolute if any percentage has no meaning; the unit; and why not percent."""
    reason = metrics.no_percentage(data).isel(parameter=parameter)
    if not (reason > 0).any():
        return "percent", "%", ""
    worst = int(reason.where(reason > 0).min())
    at = [f"{scale:g}" for scale in data["scale"].values[(reason > 0).any("estimator").values]]
    where = f" at noise {', '.join(at)}" if len(at) < data.sizes["scale"] else ""
    return "absolute", names(data, "unit")[parameter], metrics.NO_PERCENTAGE[worst] + where


def scenario_tables(data: xr.Dataset) -> dict[str, Table]:
    """The tables of one scenario, by name."""
    parameters, level = names(data, "parameter"), shown_level(data)
    levels = [f"{100 * x:g} %" for x in data["level"].values]

    def table(name: str, measure: str, found: xr.Dataset, headings: list[str], caption: str) -> Table:
        source = f"From estimate, truth, {'bound' if name == 'efficiency' else 'half_width'}, result (metrics.{name})."
        rows = _by_estimator(data, lambda at: _with_intervals(found.isel(at), measure))
        return caption, ("estimator", *headings), rows, [source]

    ratio = "RMSE / Cramer-Rao bound, with 95 % Monte-Carlo intervals; 1 is the best that an unbiased estimator can do"
    shares = f"Intervals of {100 * level:g} % that contain the truth [%], with 95 % Wilson intervals"
    means = "Intervals that contain the truth [%] by the level that they claim, averaged over the parameters"
    covered = metrics.coverage(data).sel(level=level)
    return {
        "error": _error_table(data),
        "efficiency": table("efficiency", "efficiency", metrics.efficiency(data), parameters, ratio),
        "coverage": table("coverage", "coverage", 100 * covered, parameters, shares),
        "levels": table("mean_coverage", "coverage", 100 * metrics.mean_coverage(data), levels, means),
        "results": _result_table(data),
    } | ({"estimates": _estimate_table(data)} if data.sizes["flight"] == 1 else {})


def shown_level(data: xr.Dataset) -> float:
    """The level of the intervals in the table of coverage: the study's nearest to 95 %."""
    return min(data["level"].values.tolist(), key=lambda level: abs(level - 0.95))


def _error_table(data: xr.Dataset, *, digits: int = 3) -> Table:
    """RMS errors in percent of the truth, with rows for the bounds and for the centre of the bracket."""
    found, best, middle = metrics.estimator_error(data), metrics.bound_error(data), metrics.center_error(data)

    def row(name: str, of: xr.Dataset) -> tuple[str, ...]:
        reasons = of["reason"].values.astype(int)
        values = np.where(reasons > 0, of["absolute"].values, of["percent"].values)
        marks = ("" if np.isnan(value) else _MARKS[reason] for value, reason in zip(values, reasons, strict=True))
        return (name, *(f"{plain(value, digits)}{mark}" for value, mark in zip(values, marks, strict=True)))

    rows: Rows = []
    for place, label in enumerate(scale_labels(data)):
        rows.append(label)
        rows += [row(f"bound, {x}", best.isel(scale=place, estimator=at)) for x, at in bounds(data).items()]
        every = enumerate(names(data, "estimator"))
        rows += [row(name, found.isel(scale=place, estimator=at)) for at, name in every]
        rows.append(row("bracket centre", middle.isel(scale=place)))
    columns = list(zip(*(each[1:] for each in rows if isinstance(each, tuple)), strict=True))
    notes = (
        f"{mark} absolute error, in the parameter's unit: {reason}, so a percentage is meaningless."
        for mark, reason in zip(_MARKS, metrics.NO_PERCENTAGE, strict=True)
        if mark and any(mark in cell for column in columns for cell in column)
    )
    headings = ["estimator"]
    for name, unit, column in zip(names(data, "parameter"), names(data, "unit"), columns, strict=True):
        marked = [cell.endswith(_MARKS[1:]) for cell in column if cell != DASH]
        headings.append(f"{name} [{'%' if not any(marked) else unit if all(marked) else f'%; marked: {unit}'}]")
    caption = "RMS error [% of the truth; where marked, in the parameter's unit]"
    source = "From estimate, truth, bound, center, result (metrics.estimator_error, bound_error, center_error)."
    return caption, headings, rows, [*notes, source]


def _result_table(data: xr.Dataset) -> Table:
    """The number of flights by result, mean rollouts, and the share of seed brackets that contain the truth."""
    counts, hits, spent = metrics.result_counts(data), metrics.hit_rate(data), metrics.mean_rollouts(data)
    occurs = np.flatnonzero((counts > 0).any([name for name in counts.dims if name != "code"]).values)

    def cells(at: dict[str, int]) -> tuple[str, ...]:
        hit = _with_intervals(100 * hits.isel(at).expand_dims("parameter"), "hit_rate")
        return (*(f"{count:.0f}" for count in counts.isel(at).values[occurs]), plain(float(spent.isel(at))), *hit)

    headings = [names(counts, "code")[place].replace("_", " ") for place in occurs]
    caption = "Flights by result, mean rollouts, and the hybrid's seed brackets that contain the truth [%]"
    source = "From result, rollouts, hit (metrics.result_counts, mean_rollouts, hit_rate)."
    headings = ("estimator", *headings, "rollouts", "seed hits")
    return caption, headings, _by_estimator(data, cells), [source]


def _estimate_table(data: xr.Dataset) -> Table:
    """Estimate, interval and bound of each estimator, in groups of one noise scale and parameter with its truth."""
    rows: Rows = []
    error, level = metrics.normalised_error(data), shown_level(data)
    half = data["half_width"].sel(level=level)
    shown = (data["estimate"], data["estimate"] - half, data["estimate"] + half, data["bound"], error)
    for i, scale in enumerate(scale_labels(data)):
        for k, (name, unit) in enumerate(zip(names(data, "parameter"), names(data, "unit"), strict=True)):
            at = {"scale": i, "parameter": k, "flight": 0}
            truth = float(data["truth"].isel(at, missing_dims="ignore"))
            rows.append(f"{with_unit(name, unit)} at {scale}, truth {plain(truth, 4)}")
            for j, estimator in enumerate(names(data, "estimator")):
                value, low, high, bound, ratio = (
                    float(each.isel(at | {"estimator": j}, missing_dims="ignore")) for each in shown
                )
                ends = DASH if np.isnan(low) else span((low, high))
                rows.append((estimator, plain(value, 4), ends, plain(bound, 4), plain(ratio, 2)))
    headings = ("estimator", "estimate", "interval", "bound", "error / bound")
    caption = f"Each estimate with its interval of {100 * level:g} %, and the truth"
    return caption, headings, rows, ["From estimate, truth, half_width, bound, result."]


def ended(data: xr.Dataset) -> list[str]:
    """How each estimate ended, and how many of its intervals contain the truth."""
    known = {code: name.replace("_", " ") for name, code in metrics.codes(data).items()}
    level = shown_level(data)
    share = metrics.coverage(data).sel(level=level)
    lines = []
    for i, scale in enumerate(scale_labels(data)):
        for j, estimator in enumerate(names(data, "estimator")):
            at = {"scale": i, "estimator": j}
            result = known.get(int(data["result"].isel(at | {"flight": 0})), "unknown result")
            counted, right = (int(share[name].isel(at).sum()) for name in ("count", "coverage"))
            coverage = f", {right} of {counted} intervals contain the truth" if counted else ""
            lines.append(f"{estimator} at {scale}: {result}{coverage}.")
    return lines


def best_estimators(data: xr.Dataset) -> dict[str, str]:
    """The estimators that are as accurate as the best one, within Monte-Carlo error, by the noise scales in words."""
    found, best = metrics.accuracy_interval(data), {}
    for scale, one in zip(scale_labels(data), (found.isel(scale=i) for i in range(data.sizes["scale"])), strict=True):
        good = (one["low"] <= one["accuracy"].min()).values
        if good.any():
            best.setdefault(", ".join(np.array(names(data, "estimator"))[good]), []).append(scale)
    return {", ".join(scales) if len(best) > 1 else "every noise": names for names, scales in best.items()}


def troubled_flights(data: xr.Dataset) -> tuple[int, list[str]]:
    """The number of flights that were run and did not converge, and the first 20."""
    order = ("scale", "estimator", "flight")
    bad = (metrics.was_run(data) & ~metrics.converged(data)).transpose(*order).values
    results, places = data["result"].transpose(*order).values[bad], np.argwhere(bad)
    known = {code: name.replace("_", " ") for name, code in metrics.codes(data).items()}
    scales, estimators, flights = scale_labels(data), names(data, "estimator"), names(data, "flight")
    listed = [
        f"{scales[i]}, {estimators[j]}, flight {flights[k]}: {known.get(int(result), 'unknown result')}"
        for (i, j, k), result in zip(places[:_MOST_LISTED], results[:_MOST_LISTED], strict=True)
    ]
    return len(places), listed


def failed_cells(dataset: xr.Dataset) -> tuple[int, list[str]]:
    """The number of cells of a study that raised an error, and the first 20 with the message."""
    failures = json.loads(dataset.attrs.get("failures", "[]"))
    shown = [name for name in metrics.SCENARIO if dataset.sizes[name] > 1] or ["estimator"]
    listed = [
        f"cell {failure['cell']}, {', '.join(f'{name} {failure[name]}' for name in shown)}: {failure['message']}"
        for failure in failures[:_MOST_LISTED]
    ]
    return len(failures), listed


def channels_by_estimator(data: xr.Dataset) -> dict[str, list[str]]:
    """The channels that estimators look at, each with its estimators."""
    found: dict[str, list[str]] = {}
    for name, seen in zip(names(data, "estimator"), data["seen"].values.ravel().tolist(), strict=True):
        found.setdefault(str(seen), []).append(name)
    return found


def error_csv(dataset: xr.Dataset) -> str:
    """Errors, bounds, efficiency and coverage as CSV: a row for each scenario, noise, estimator and parameter.

    Errors and bounds are in the parameter's unit. An empty cell: not known.
    """
    text, fixed = io.StringIO(newline=""), [name for name in metrics.SCENARIO if name in _PHRASES]
    writer = csv.writer(text, lineterminator="\n")
    measured = ["rms_error", "rms_error_percent", "bound", "efficiency", "efficiency_low", "efficiency_high"]
    measured += ["coverage", "coverage_low", "coverage_high", "rollouts"]
    writer.writerow([*fixed, "noise_scale", "estimator", "seen", "parameter", "unit", "level", *measured])
    for _, data in scenarios(dataset):
        level = shown_level(data)
        error, bound, spent = metrics.estimator_error(data), metrics.bound_error(data), metrics.mean_rollouts(data)
        share, ratio = metrics.coverage(data).sel(level=level), metrics.efficiency(data)
        percents = error["percent"].where(error["reason"] == 0)
        sizes = (data.sizes[name] for name in ("scale", "estimator", "parameter"))
        for i, j, k in itertools.product(*map(range, sizes)):
            at, at_all = {"scale": i, "estimator": j}, {"scale": i, "estimator": j, "parameter": k}
            values = [error["absolute"], percents, bound["absolute"], ratio["efficiency"], ratio["low"], ratio["high"]]
            values += [share[name] for name in ("coverage", "low", "high")]
            numbers = [float(each.isel(at_all)) for each in values] + [float(spent.isel(at))]
            about = [data[name].item() for name in fixed] + [data["scale"].values[i], names(data, "estimator")[j]]
            about += [data["seen"].isel(estimator=j).item(), names(data, "parameter")[k], names(data, "unit")[k], level]
            writer.writerow([*about, *("" if np.isnan(number) else f"{number:.6g}" for number in numbers)])
    return text.getvalue()


def cells_not_run(dataset: xr.Dataset) -> tuple[int, int]:
    """The number of cells that have not been run, and the number of all cells."""
    missing = (dataset["result"] == metrics.codes(dataset)["not_run"]).all("flight")
    return int(missing.sum()), missing.size


def _by_estimator(data: xr.Dataset, cells: Callable[[dict[str, int]], tuple[str, ...]]) -> Rows:
    """A row for each noise scale and estimator; `cells` gives the row's cells from its indices."""
    rows: Rows = []
    for scale, label in enumerate(scale_labels(data)):
        rows.append(label)
        rows += [(name, *cells({"scale": scale, "estimator": i})) for i, name in enumerate(names(data, "estimator"))]
    return rows


def _with_intervals(one: xr.Dataset, measure: str) -> tuple[str, ...]:
    """Numbers, each with its interval on a second line."""
    rows = (map(plain, row) for row in zip(*(one[part].values for part in (measure, "low", "high")), strict=True))
    return tuple(value if DASH in (low, high) else f"{value}\n{low} to {high}" for value, low, high in rows)


def count_outcomes(dataset: xr.Dataset) -> str:
    """The number of estimates in a study's Dataset, and how they ended, in words."""
    codes, counts = np.unique(dataset["result"].to_numpy(), return_counts=True)
    outcomes = ", ".join(f"{count} {OUTCOMES[code]}" for code, count in zip(codes, counts, strict=True))
    return f"{dataset['result'].size} estimates: {outcomes}"


def error_table(dataset: xr.Dataset) -> RenderableType:
    """The table of errors of each scenario, then the notes that explain the marks."""
    parts: list[RenderableType] = []
    notes: dict[str, None] = {}
    for label, data in scenarios(dataset):
        (_, headings, cells, explained), rows = _error_table(data, digits=2), []
        headings = [heading.partition(" [")[0] for heading in headings[1:]]
        blank = [""] * len(headings)
        for row in cells:
            rows += [["", *blank]] * bool(rows) + [[row, *blank]] if isinstance(row, str) else [row]
        listing = Listing(["", *headings], rows, headings, apart=1)  # 80 columns must do
        parts += [Text(f"RMS error [%], {label}"), listing.table()]
        notes |= dict.fromkeys(explained[:-1])  # the last one says how the page's numbers are computed
    return Group(*parts, *(Text(note) for note in notes))
