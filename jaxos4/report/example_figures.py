"""Figures of the example flight and of the training: search, trajectories, path in space, loss."""

from collections.abc import Callable

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from .study_data import names
from .style import FAINT, INK, estimator_gid, grid, label_edges, legend, log_axis, style, styles


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
            y, look = values.isel(parameter=place).values, style(place)
            shape = {"color": look.color, "marker": look.marker, "linestyle": look.dash, "markersize": 4}
            panel.plot(data["sweep"].values, np.where(y > 0, y, np.nan), label=name, **shape)
        panel.set_title(title)
        panel.set_xlabel("sweep")
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
        log_axis(panel, "y")
    axes[0].set_ylabel("in first half-widths")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=8, handlelength=2.5)
    return figure


def trajectories(data: xr.Dataset) -> Figure | None:
    """The example flight: measured, true, and simulated with each estimate."""

    def draw(panel: Axes, state: int) -> None:
        panel.plot(data["time"], data["example_measured"].isel(state=state), ".", color=FAINT, markersize=2)
        panel.plot(data["time"], data["example_true"].isel(state=state), color=INK, linewidth=1.0)
        _draw_simulations(panel, data, data["example_simulated"].isel(state=state))

    return _each_state(data, draw)


def deviations(data: xr.Dataset) -> Figure | None:
    """The example flight: deviation of each simulation from the truth."""

    def draw(panel: Axes, state: int) -> None:
        panel.axhline(0, color=INK, linewidth=0.8)
        _draw_simulations(panel, data, (data["example_simulated"] - data["example_true"]).isel(state=state))

    return _each_state(data, draw)


def path(data: xr.Dataset) -> Figure | None:
    """The example flight in space."""
    if "example_true" not in data:
        return None
    at = [names(data, "state").index(axis) for axis in "xyz"]
    if not np.isfinite(data["example_true"].isel(state=at).values).any():
        return None
    figure = Figure(figsize=(6.5, 5.0), layout="constrained")
    panel = figure.add_subplot(projection="3d")
    panel.plot(*data["example_measured"].isel(state=at).values.T, ".", color=FAINT, markersize=1.5, label="measured")
    panel.plot(*data["example_true"].isel(state=at).values.T, color=INK, linewidth=1.2)
    for place, look in enumerate(styles(names(data, "estimator")).values()):
        line = data["example_simulated"].isel(estimator=place, state=at).values
        if np.isfinite(line).any():
            panel.plot(*line.T, color=look.color, linestyle=look.dash, linewidth=1.0, gid=estimator_gid(place))
    for name, label in zip("xyz", (panel.set_xlabel, panel.set_ylabel, panel.set_zlabel), strict=True):
        label(f"{name} [m]")
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
            shape = {"color": style(row).color, "marker": style(row).marker, "linestyle": style(row).dash}
            panel.plot(one["training_step"].values, losses[row], label=name, markersize=3.5, **shape)
        if not (losses <= 0).any() and np.isfinite(losses).any():
            log_axis(panel, "y")
        panel.set_title(label)
        panel.set_xlabel("step")
        if place % 3 == 0:
            panel.set_ylabel("loss")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _each_state(data: xr.Dataset, draw: Callable[[Axes, int], None]) -> Figure | None:
    """A panel for each state that was measured."""
    if "example_measured" not in data:
        return None
    known = data["example_measured"].notnull() & data["example_true"].notnull()
    shown = [int(state) for state in np.flatnonzero(known.any("sample").values)]
    if not shown:
        return None
    figure, axes = grid(len(shown), columns=3, height=1.75)
    for panel, state in zip(axes, shown, strict=True):
        draw(panel, state)
        one = data["state"].isel(state=state)
        panel.set_title(f"{one.item()} [{data['state_unit'].isel(state=state).item()}]")
    label_edges(axes, 3, x="time [s]")
    legend(figure, names(data, "estimator"), markers=False)
    return figure


def _draw_simulations(panel: Axes, data: xr.Dataset, values: xr.DataArray) -> None:
    for place, look in enumerate(styles(names(data, "estimator")).values()):
        y = values.isel(estimator=place).values
        if np.isfinite(y).any():
            panel.plot(data["time"], y, color=look.color, linestyle=look.dash, linewidth=1.1, gid=estimator_gid(place))
