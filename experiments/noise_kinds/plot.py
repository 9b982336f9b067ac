"""RMSE / bound of white noise, and coverage of 95 % intervals, for each kind of noise."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from experiments.drawing import grid, log_axis
from experiments.shared import draw_spread, plotter
from jaxos4.report.style import INK, styles
from jaxos4.study import metrics, read_results

LEVEL = 0.95


def draw(data: xr.Dataset) -> Figure:
    """For each kind of noise: the mean over the parameters, with a bar from the smallest to the largest."""
    data = data.squeeze([d for d in metrics.SCENARIO if d not in ("noise", "estimator")])
    figure, (left, right) = grid(2, columns=2, height=2.9)
    style = styles(list(data["estimator"].values))
    kinds = data["noise"].values
    covered = metrics.coverage(data).sel(level=LEVEL)["coverage"]
    left.axhline(1, color=INK, linewidth=1.0)
    right.axhline(100 * LEVEL, color=INK, linewidth=1.0)
    for place, (name, look) in enumerate(style.items()):
        x = np.arange(len(kinds)) + 0.5 * (place / max(len(style) - 1, 1) - 0.5)
        look = look._replace(dash="none")
        draw_spread(left, x, metrics.efficiency(data.sel(estimator=name))["efficiency"], look, name)
        draw_spread(right, x, 100 * covered.sel(estimator=name), look, name)
    left.set_yscale("log")
    log_axis(left, "y")
    left.set_title("RMSE / bound of white noise")
    right.set_title(f"{100 * LEVEL:g} % intervals that hold the truth [%]")
    for panel in (left, right):
        panel.set_xticks(range(len(kinds)), kinds)
        panel.grid(axis="x", visible=False)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=len(style))
    return figure


main = plotter(read_results, {"noise_kinds": draw})
