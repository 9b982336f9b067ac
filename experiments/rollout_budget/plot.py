"""Plots RMSE / bound, averaged over the parameters, against rollouts. One line for each search."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from experiments.drawing import grid, log_axis
from experiments.shared import load_results, plotter
from jaxos4.report.style import INK, styles

SEARCHES = ("IBSS", "output error", "hybrid")
LOOKS = dict(zip(SEARCHES, styles(["ibss", "output-error", "hybrid"]).values(), strict=True))


def accuracy(data: xr.Dataset) -> xr.DataArray:
    """RMSE / bound, as the geometric mean of the parameters."""
    return np.exp(np.log((data["error"] ** 2).mean("flight") ** 0.5).mean("parameter"))


def draw(data: xr.Dataset) -> Figure:
    """One marker for each limit of sweeps or steps."""
    figure, axes = grid(data.sizes["channels"], columns=2, height=3.2, width=4.2 * data.sizes["channels"] + 0.6)
    reached, spent = accuracy(data), data["rollouts"].mean("flight")
    for panel, channels in zip(axes, data["channels"].values, strict=True):
        panel.axhline(1, color=INK, linewidth=1.0)
        for name in data["search"].values:
            look = LOOKS[name]
            one = {"channels": channels, "search": name}
            x, y = spent.sel(one), reached.sel(one)
            panel.plot(x, y, color=look.color, marker=look.marker, linestyle=look.dash, label=name, alpha=0.9)
        panel.set_xscale("log")
        panel.set_yscale("log")
        log_axis(panel, "x")
        log_axis(panel, "y")
        panel.set_title({"rates": "body rates", "all": "all channels"}.get(str(channels), str(channels)))
        panel.set_xlabel("rollouts for one flight")
    axes[0].set_ylabel("RMSE / bound, mean of the parameters")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


main = plotter(load_results, {"rollout_budget": draw})
