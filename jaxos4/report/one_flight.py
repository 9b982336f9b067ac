"""A study of one flight: its estimates and their intervals beside the truth, because one flight has no statistics."""

import numpy as np
import xarray as xr

from ..study import metrics
from .page import Entry, Row, Table
from .panels import Figure, Line, Panel, Scale, across
from .study_tables import names, positive_scales, scale_labels, shown_level
from .style import styles
from .text import DASH, plain

_HEADINGS = ("parameter", "unit", "truth", "estimate", "interval", "bound", "error / bound")


def is_of_one(data: xr.Dataset) -> bool:
    """Whether each scenario has one flight."""
    return data.sizes["flight"] == 1


def estimates(data: xr.Dataset) -> Table:
    """Truth, estimate, interval and bound of each parameter, in groups of one noise scale and estimator."""
    groups, units, error = [], names(data, "unit"), metrics.normalised_error(data).isel(flight=0)
    for i, scale in enumerate(scale_labels(data)):
        for j, estimator in enumerate(names(data, "estimator")):
            at, one = {"scale": i, "estimator": j}, data.isel(scale=i, estimator=j, flight=0)
            half = one["half_width"].sel(level=shown_level(data))
            shown = (one["truth"], one["estimate"], one["estimate"] - half, one["estimate"] + half, one["bound"])
            rows = []
            for k, name in enumerate(names(data, "parameter")):
                truth, value, low, high, bound = (plain(float(each.isel(parameter=k)), 4) for each in shown)
                ends = DASH if np.isnan(half.values[k]) else f"{low} to {high}"
                cells = (units[k], truth, value, ends, bound, plain(float(error.isel(at | {"parameter": k})), 2))
                rows.append(Row(name, tuple(map(Entry, cells)), j))
            groups.append((f"{scale}, {estimator}", rows))
    caption = f"Each estimate, its interval of {100 * shown_level(data):g} %, and the truth"
    source = "From estimate, truth, half_width, bound, result."
    return Table("estimates", caption, _HEADINGS, groups, [source])


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
