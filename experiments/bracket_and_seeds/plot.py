"""Plots RMSE / bound, hit rate and rollouts against the width of the bracket, with one line for each seed."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from experiments.drawing import grid, log_axis
from experiments.shared import plotter, read_each
from jaxos4.report.study_page import dodged
from jaxos4.report.style import INK, styles
from jaxos4.study import metrics


def draw(studies: dict[str, xr.Dataset]) -> Figure:
    """One panel for each quantity. `studies`: one for each seed."""
    figure, (above, middle, right) = grid(3, columns=3, height=2.8)
    above.axhline(1, color=INK, linewidth=1.0)
    for seed, data in enumerate(studies.values()):
        data = data.squeeze([d for d in metrics.SCENARIO if d not in ("width", "estimator")])
        x = dodged(data["width"].values, seed, len(studies)) if len(studies) > 1 else data["width"].values
        for name, look in styles(list(data["estimator"].values)).items():
            one = data.sel(estimator=name)
            line = {"color": look.color, "marker": look.marker, "linestyle": look.dash, "linewidth": 0.9}
            above.plot(x, metrics.efficiency(one)["efficiency"].max("parameter"), label=name, **line)
            right.plot(x, metrics.mean_rollouts(one).where(one["rollouts"].max("flight") > 0), **line)
            hits = metrics.hit_rate(one)
            if hits["hit_rate"].notnull().any():
                middle.plot(x, 100 * hits["hit_rate"], **line)
                middle.vlines(x, 100 * hits["low"], 100 * hits["high"], color=look.color, linewidth=1.0)
    widths = next(iter(studies.values()))["width"].values
    for panel, title in (
        (above, "RMSE / bound, worst parameter"),
        (middle, "seeds that hold the truth [%]"),
        (right, "rollouts for one flight"),
    ):
        panel.set_title(title)
        panel.set_xscale("log")
        panel.set_xticks(widths, [f"{width:g}" for width in widths])
        panel.set_xticks([], minor=True)
        panel.set_xlabel("half-width of the bracket / default")
    for panel in (above, right):
        panel.set_yscale("log")
        log_axis(panel, "y")
    handles, labels = above.get_legend_handles_labels()
    kept = np.unique(labels, return_index=True)[1]
    figure.legend([handles[i] for i in kept], [labels[i] for i in kept], loc="outside lower center", ncols=3)
    return figure


main = plotter(read_each, {"bracket_and_seeds": draw})
