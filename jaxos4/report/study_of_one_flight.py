"""A study of one flight: its estimates and their intervals beside the truth, because one flight has no statistics."""

import numpy as np
import xarray as xr

from ..study import metrics
from .panels import Figure, Line, Panel, Scale, across
from .study_tables import Rows, Table, names, positive_scales, scale_labels, shown_level
from .style import styles
from .text import DASH, plain, span, with_unit


def is_of_one(data: xr.Dataset) -> bool:
    """Whether each scenario has one flight."""
    return data.sizes["flight"] == 1


def estimates(data: xr.Dataset) -> Table:
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
    return Table(caption, headings, rows, ["From estimate, truth, half_width, bound, result."])


def outcomes(data: xr.Dataset) -> list[str]:
    """How each estimate ended, and how many of its intervals contain the truth."""
    known = {code: name.replace("_", " ") for name, code in metrics.codes(data).items()}
    level = shown_level(data)
    share = metrics.coverage(data).sel(level=level)
    lines = []
    for i, scale in enumerate(scale_labels(data)):
        for j, estimator in enumerate(names(data, "estimator")):
            at = {"scale": i, "estimator": j}
            result = known.get(int(data["result"].isel(at | {"flight": 0})), "unknown result")
            counted, hold = (int(share[name].isel(at).sum()) for name in ("count", "coverage"))
            held = f", {hold} of {counted} intervals contain the truth" if counted else ""
            lines.append(f"{estimator} at {scale}: {result}{held}.")
    return lines


def intervals(data: xr.Dataset) -> Figure | None:
    """Estimate - truth of each parameter over the least bound of any estimator, with its interval; a panel a scale."""
    data = positive_scales(data).isel(flight=0)
    least = data["bound"].min("estimator")
    error = (data["estimate"] - data["truth"]) / least.where(least > 0)
    half = data["half_width"].sel(level=shown_level(data)) / least.where(least > 0)
    if not np.isfinite(error.values).any():
        return None
    estimators, parameters, panels = names(data, "estimator"), names(data, "parameter"), []
    places = np.arange(len(parameters))
    scale = Scale(ends=(len(parameters) - 0.4, -0.6), ticks=dict(enumerate(parameters)), lines=False)
    height = 90 + len(parameters) * (14 + 6 * len(estimators))
    for i, title in enumerate(scale_labels(data)):
        marks = [Line((0, 0), (-np.inf, np.inf), width=1.5)]
        for j, (name, look) in enumerate(styles(estimators).items()):
            y = places + 0.6 * (j - (len(estimators) - 1) / 2) / len(estimators)
            x, reach = (each.isel(scale=i, estimator=j).values for each in (error, half))
            marks += [across(y, x - reach, x + reach, color=look.color, group=j)]
            marks += [Line(x, y, look.color, 0, marker=look.marker, size=6, group=j, name=name)]
        panels.append(Panel(title, marks, Scale(label="(estimate - truth) / bound"), scale, height=height))
    return Figure("intervals", panels)
