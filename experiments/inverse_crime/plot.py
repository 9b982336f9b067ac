"""Plots RMSE / bound (above) and the largest bias of any parameter (below).

One column for each method of the fit, one line for each method of the simulation.
"""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from experiments.drawing import grid, log_axis, scale_axis
from experiments.shared import draw_spread, plotter, read_each
from jaxos4.report.style import FAINT, INK, styles
from jaxos4.study import metrics

# 95 % quantile of the largest of eight Gaussian magnitudes, in standard deviations.
LARGEST_OF_EIGHT = 2.73


def bias(data: xr.Dataset) -> xr.DataArray:
    """The largest mean error of any parameter, in bounds."""
    return abs(metrics.normalised_error(data).mean("flight")).max("parameter")


def draw(studies: dict[str, xr.Dataset]) -> Figure:
    """`studies`: one for each method of the fit."""
    figure, axes = grid(2 * len(studies), columns=len(studies), height=2.4)
    rows = axes[: len(studies)], axes[len(studies) :]
    for above, below, (name, data) in zip(*rows, studies.items(), strict=True):
        data = data.squeeze([d for d in metrics.SCENARIO if d not in ("method", "scale")])
        scales = data["scale"].values
        above.axhline(1, color=INK, linewidth=1.0)
        below.axhline(LARGEST_OF_EIGHT / data.sizes["flight"] ** 0.5, color=FAINT, linestyle="dashed", linewidth=1.0)
        for method, look in zip(data["method"].values, styles(["ibss", "network", "hybrid"]).values(), strict=False):
            one = data.sel({"method": method})  # by name: `sel` has an argument `method` of its own
            draw_spread(above, scales, metrics.efficiency(one)["efficiency"], look, f"flown by {method}")
            below.plot(scales, bias(one).values, color=look.color, marker=look.marker, linestyle=look.dash)
        above.set_title(f"fitted by {name}")
        below.set_xlabel("noise scale")
    for row, label in zip(rows, ("RMSE / bound", "largest |bias| / bound"), strict=True):
        row[0].set_ylabel(label)
        for panel in row:
            panel.set_yscale("log")
        limits = np.array([panel.get_ylim() for panel in row])
        for panel in row:
            panel.set_ylim(limits.min(), limits.max())
            log_axis(panel, "y")
            scale_axis(panel, scales)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


main = plotter(read_each, {"inverse_crime": draw})
