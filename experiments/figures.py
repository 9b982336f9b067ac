"""The figures of the experiments: `python -m experiments NAME.plot data/NAME figures` writes each as SVG and PDF."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments import figures_of_flights
from experiments.drawing import draw_spread, grid, legend, line, log_axis, name_axis, plotter, scale_axis
from experiments.shared import load_results
from jaxos4.report import study_figures
from jaxos4.report.matplotlib_figures import as_matplotlib
from jaxos4.report.panels import FAINT, INK, PAPER, styles
from jaxos4.report.study_tables import error_unit
from jaxos4.report.text import plain
from jaxos4.results import NINETY_FIVE
from jaxos4.study import metrics, read_results

WORST = 30.0  # RMS error / least bound; the darkest colour
LARGEST_OF_EIGHT = 2.73  # 95 % quantile of the largest of eight Gaussian magnitudes, in standard deviations
REJECTED = 0.01  # a p-value below which residuals are rejected
TESTS = {"white_p": "white", "input_p": "free of\ninputs", "level_p": "of the\nnoise's size"}
CHANNELS = {"rates": "body rates", "all": "all channels"}
SEARCHES = dict(
    zip(("IBSS", "output error", "hybrid"), styles(["ibss", "output-error", "hybrid"]).values(), strict=True)
)
THREE = tuple(styles(["ibss", "network", "hybrid"]).values())  # looks of what is no estimator


def squeezed(data: xr.Dataset, *kept: str) -> xr.Dataset:
    """The Dataset of a study by these axes alone."""
    return data.squeeze([name for name in metrics.SCENARIO if name not in kept])


def comparison(data: xr.Dataset) -> Figure:
    """RMS errors as a coloured table: rows are estimators, columns are parameters, panels are noise scales.

    Numbers are in percent if that has a meaning. Colour: RMS error / smallest bound of any estimator.
    """
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


def noise_kinds(data: xr.Dataset) -> Figure:
    """For each kind of noise: the mean over the parameters, with a bar from the smallest to the largest."""
    data = squeezed(data, "noise", "estimator")
    figure, (left, right) = grid(2, columns=2, height=2.9)
    looks, kinds = styles(list(data["estimator"].values)), data["noise"].values
    covered = metrics.coverage(data).sel(level=0.95)["coverage"]
    left.axhline(1, color=INK, linewidth=1.0)
    right.axhline(95, color=INK, linewidth=1.0)
    for place, (name, look) in enumerate(looks.items()):
        x = np.arange(len(kinds)) + 0.5 * (place / max(len(looks) - 1, 1) - 0.5)
        look = look._replace(dash="none")
        draw_spread(left, x, metrics.efficiency(data.sel(estimator=name))["efficiency"], look, name)
        draw_spread(right, x, 100 * covered.sel(estimator=name), look, name)
    log_axis(left, "y")
    left.set_title("RMSE / bound of white noise")
    right.set_title("95 % intervals that hold the truth [%]")
    for panel in (left, right):
        name_axis(panel, kinds)
    legend(figure, left, len(looks))
    return figure


def frontier(data: xr.Dataset) -> Figure:
    """The largest noise at which each parameter can be distinguished from 0: a panel for each model and input.

    Colour and marker show the channels. Larger markers show longer flights. The vertical line is the noise of the
    standard sensors: a parameter to its left cannot be distinguished from 0 with them.
    """
    frontier = data["frontier"]
    excitations, parameters = frontier["excitation"].values, frontier["parameter"].values
    looks = dict(zip(frontier["channels"].values, THREE, strict=False))
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
                dots = {"s": size, "color": look.color, "marker": look.marker, "alpha": 0.75, "linewidths": 0}
                panel.scatter(np.where(x > 0, x, np.nan), y, **dots)
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


def accuracy(data: xr.Dataset) -> xr.DataArray:
    """RMSE / bound, as the geometric mean of the parameters."""
    return np.exp(np.log((data["error"] ** 2).mean("flight") ** 0.5).mean("parameter"))


def rollout_budget(data: xr.Dataset) -> Figure:
    """RMSE / bound against rollouts: a line for each search, a marker for each limit of sweeps or steps."""
    figure, axes = grid(data.sizes["channels"], columns=2, height=3.2, width=4.2 * data.sizes["channels"] + 0.6)
    reached, spent = accuracy(data), data["rollouts"].mean("flight")
    for panel, channels in zip(axes, data["channels"].values, strict=True):
        panel.axhline(1, color=INK, linewidth=1.0)
        for name in data["search"].values:
            one = {"channels": channels, "search": name}
            panel.plot(spent.sel(one), reached.sel(one), label=name, alpha=0.9, **line(SEARCHES[name]))
        log_axis(panel, "xy")
        panel.set_title(CHANNELS.get(str(channels), str(channels)))
        panel.set_xlabel("rollouts for one flight")
    axes[0].set_ylabel("RMSE / bound, mean of the parameters")
    legend(figure, axes[0], 3)
    return figure


def published_corrected(data: xr.Dataset) -> Figure:
    """What each model can identify, the errors of its fits, and the tests of their residuals.

    Colour shows the fitted model. Filled markers: flights of the same model; open markers: of the other model.
    """
    figure, axes = grid(3 * data.sizes["channels"], columns=3, height=2.7, width=10.0)
    looks = dict(zip(data["fitted"].values, THREE[:2], strict=True))
    rms, names = (data["error"] ** 2).mean("flight") ** 0.5, data["parameter"].values
    rejected = 100 * (data[list(TESTS)].to_dataarray("test") < REJECTED).mean("flight")
    for row, channels in enumerate(data["channels"].values):
        left, middle, right = axes[3 * row : 3 * row + 3]
        left.axhline(NINETY_FIVE, color=FAINT, linestyle="dashed", linewidth=1.0)
        middle.axhline(1, color=INK, linewidth=1.0)
        right.axhline(100 * REJECTED, color=INK, linewidth=1.0)
        for place, (fitted, look) in enumerate(looks.items()):
            own = data.sel(channels=channels, flown=fitted, fitted=fitted)
            size = (abs(own["truth"]) / own["bound"]).where(own["truth"] != 0)
            x = np.arange(len(names)) + 0.3 * (place - 0.5)
            left.plot(x, size, look.marker, color=look.color)
            for flown in data["flown"].values:
                which = {"channels": channels, "flown": flown, "fitted": fitted}
                fill = "full" if flown == fitted else "none"
                mark = {"color": look.color, "fillstyle": fill, "label": f"{fitted} fitted to {flown}"}
                middle.plot(x, rms.sel(which), look.marker, **mark)
                right.plot(np.arange(len(TESTS)) + 0.3 * (place - 0.5), rejected.sel(which), look.marker, **mark)
        for panel in (left, middle):
            log_axis(panel, "y")
            panel.set_xticks(range(len(names)), [name.replace("alpha", "") for name in names])
            panel.set_xlabel("alpha")
        right.set_xticks(range(len(TESTS)), TESTS.values())
        right.set_ylim(-5, 105)
        left.set_title(f"{CHANNELS.get(str(channels), str(channels))}: |truth| / bound")
        middle.set_title("RMS error / bound")
        right.set_title(f"residuals rejected at {100 * REJECTED:g} % [%]")
    legend(figure, middle, 4)
    return figure


def bias(data: xr.Dataset) -> xr.DataArray:
    """The largest mean error of any parameter, in bounds."""
    return abs(metrics.normalised_error(data).mean("flight")).max("parameter")


def inverse_crime(studies: dict[str, xr.Dataset]) -> Figure:
    """RMSE / bound, and the largest bias of any parameter: columns are methods of the fit, lines of the simulation."""
    figure, axes = grid(2 * len(studies), columns=len(studies), height=2.4)
    rows = axes[: len(studies)], axes[len(studies) :]
    for above, below, (name, data) in zip(*rows, studies.items(), strict=True):
        data = squeezed(data, "method", "scale")
        scales = data["scale"].values
        above.axhline(1, color=INK, linewidth=1.0)
        below.axhline(LARGEST_OF_EIGHT / data.sizes["flight"] ** 0.5, color=FAINT, linestyle="dashed", linewidth=1.0)
        for method, look in zip(data["method"].values, THREE, strict=False):
            one = data.sel({"method": method})  # by name: `sel` has an argument `method` of its own
            draw_spread(above, scales, metrics.efficiency(one)["efficiency"], look, f"flown by {method}")
            below.plot(scales, bias(one).values, **line(look))
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
    legend(figure, axes[0], 3)
    return figure


def bracket_and_seeds(studies: dict[str, xr.Dataset]) -> Figure:
    """RMSE / bound, hit rate and rollouts against the width of the bracket, with one line for each seed."""
    figure, (above, middle, right) = grid(3, columns=3, height=2.8)
    above.axhline(1, color=INK, linewidth=1.0)
    for seed, data in enumerate(studies.values()):
        data = squeezed(data, "width", "estimator")
        widths = data["width"].values
        x = study_figures.dodged(widths, seed, len(studies)) if len(studies) > 1 else widths
        for name, look in styles(list(data["estimator"].values)).items():
            one, drawn = data.sel(estimator=name), line(look, linewidth=0.9)
            above.plot(x, metrics.efficiency(one)["efficiency"].max("parameter"), label=name, **drawn)
            right.plot(x, metrics.mean_rollouts(one).where(one["rollouts"].max("flight") > 0), **drawn)
            hits = metrics.hit_rate(one)
            if hits["hit_rate"].notnull().any():
                middle.plot(x, 100 * hits["hit_rate"], **drawn)
                middle.vlines(x, 100 * hits["low"], 100 * hits["high"], color=look.color, linewidth=1.0)
    titles = "RMSE / bound, worst parameter", "seeds that hold the truth [%]", "rollouts for one flight"
    for panel, title in zip((above, middle, right), titles, strict=True):
        panel.set_title(title)
        panel.set_xscale("log")
        panel.set_xticks(widths, [f"{width:g}" for width in widths])
        panel.set_xticks([], minor=True)
        panel.set_xlabel("half-width of the bracket / default")
    log_axis(above, "y")
    log_axis(right, "y")
    legend(figure, above, 3)
    return figure


def of_study(draw: Callable[[xr.Dataset], Any]) -> Callable[[xr.Dataset], Figure | None]:
    """A figure of a study's page, drawn by Matplotlib."""

    def drawn(data: xr.Dataset) -> Figure | None:
        figure = draw(data)
        return None if figure is None else as_matplotlib(figure)

    return drawn


def by_noise(folder: Path) -> xr.Dataset:
    """The Dataset of a study, by noise scale and estimator alone."""
    return squeezed(read_results(folder), "scale", "estimator")


def each_study(folder: Path) -> dict[str, xr.Dataset]:
    """The Datasets of the studies in a folder, by the names of their folders."""
    return {path.parent.name: read_results(path.parent) for path in sorted(folder.glob("*/results.nc"))}


def report(path: Path) -> Any:
    """What an experiment wrote as JSON."""
    return json.loads(path.read_text(encoding="utf-8"))


ERRORS, EFFICIENCY, COVERAGE = map(of_study, (study_figures.errors, study_figures.efficiency, study_figures.coverage))
SCRIPTS = {
    "benchmarks.plot": plotter(report, {"benchmarks": figures_of_flights.benchmarks}),
    "bracket_and_seeds.plot": plotter(each_study, {"bracket_and_seeds": bracket_and_seeds}),
    "closed_loop.plot": plotter(report, {"closed_loop": figures_of_flights.closed_loop}),
    "closed_loop.plot_effects": plotter(report, {"closed_loop_effects": figures_of_flights.effects}),
    "comparison.plot": plotter(by_noise, {"comparison": comparison}),
    "frontier.plot": plotter(load_results, {"frontier": frontier}),
    "inverse_crime.plot": plotter(each_study, {"inverse_crime": inverse_crime}),
    "noise_kinds.plot": plotter(read_results, {"noise_kinds": noise_kinds}),
    "noise_study.plot": plotter(by_noise, {"noise_study-error": ERRORS, "noise_study-efficiency": EFFICIENCY}),
    "peers.plot": plotter(report, {"peers": figures_of_flights.peers}),
    "public_flights.plot": plotter(report, {"public_flights": figures_of_flights.horizons}),
    "published_corrected.plot": plotter(load_results, {"published_corrected": published_corrected}),
    "real_flight.plot": plotter(report, {"real_flight": figures_of_flights.real_flight}),
    "rollout_budget.plot": plotter(load_results, {"rollout_budget": rollout_budget}),
    "scale.plot": plotter(by_noise, {"scale-efficiency": EFFICIENCY, "scale-coverage": COVERAGE}),
}
