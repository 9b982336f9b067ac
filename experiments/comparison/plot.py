"""The comparison as a coloured table: rows are estimators, columns are parameters, panels are noise scales."""

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from experiments.drawing import grid
from experiments.shared import plotter, read_by_noise
from jaxos4.report.study_tables import error_unit
from jaxos4.report.style import INK, PAPER
from jaxos4.report.text import plain
from jaxos4.study import metrics

WORST = 30.0


def draw(data: xr.Dataset) -> Figure:
    """Numbers: RMS errors, in percent if that has a meaning. Colour: RMS error / smallest bound of any estimator."""
    found, least = metrics.estimator_error(data), metrics.bound_error(data)["absolute"].min("estimator")
    ratio = (found["absolute"] / least).transpose("scale", "estimator", "parameter").values
    kinds = [error_unit(data, place)[:2] for place in range(data.sizes["parameter"])]
    labels = [f"{name}\n[{unit}]" for name, (_, unit) in zip(data["parameter"].values, kinds, strict=True)]
    rows = data.sizes["estimator"]
    figure, axes = grid(data.sizes["scale"], columns=1, width=8.0, height=0.26 * rows + 0.55)
    norm, colors = LogNorm(0.8, WORST), colormaps["Blues"]
    for place, panel in enumerate(axes):
        image = panel.imshow(np.ma.masked_invalid(ratio[place]), norm=norm, cmap=colors, aspect="auto")
        for row in range(rows):
            for column, (kind, _) in enumerate(kinds):
                value = float(found[kind].isel(scale=place, estimator=row, parameter=column))
                dark = np.isfinite(ratio[place, row, column]) and norm(ratio[place, row, column]) > 0.65
                color = PAPER if dark else INK
                panel.text(column, row, plain(value, 2), ha="center", va="center", fontsize=7.5, color=color)
        panel.set_yticks(range(rows), data["estimator"].values)
        panel.set_xticks(range(len(labels)), labels if place == len(axes) - 1 else [])
        panel.tick_params(length=0)
        panel.grid(visible=False)
        panel.set_title(f"noise scale {data['scale'].values[place]:g}")
    ticks = [1, 2, 5, 10, WORST]
    bar = figure.colorbar(image, ax=axes, shrink=0.6, extend="max", label="RMS error / least bound")
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.ax.set_yticks([], minor=True)
    return figure


main = plotter(read_by_noise, {"comparison": draw})
