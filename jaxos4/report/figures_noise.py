"""Figures against the noise scale: errors and bounds, efficiency, and the noise limits of the parameters."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from ..study import metrics
from .legend import legend
from .numbers import plain
from .scenario import bounds, names
from .style import BOUND_DASHES, FAINT, INK, estimator_gid, grid, label_edges, log_axis, scale_axis, styles

_COLUMNS = 4
# The markers of all estimators are spread over this share of the gap between two noise scales.
_DODGE = 0.3


def positive_scales(data: xr.Dataset) -> xr.Dataset:
    """The data without the noise scale 0, which a logarithmic axis cannot show."""
    return data.isel(scale=np.flatnonzero(data["scale"].values > 0))


def error_unit(data: xr.Dataset, parameter: int) -> tuple[str, str, str]:
    """The scale of a parameter's errors: "percent" or "absolute", the unit, and why not percent.

    Absolute if the percentage of any point is meaningless, so that a panel has one scale.
    """
    reason = metrics.no_percentage(data).isel(parameter=parameter)
    if not (reason > 0).any():
        return "percent", "%", ""
    worst = int(reason.where(reason > 0).min())
    at = [f"{scale:g}" for scale in data["scale"].values[(reason > 0).any("estimator").values]]
    where = f" at noise {', '.join(at)}" if len(at) < data.sizes["scale"] else ""
    return "absolute", names(data, "unit")[parameter], metrics.NO_PERCENTAGE[worst] + where


def errors(data: xr.Dataset) -> Figure | None:
    """RMS error of each parameter and estimator against the noise scale, with the Cramer-Rao bounds."""
    data = positive_scales(data)
    found, best = metrics.estimator_error(data), metrics.bound_error(data)
    if not data.sizes["scale"] or not found["absolute"].notnull().any():
        return None
    figure, axes = grid(data.sizes["parameter"], columns=_COLUMNS, height=2.2)
    x = data["scale"].values
    for place, (panel, name) in enumerate(zip(axes, names(data, "parameter"), strict=True)):
        kind, unit, why = error_unit(data, place)
        for dash, estimator in zip(BOUND_DASHES, bounds(data).values(), strict=False):
            y = best[kind].isel(parameter=place, estimator=estimator).values
            panel.plot(x, y, color=INK, linestyle=dash, linewidth=1.1, marker="_" if len(x) == 1 else None)
        _draw_estimators(panel, data, found[kind].isel(parameter=place))
        scale_axis(panel, x)
        log_axis(panel, "y")
        panel.set_title(f"{name} [{unit}]")
        if why:
            low, high = panel.get_ylim()
            panel.set_ylim(low, high * (high / low) ** 0.22)
            panel.text(0.03, 0.98, f"absolute: {why}", transform=panel.transAxes, va="top", fontsize=7)
    label_edges(axes, _COLUMNS, x="noise scale", y="RMS error")
    legend(figure, data, with_bounds=True)
    return figure


def efficiency(data: xr.Dataset) -> Figure | None:
    """RMSE / bound of each parameter and estimator against the noise scale, with Monte-Carlo intervals."""
    data = positive_scales(data)
    found = metrics.efficiency(data)
    if not data.sizes["scale"] or not found["efficiency"].notnull().any():
        return None
    figure, axes = grid(data.sizes["parameter"], columns=_COLUMNS, height=2.2)
    for place, (panel, name) in enumerate(zip(axes, names(data, "parameter"), strict=True)):
        panel.axhline(1, color=INK, linewidth=1.1)
        one = found.isel(parameter=place)
        _draw_estimators(panel, data, one["efficiency"], one)
        scale_axis(panel, data["scale"].values)
        panel.set_yscale("log")
        panel.set_title(name)
    label_edges(axes, _COLUMNS, x="noise scale", y="RMSE / bound")
    lows, highs = zip(*(panel.get_ylim() for panel in axes), strict=True)
    for panel in axes:
        panel.set_ylim(min(lows), max(highs))
        log_axis(panel, "y")
    legend(figure, data)
    return figure


def frontier(data: xr.Dataset) -> Figure | None:
    """The noise scale below which each parameter can be distinguished from 0, and the scales of the study."""
    limits = metrics.frontier(data)
    if not (limits > 0).any():
        return None
    parameters = names(data, "parameter")
    figure, (panel,) = grid(1, columns=1, width=7.0, height=0.5 * len(parameters) + 0.6)
    scales = data["scale"].values[data["scale"].values > 0]
    seen = bounds(data)
    least = min(float(limits.where(limits > 0).min()), float(scales.min()))
    for scale in scales:
        panel.axvline(scale, color=FAINT, linewidth=0.8, linestyle="dashed", zorder=0)
    for row, (channels, estimator) in enumerate(seen.items()):
        y = np.arange(len(parameters)) + 0.36 * (row - (len(seen) - 1) / 2)
        x = limits.isel(estimator=estimator).values
        finite = x > 0
        label = f"bound of channels: {channels}"
        panel.plot(x[finite], y[finite], "oDs"[row % 3], color=INK, fillstyle="none" if row else "full", label=label)
        for a, b in zip(x[finite], y[finite], strict=True):
            panel.annotate(plain(a, 2), (a, b), (6, 0), textcoords="offset points", va="center", fontsize=7)
    for y in np.flatnonzero((limits == 0).any("estimator").values):
        panel.text(least, float(y), "the truth is 0: no noise is small enough", va="center", fontsize=7.5)
    panel.set_xscale("log")
    log_axis(panel, "x")
    low, high = panel.get_xlim()
    panel.set_xlim(low, high * (high / low) ** 0.06)
    panel.set_yticks(range(len(parameters)), parameters)
    panel.set_ylim(len(parameters) - 0.5, -0.5)
    panel.set_xlabel("noise scale below which |truth| exceeds 1.96 bounds (dashed: the scales of this study)")
    if len(seen) > 1:
        figure.legend(loc="outside lower center", ncols=len(seen))
    return figure


def dodged(scales: np.ndarray, place: int, count: int) -> np.ndarray:
    """The noise scales, shifted for the estimator `place` of `count`, so that markers do not cover each other."""
    gap = np.diff(np.log(np.sort(scales))).min() if len(scales) > 1 else np.log(3.0)
    return scales * np.exp(_DODGE * gap * (place / max(count - 1, 1) - 0.5))


def _draw_estimators(panel, data: xr.Dataset, values: xr.DataArray, interval: xr.Dataset | None = None) -> None:
    style = styles(names(data, "estimator"))
    for place, look in enumerate(style.values()):
        y = values.isel(estimator=place).values
        x = data["scale"].values if interval is None else dodged(data["scale"].values, place, len(style))
        panel.plot(x, y, color=look.color, marker=look.marker, linestyle=look.dash, gid=estimator_gid(place))
        if interval is not None:
            low, high = (interval[end].isel(estimator=place).values for end in ("low", "high"))
            panel.vlines(x, low, high, color=look.color, linewidth=1.0, gid=estimator_gid(place))
    if not np.isfinite(values.values).any():
        panel.text(0.5, 0.5, "no estimates", transform=panel.transAxes, ha="center")
