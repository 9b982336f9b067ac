"""Plots the largest noise at which each parameter can be distinguished from 0.

One panel for each model and input, one row for each parameter. The vertical line is the noise of the standard sensors:
a parameter to its left cannot be distinguished from 0 with them.
"""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.drawing import grid, log_axis
from experiments.shared import load_results, plotter
from jaxos4.report.style import FAINT, INK, styles


def draw(data: xr.Dataset) -> Figure:
    """Colour and marker show the channels. Larger markers show longer flights."""
    frontier = data["frontier"]
    excitations, parameters = frontier["excitation"].values, frontier["parameter"].values
    looks = dict(zip(frontier["channels"].values, styles(["ibss", "network", "hybrid"]).values(), strict=False))
    figure, axes = grid(frontier.sizes["model"] * len(excitations), columns=len(excitations), height=2.6)
    sizes = 14 * 2 ** np.arange(frontier.sizes["duration"])
    low, high = float(frontier.where(frontier > 0).min()) / 3, float(frontier.max()) * 3
    for place, panel in enumerate(axes):
        one = frontier.isel(model=place // len(excitations), excitation=place % len(excitations))
        panel.axvline(1, color=INK, linewidth=1.0)
        for row, (channels, look) in enumerate(looks.items()):
            y = np.arange(len(parameters)) + 0.27 * (row - (len(looks) - 1) / 2)
            for size, duration in zip(sizes, one["duration"].values, strict=True):
                x = one.sel(channels=channels, duration=duration).values
                panel.scatter(
                    np.where(x > 0, x, np.nan),
                    y,
                    s=size,
                    color=look.color,
                    marker=look.marker,
                    alpha=0.75,
                    linewidths=0,
                )
        for words, where in (("not excited", one.isnull()), ("its truth is 0", one == 0)):
            for y in np.flatnonzero(where.all(("duration", "channels")).values):
                panel.text(low * 1.5, float(y), words, va="center", fontsize=7, color=FAINT)
        panel.set_xscale("log")
        panel.set_xlim(low, high)
        log_axis(panel, "x")
        panel.set_ylim(len(parameters) - 0.5, -0.5)
        panel.set_yticks(range(len(parameters)), parameters if place % len(excitations) == 0 else [])
        panel.set_title(f"{one['model'].item()}, {one['excitation'].item()}")
        if place >= len(axes) - len(excitations):
            panel.set_xlabel("noise scale")
    handles = [Line2D([], [], color=k.color, marker=k.marker, linestyle="none", label=n) for n, k in looks.items()]
    handles += [
        Line2D([], [], color=INK, marker="o", markersize=size**0.5, linestyle="none", label=f"{duration:g} s")
        for size, duration in zip(sizes, frontier["duration"].values, strict=True)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


main = plotter(load_results, {"frontier": draw})
