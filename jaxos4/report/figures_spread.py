"""Figures of the scatter of estimates: distribution of errors, coverage of intervals, accuracy against rollouts."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from ..results import NINETY_FIVE
from ..study import metrics
from .figures_noise import positive_scales
from .legend import legend
from .numbers import plain
from .scenario import names
from .style import FAINT, INK, estimator_gid, grid, label_edges, log_axis, styles

# The quantiles that a box shows. The whiskers hold 95 % of the flights.
_QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
# The place on a logarithmic axis for an estimator without rollouts.
_NO_ROLLOUTS = 0.5


def nearest_scale(data: xr.Dataset) -> int:
    """The index of the noise scale nearest 1 (by ratio). Figures of one scale show it."""
    scales = data["scale"].values
    positive = np.where(scales > 0, scales, np.finfo(float).tiny)
    return int(np.argmin(np.abs(np.log(positive))))


def distribution(data: xr.Dataset, drawn: Figure | None = None) -> Figure | None:
    """Boxes of error / bound of each parameter and estimator at the noise scale nearest 1.

    `drawn`: this figure of another scale, whose boxes are replaced. It keeps its layout, which takes half of the time.
    """
    every = metrics.normalised_error(data.isel(scale=nearest_scale(data)))
    some = every.notnull().any("flight")
    if not some.any():
        return None
    found = every.where(some, 0.0).quantile(list(_QUANTILES), dim="flight").where(some)
    style = styles(names(data, "estimator"))
    if drawn is None:
        drawn, _ = grid(data.sizes["parameter"], columns=4, height=0.28 * len(style) + 0.75)
    # Wide enough for the boxes, but limited in case one estimator is very bad.
    reach = float(np.clip(1.08 * np.nanmax(np.abs(found.values), initial=0.0), 3.0, 12.0))
    for place, (panel, name) in enumerate(zip(drawn.axes, names(data, "parameter"), strict=True)):
        for old in (*panel.lines, *panel.texts):
            old.remove()
        for x in (-NINETY_FIVE, NINETY_FIVE):
            panel.axvline(x, color=FAINT, linestyle="dashed", linewidth=0.8)
        panel.axvline(0, color=INK, linewidth=0.8)
        for row, look in enumerate(style.values()):
            low, first, middle, third, high = found.isel(parameter=place, estimator=row).values
            if not np.isfinite(middle):
                panel.text(0, row, "no estimates", va="center", ha="center", fontsize=7, gid=estimator_gid(row))
                continue
            tip = f"median {middle:.2g}, quartiles {first:.2g} to {third:.2g}, 95 % {low:.2g} to {high:.2g}"
            marks: dict[str, Any] = {"color": look.color, "gid": estimator_gid(row, tip)}
            panel.plot([low, high], [row, row], linewidth=1.2, solid_capstyle="butt", **marks)
            panel.plot([first, third], [row, row], linewidth=7, solid_capstyle="butt", alpha=0.55, **marks)
            panel.plot([middle], [row], marker=look.marker, markersize=4.5, **marks)
        panel.set_title(name)
        panel.set_xlim(-reach, reach)
        panel.set_ylim(len(style) - 0.4, -0.6)
        panel.set_yticks(range(len(style)), list(style) if place % 4 == 0 else [])
        panel.grid(axis="y", visible=False)
    label_edges(drawn.axes, 4, x="error / bound")
    return drawn


def coverage(data: xr.Dataset) -> Figure | None:
    """Share of intervals that hold the truth against the level that they claim, at each noise scale."""
    found = metrics.mean_coverage(data)
    if not found["coverage"].notnull().any():
        return None
    style, levels = styles(names(data, "estimator")), data["level"].values
    figure, axes = grid(data.sizes["scale"], columns=4, width=2.25 * min(data.sizes["scale"], 4) + 1.2, height=2.8)
    lowest = min(float(found["low"].min()), float(levels.min())) - 0.04
    for place, panel in enumerate(axes):
        one = found.isel(scale=place)
        for x, level in enumerate(levels):
            panel.hlines(level, x - 0.45, x + 0.45, color=INK, linewidth=1.4)
        for row, look in enumerate(style.values()):
            shift = 0.7 * (row / max(len(style) - 1, 1) - 0.5)
            at, part, gid = np.arange(len(levels)) + shift, one.isel(estimator=row), estimator_gid(row)
            panel.vlines(at, part["low"].values, part["high"].values, color=look.color, linewidth=1.0, gid=gid)
            shares = part["coverage"].values
            panel.plot(at, shares, color=look.color, marker=look.marker, linestyle="none", markersize=4, gid=gid)
        panel.set_title(f"noise scale {data['scale'].values[place]:g}")
        panel.set_xticks(range(len(levels)), [f"{100 * level:g} %" for level in levels])
        panel.set_ylim(lowest, 1.02)
        panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:g} %"))
        panel.grid(axis="x", visible=False)
        panel.set_xlabel("level claimed")
        if place % 4 == 0:
            panel.set_ylabel("intervals that hold the truth")
    legend(figure, data, lines=False)
    return figure


def rollouts(data: xr.Dataset) -> Figure | None:
    """RMSE / least bound (mean of all parameters) against rollouts; a line joins the noise scales of an estimator."""
    data = positive_scales(data)
    x, y = (of(data).transpose("scale", "estimator") for of in (metrics.mean_rollouts, metrics.accuracy))
    known = (x.notnull() & y.notnull()).values
    if not known.any():
        return None
    figure, (panel,) = grid(1, columns=1, width=7.0, height=3.6)
    panel.axhline(1, color=INK, linewidth=1.1)
    for row, look in enumerate(styles(names(data, "estimator")).values()):
        at = known[:, row]
        across, up = np.maximum(x.isel(estimator=row).values[at], _NO_ROLLOUTS), y.isel(estimator=row).values[at]
        panel.plot(across, up, color=look.color, linestyle=look.dash, linewidth=1.0, gid=estimator_gid(row))
        for place, a, b in zip(np.flatnonzero(at), across, up, strict=True):
            tip = f"noise x {data['scale'].values[place]:g}: {plain(float(x[place, row]))} rollouts, {plain(float(b))}"
            marks = {"color": look.color, "marker": look.marker, "alpha": 0.8, "linewidths": 0}
            panel.scatter(a, b, s=26 + 30 * place, gid=estimator_gid(row, tip), **marks)
    log_axis(panel, "x")
    log_axis(panel, "y")
    _rollout_ticks(panel, x.values[x.notnull().values])
    scales = ", ".join(f"{scale:g}" for scale in data["scale"].values)
    panel.set_xlabel(f"rollouts for one flight (larger markers: larger noise scale of {scales})")
    panel.set_ylabel("RMSE / least bound, mean of all parameters")
    legend(figure, data)
    return figure


def _rollout_ticks(panel, spent: np.ndarray) -> None:
    top = int(np.ceil(np.log10(max(float(spent.max()), 10.0))))
    ticks = {_NO_ROLLOUTS: "none"} if (spent <= 0).any() else {}
    ticks |= {10.0**power: f"{10**power:,}" for power in range(top + 1)}
    panel.set_xticks(list(ticks), list(ticks.values()))
    panel.set_xlim(min(ticks) / 1.5 if 0 in np.floor(spent) else None, max(ticks) * 1.2)
