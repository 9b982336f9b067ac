"""Figures of a study: of one scenario, of the example flight, and of the training.

Each function returns `None` if its data are absent.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from ..results import NINETY_FIVE
from ..study import metrics
from .study_data import bounds, error_unit, names, nearest_scale, positive_scales
from .style import (
    BOUND_DASHES,
    FAINT,
    INK,
    Style,
    estimator_gid,
    grid,
    label_edges,
    legend,
    log_axis,
    scale_axis,
    style,
    styles,
)
from .text import plain

_COLUMNS = 4
# The markers of all estimators are spread over this share of the gap between two noise scales.
_DODGE = 0.3
# The quantiles that a box shows. The whiskers hold 95 % of the flights.
_QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
# The place on a logarithmic axis for an estimator without rollouts.
_NO_ROLLOUTS = 0.5


def errors(data: xr.Dataset) -> Figure | None:
    """RMS error of each parameter and estimator against the noise scale, with the Cramer-Rao bounds."""
    data = positive_scales(data)
    found, best, seen = metrics.estimator_error(data), metrics.bound_error(data), bounds(data)
    units = [error_unit(data, place) for place in range(data.sizes["parameter"])]
    values = [found[kind].isel(parameter=place) for place, (kind, _, _) in enumerate(units)]
    figure, x = _against_noise(data, values, "RMS error", bounds=list(seen)), data["scale"].values
    if figure is None:
        return None
    for place, (panel, (kind, unit, why)) in enumerate(zip(figure.axes, units, strict=True)):
        for dash, estimator in zip(BOUND_DASHES, seen.values(), strict=False):
            y = best[kind].isel(parameter=place, estimator=estimator).values
            marker = "_" if len(x) == 1 else None
            panel.plot(x, y, color=INK, linestyle=dash, linewidth=1.1, marker=marker, zorder=1.9)
        log_axis(panel, "y")
        panel.set_title(f"{names(data, 'parameter')[place]} [{unit}]")
        if why:
            low, high = panel.get_ylim()
            panel.set_ylim(low, high * (high / low) ** 0.22)
            panel.text(0.03, 0.98, f"absolute: {why}", transform=panel.transAxes, va="top", fontsize=7)
    return figure


def efficiency(data: xr.Dataset) -> Figure | None:
    """RMSE / bound of each parameter and estimator against the noise scale, with Monte-Carlo intervals."""
    data = positive_scales(data)
    found = metrics.efficiency(data)
    values = [found["efficiency"].isel(parameter=place) for place in range(data.sizes["parameter"])]
    figure = _against_noise(data, values, "RMSE / bound", interval=found)
    if figure is None:
        return None
    for panel in figure.axes:
        panel.axhline(1, color=INK, linewidth=1.1, zorder=1.9)
    lows, highs = zip(*(panel.get_ylim() for panel in figure.axes), strict=True)
    for panel in figure.axes:
        panel.set_ylim(min(lows), max(highs))
        log_axis(panel, "y")
    return figure


def _against_noise(
    data: xr.Dataset,
    values: list[xr.DataArray],
    label: str,
    *,
    interval: xr.Dataset | None = None,
    bounds: Sequence[str] = (),
) -> Figure | None:
    """A panel for each parameter: its `values` for each estimator against the noise scale, with intervals if any."""
    if not any(one.notnull().any() for one in values):
        return None
    figure, axes = grid(len(values), columns=_COLUMNS, height=2.2)
    scales = data["scale"].values
    for parameter, (panel, name) in enumerate(zip(axes, names(data, "parameter"), strict=True)):
        for place, look in _looks(data):
            x = scales if interval is None else dodged(scales, place, data.sizes["estimator"])
            panel.plot(x, values[parameter].isel(estimator=place).values, gid=estimator_gid(place), **look.line)
            if interval is not None:
                one = interval.isel(parameter=parameter, estimator=place)
                ends = one["low"].values, one["high"].values
                panel.vlines(x, *ends, color=look.color, linewidth=1.0, gid=estimator_gid(place))
        if not np.isfinite(values[parameter].values).any():
            panel.text(0.5, 0.5, "no estimates", transform=panel.transAxes, ha="center")
        scale_axis(panel, scales)
        panel.set_yscale("log")
        panel.set_title(name)
    label_edges(axes, _COLUMNS, x="noise scale", y=label)
    legend(figure, names(data, "estimator"), bounds=bounds)
    return figure


def distribution(data: xr.Dataset) -> Figure | None:
    """Boxes of error / bound of each parameter and estimator at the noise scale nearest 1."""
    every = metrics.normalised_error(data.isel(scale=nearest_scale(data)))
    some = every.notnull().any("flight")
    if not some.any():
        return None
    found = every.where(some, 0.0).quantile(list(_QUANTILES), dim="flight").where(some)
    estimators = names(data, "estimator")
    figure, axes = grid(data.sizes["parameter"], columns=_COLUMNS, height=0.28 * len(estimators) + 0.75)
    # Wide enough for the boxes, but limited in case one estimator is very bad.
    reach = float(np.clip(1.08 * np.nanmax(np.abs(found.values), initial=0.0), 3.0, 12.0))
    for place, (panel, name) in enumerate(zip(axes, names(data, "parameter"), strict=True)):
        for x in (-NINETY_FIVE, NINETY_FIVE):
            panel.axvline(x, color=FAINT, linestyle="dashed", linewidth=0.8)
        panel.axvline(0, color=INK, linewidth=0.8)
        for row, look in _looks(data):
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
        panel.set_ylim(len(estimators) - 0.4, -0.6)
        panel.set_yticks(range(len(estimators)), estimators if place % _COLUMNS == 0 else [])
        panel.grid(axis="y", visible=False)
    label_edges(axes, _COLUMNS, x="error / bound")
    return figure


def coverage(data: xr.Dataset) -> Figure | None:
    """Share of intervals that hold the truth against the level that they claim, at each noise scale."""
    found = metrics.mean_coverage(data)
    if not found["coverage"].notnull().any():
        return None
    estimators, levels, count = names(data, "estimator"), data["level"].values, data.sizes["scale"]
    figure, axes = grid(count, columns=_COLUMNS, width=2.25 * min(count, _COLUMNS) + 1.2, height=2.8)
    lowest = min(float(found["low"].min()), float(levels.min())) - 0.04
    for place, panel in enumerate(axes):
        one = found.isel(scale=place)
        for x, level in enumerate(levels):
            panel.hlines(level, x - 0.45, x + 0.45, color=INK, linewidth=1.4)
        for row, look in _looks(data):
            shift = 0.7 * (row / max(len(estimators) - 1, 1) - 0.5)
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
    for panel in axes[::_COLUMNS]:
        panel.set_ylabel("intervals that hold the truth")
    legend(figure, estimators, lines=False)
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
    for row, look in _looks(data):
        at = known[:, row]
        across, up = np.maximum(x.isel(estimator=row).values[at], _NO_ROLLOUTS), y.isel(estimator=row).values[at]
        panel.plot(across, up, color=look.color, linestyle=look.dash, linewidth=1.0, gid=estimator_gid(row))
        marks = {"color": look.color, "marker": look.marker, "alpha": 0.8, "linewidths": 0}
        for place, a, b in zip(np.flatnonzero(at), across, up, strict=True):
            tip = f"noise x {data['scale'].values[place]:g}: {plain(float(x[place, row]))} rollouts, {plain(float(b))}"
            panel.scatter(a, b, s=26 + 30 * place, gid=estimator_gid(row, tip), **marks)
    log_axis(panel, "x")
    log_axis(panel, "y")
    spent = x.values[x.notnull().values]
    top = int(np.ceil(np.log10(max(float(spent.max()), 10.0))))
    ticks = {_NO_ROLLOUTS: "none"} if (spent <= 0).any() else {}
    ticks |= {10.0**power: f"{10**power:,}" for power in range(top + 1)}
    panel.set_xticks(list(ticks), list(ticks.values()))
    panel.set_xlim(min(ticks) / 1.5 if 0 in np.floor(spent) else None, max(ticks) * 1.2)
    scales = ", ".join(f"{scale:g}" for scale in data["scale"].values)
    panel.set_xlabel(f"rollouts for one flight (larger markers: larger noise scale of {scales})")
    panel.set_ylabel("RMSE / least bound, mean of all parameters")
    legend(figure, names(data, "estimator"))
    return figure


def dodged(scales: np.ndarray, place: int, count: int) -> np.ndarray:
    """The noise scales, shifted for the estimator `place` of `count`, so that markers do not cover each other."""
    gap = np.diff(np.log(np.sort(scales))).min() if len(scales) > 1 else np.log(3.0)
    return scales * np.exp(_DODGE * gap * (place / max(count - 1, 1) - 0.5))


def _looks(data: xr.Dataset) -> Iterator[tuple[int, Style]]:
    """The index and the style of each estimator."""
    return enumerate(styles(names(data, "estimator")).values())


def search(data: xr.Dataset) -> Figure | None:
    """Half-widths and centres of the brackets of IBSS after each sweep, in units of the first half-widths."""
    if "search_half_width" not in data:
        return None
    width = data["search_half_width"].transpose("sweep", "parameter")
    first = width.isel(sweep=0)
    moves = abs(data["search_estimate"] - data["search_estimate"].isel(sweep=-1)) / first
    figure, axes = grid(2, columns=2, height=3.2)
    titles = ("half-width of the bracket", "distance to the last estimate")
    for panel, values, title in zip(axes, (width / first, moves.transpose("sweep", "parameter")), titles, strict=True):
        for place, name in enumerate(names(data, "parameter")):
            y = values.isel(parameter=place).values
            panel.plot(data["sweep"].values, np.where(y > 0, y, np.nan), label=name, markersize=4, **style(place).line)
        panel.set_title(title)
        panel.set_xlabel("sweep")
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
        log_axis(panel, "y")
    axes[0].set_ylabel("in first half-widths")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=8, handlelength=2.5)
    return figure


def trajectories(data: xr.Dataset, *, minus_truth: bool = False) -> Figure | None:
    """The example flight: measured, true, and simulated with each estimate; or the simulations minus the truth.

    A panel for each state that was measured.
    """
    if "example_measured" not in data:
        return None
    known = data["example_measured"].notnull() & data["example_true"].notnull()
    shown = np.flatnonzero(known.any("sample").values).tolist()
    if not shown:
        return None
    figure, axes = grid(len(shown), columns=3, height=1.75)
    for panel, state in zip(axes, shown, strict=True):
        one = data.isel(state=state)
        simulated = one["example_simulated"]
        if minus_truth:
            simulated = simulated - one["example_true"]
            panel.axhline(0, color=INK, linewidth=0.8)
        else:
            panel.plot(one["time"], one["example_measured"], ".", color=FAINT, markersize=2)
            panel.plot(one["time"], one["example_true"], color=INK, linewidth=1.0)
        for row, look in _looks(data):
            y, gid = simulated.isel(estimator=row).values, estimator_gid(row)
            if np.isfinite(y).any():
                panel.plot(one["time"], y, color=look.color, linestyle=look.dash, linewidth=1.1, gid=gid)
        panel.set_title(f"{one['state'].item()} [{one['state_unit'].item()}]")
    label_edges(axes, 3, x="time [s]")
    legend(figure, names(data, "estimator"), markers=False)
    return figure


def training(data: xr.Dataset) -> Figure | None:
    """The training loss and the validation loss of each network."""
    if "training_loss" not in data:
        return None
    labels = names(data, "training")
    figure, axes = grid(len(labels), columns=3, width=3.2 * min(len(labels), 3) + 0.6, height=2.6)
    for place, (panel, label) in enumerate(zip(axes, labels, strict=True)):
        one = data.isel(training=place)
        losses = np.stack([one["training_loss"].values, one["validation_loss"].values])
        for row, name in enumerate(("training", "validation")):
            panel.plot(one["training_step"].values, losses[row], label=name, markersize=3.5, **style(row).line)
        if not (losses <= 0).any() and np.isfinite(losses).any():
            log_axis(panel, "y")
        panel.set_title(label)
        panel.set_xlabel("step")
    for panel in axes[::3]:
        panel.set_ylabel("loss")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure
