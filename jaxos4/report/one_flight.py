"""A study of one flight: its estimates and their intervals beside the truth, because one flight has no statistics."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from ..study import metrics
from .study_tables import Entry, Table, names, positive_scales, scale_labels, shown_level
from .style import INK, estimator_gid, grid, label, legend, styles
from .text import DASH, plain

_HEADINGS = ("unit", "truth", "estimate", "interval", "bound", "error / bound")


def is_of_one(dataset: xr.Dataset) -> bool:
    """Whether each scenario has one flight."""
    return dataset.sizes["flight"] == 1


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
                rows.append((name, tuple(map(Entry, cells)), j))
            groups.append((f"{scale}, {estimator}", rows))
    return Table([(heading, "") for heading in _HEADINGS], groups)


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
    estimators, parameters, count = names(data, "estimator"), names(data, "parameter"), data.sizes["scale"]
    height = 0.6 + len(parameters) * (0.14 + 0.06 * len(estimators))
    figure, panels = grid(count, columns=min(count, 3), width=3.3 * min(count, 3), height=height)
    for i, panel in enumerate(panels):
        for j, look in enumerate(styles(estimators).values()):
            y = np.arange(len(parameters)) + 0.6 * (j - (len(estimators) - 1) / 2) / len(estimators)
            x, reach = (each.isel(scale=i, estimator=j).values for each in (error, half))
            panel.hlines(y, x - reach, x + reach, color=look.color, linewidth=1.4, gid=estimator_gid(j))
            marks = {"color": look.color, "marker": look.marker, "linestyle": "none", "markersize": 4}
            panel.plot(x, y, gid=estimator_gid(j), **marks)
        panel.axvline(0, color=INK, linewidth=1.1, zorder=1.4)
        panel.set_yticks(range(len(parameters)), parameters)
        panel.set_ylim(len(parameters) - 0.4, -0.6)
        panel.grid(axis="y", visible=False)
        panel.set_title(scale_labels(data)[i])
    label(figure, x="(estimate - truth) / bound")
    legend(figure, estimators)
    return figure
