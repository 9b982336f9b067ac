"""The figures of the experiments: `python -m experiments NAME.plot data/NAME figures` writes each as SVG and PDF."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from experiments import figures_of_flights
from experiments.drawing import PERCENT, alike, axis_at, level, named_axis, named_rows, of_parameters, plotter, points
from experiments.shared import load_results
from jaxos4.report import study_figures
from jaxos4.report.panels import (
    BOUND_DASHES,
    EVERYWHERE,
    FAINT,
    Band,
    Figure,
    Line,
    Mark,
    Panel,
    Scale,
    Words,
    spread,
    styles,
)
from jaxos4.report.study_tables import error_unit
from jaxos4.report.text import plain
from jaxos4.results import NINETY_FIVE
from jaxos4.study import metrics, read_results

WORST = 30.0  # RMS error / least bound; the darkest colour
LARGEST_OF_EIGHT = 2.73  # 95 % quantile of the largest of eight Gaussian magnitudes, in standard deviations
REJECTED = 0.01  # a p-value below which residuals are rejected
TESTS = {"white_p": "white", "input_p": "without input", "level_p": "noise size"}
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
    labels = [f"{name} [{unit}]" for name, (_, unit) in zip(data["parameter"].values, kinds, strict=True)]
    names, color, panels = data["estimator"].values, THREE[0].color, []

    def shade(times: float) -> float:
        return 0.06 + 0.6 * float(np.clip(np.log(max(times, 1.0)) / np.log(WORST), 0, 1))

    legend = [
        Band((), (), (), color, shade(each), f"{each:g} times the least bound{more}")
        for each, more in ((1, ""), (2, ""), (5, ""), (10, ""), (WORST, " or more"))
    ]
    y = named_rows(names)
    for place, scale in enumerate(data["scale"].values):
        marks: list[Mark] = [*legend]
        for row, column in np.ndindex(ratio.shape[1:]):
            value = float(found[kinds[column][0]].isel(scale=place, estimator=row, parameter=column))
            if np.isfinite(times := float(ratio[place, row, column])):
                cell = (column - 0.5, column + 0.5), 2 * [row - 0.5], 2 * [row + 0.5]
                marks.append(Band(*cell, color, shade(times)))
            marks.append(Words(column, row, plain(value, 2), "middle"))
        panels.append(Panel(f"noise scale {scale:g}", marks, named_axis(labels), y, 1000, 60 + 22 * len(names)))
    return Figure("comparison", panels, columns=1)


def noise_kinds(data: xr.Dataset) -> Figure:
    """For each kind of noise: the mean over the parameters, with a bar from the smallest to the largest."""
    data = squeezed(data, "noise", "estimator")
    looks, kinds = styles(list(data["estimator"].values)), data["noise"].values
    covered = metrics.coverage(data).sel(level=0.95)["coverage"]
    left, right = [level(1)], [level(95)]
    for place, (name, look) in enumerate(looks.items()):
        x = np.arange(len(kinds)) + 0.5 * (place / max(len(looks) - 1, 1) - 0.5)
        left += of_parameters(x, metrics.efficiency(data.sel(estimator=name))["efficiency"], look, name, width=0)
        right += of_parameters(x, 100 * covered.sel(estimator=name), look, name, width=0)
    panels = [
        Panel("RMSE / bound of white noise", left, named_axis(kinds), Scale("log"), 430, 270),
        Panel("95 % intervals that hold the truth [%]", right, named_axis(kinds), width=430, height=270),
    ]
    return Figure("noise_kinds", panels, columns=2)


def frontier(data: xr.Dataset) -> Figure:
    """The largest noise at which each parameter can be distinguished from 0: a panel for each model and input.

    Colour and marker show the channels. Larger markers show longer flights. The vertical line is the noise of the
    standard sensors: a parameter to its left cannot be distinguished from 0 with them.
    """
    frontier = data["frontier"]
    excitations, parameters = frontier["excitation"].values, frontier["parameter"].values
    looks = dict(zip(frontier["channels"].values, THREE, strict=False))
    sizes = dict(zip(frontier["duration"].values, 4.0 + 2.5 * np.arange(frontier.sizes["duration"]), strict=True))
    low, high = float(frontier.where(frontier > 0).min()) / 3, float(frontier.max()) * 3
    x = Scale("log", (low, high), label="noise scale")
    y = named_rows(parameters)
    legend = [Line((), (), width=0, marker="o", size=size, name=f"{each:g} s") for each, size in sizes.items()]
    panels = []
    for model in frontier["model"].values:
        for excitation in excitations:
            one, marks = frontier.sel(model=model, excitation=excitation), [Line((1, 1), EVERYWHERE, width=1.3)]
            for row, (channels, look) in enumerate(looks.items()):
                places = np.arange(len(parameters)) + 0.27 * (row - (len(looks) - 1) / 2)
                for duration, size in sizes.items():
                    known = one.sel(channels=channels, duration=duration).values
                    marks += points(known, places, look, str(channels), width=0, size=size)
            words = [
                Words(low * 1.5, float(place), said)
                for said, where in (("not excited", one.isnull()), ("its truth is 0", one == 0))
                for place in np.flatnonzero(where.all(("duration", "channels")).values)
            ]
            panels.append(Panel(f"{model}, {excitation}", [*marks, *words, *legend], x, y, 290, 250))
    return Figure("frontier", panels, columns=len(excitations))


def accuracy(data: xr.Dataset) -> xr.DataArray:
    """RMSE / bound, as the geometric mean of the parameters."""
    return np.exp(np.log((data["error"] ** 2).mean("flight") ** 0.5).mean("parameter"))


def rollout_budget(data: xr.Dataset) -> Figure:
    """RMSE / bound against rollouts: a line for each search, a marker for each limit of sweeps or steps."""
    reached, spent, panels = accuracy(data), data["rollouts"].mean("flight"), []
    for channels in data["channels"].values:
        marks, title = [level(1)], CHANNELS.get(str(channels), str(channels))
        for name in data["search"].values:
            one = {"channels": channels, "search": name}
            marks += points(spent.sel(one).values, reached.sel(one).values, SEARCHES[name], str(name))
        x = Scale("log", label="rollouts for one flight")
        panels.append(Panel(f"{title}: RMSE / bound, mean of the parameters", marks, x, Scale("log"), 430, 300))
    return Figure("rollout_budget", panels, columns=2)


def published_corrected(data: xr.Dataset) -> Figure:
    """What each model can identify, the errors of its fits, and the tests of their residuals.

    Colour shows the fitted model. Filled markers: flights of the same model; open markers: of the other model.
    """
    looks, panels = dict(zip(data["fitted"].values, THREE[:2], strict=True)), []
    rms, names = (data["error"] ** 2).mean("flight") ** 0.5, data["parameter"].values
    rejected = 100 * (data[list(TESTS)].to_dataarray("test") < REJECTED).mean("flight")
    alphas = named_axis([name.replace("alpha", "") for name in names], "alpha")
    for channels in data["channels"].values:
        sizes = [level(NINETY_FIVE, color=FAINT, dash=BOUND_DASHES[2])]
        errors, tests = [level(1)], [level(100 * REJECTED)]
        for place, (fitted, look) in enumerate(looks.items()):
            own, shift = data.sel(channels=channels, flown=fitted, fitted=fitted), 0.3 * (place - 0.5)
            size = (abs(own["truth"]) / own["bound"]).where(own["truth"] != 0)
            x = np.arange(len(names)) + shift
            sizes += points(x, size.values, look, width=0)
            for flown in data["flown"].values:
                which = {"channels": channels, "flown": flown, "fitted": fitted}
                how = {"name": f"{fitted} fitted to {flown}", "width": 0, "hollow": flown != fitted}
                errors += points(x, rms.sel(which).values, look, **how)
                tests += points(np.arange(len(TESTS)) + shift, rejected.sel(which).values, look, **how)
        panels += [
            Panel(f"{CHANNELS.get(str(channels), str(channels))}: |truth| / bound", sizes, alphas, Scale("log")),
            Panel("RMS error / bound", errors, alphas, Scale("log")),
            Panel(f"residuals rejected at {100 * REJECTED:g} % [%]", tests, named_axis(TESTS.values()), PERCENT),
        ]
    return Figure("published_corrected", [panel._replace(width=340, height=240) for panel in panels])


def bias(data: xr.Dataset) -> xr.DataArray:
    """The largest mean error of any parameter, in bounds."""
    return abs(metrics.normalised_error(data).mean("flight")).max("parameter")


def inverse_crime(studies: dict[str, xr.Dataset]) -> Figure:
    """RMSE / bound, and the largest bias of any parameter: columns are methods of the fit, lines of the simulation."""
    above, below = [], []
    for name, data in studies.items():
        data = squeezed(data, "method", "scale")
        scales = data["scale"].values
        chance = LARGEST_OF_EIGHT / data.sizes["flight"] ** 0.5
        ratios, biases = [level(1)], [level(chance, color=FAINT, dash=BOUND_DASHES[2])]
        for method, look in zip(data["method"].values, THREE, strict=False):
            one = data.sel({"method": method})  # by name: `sel` has an argument `method` of its own
            ratios += of_parameters(scales, metrics.efficiency(one)["efficiency"], look, f"flown by {method}")
            biases += points(scales, bias(one).values, look)
        x = axis_at(scales, "noise scale", "log")
        above.append(Panel(f"fitted by {name}: RMSE / bound", ratios, x, Scale("log")))
        below.append(Panel("largest |bias| / bound", biases, x, Scale("log")))
    return Figure("inverse_crime", [*alike(above), *alike(below)], columns=len(studies))


def bracket_and_seeds(studies: dict[str, xr.Dataset]) -> Figure:
    """RMSE / bound, hit rate and rollouts against the width of the bracket, with one line for each seed."""
    worst, held, spent = [level(1)], list[Mark](), list[Mark]()
    for seed, data in enumerate(studies.values()):
        data = squeezed(data, "width", "estimator")
        widths = data["width"].values
        x = study_figures.dodged(widths, seed, len(studies)) if len(studies) > 1 else widths
        for name, look in styles(list(data["estimator"].values)).items():
            one, hits = data.sel(estimator=name), metrics.hit_rate(data.sel(estimator=name))
            worst += points(x, metrics.efficiency(one)["efficiency"].max("parameter").values, look, name, width=0.9)
            rollouts = metrics.mean_rollouts(one).where(one["rollouts"].max("flight") > 0)
            spent += points(x, rollouts.values, look, name, width=0.9)
            if hits["hit_rate"].notnull().any():
                value, low, high = (100 * hits[each].values for each in ("hit_rate", "low", "high"))
                held += [*points(x, value, look, name, width=0.9), spread(x, low, high, color=look.color, width=1.3)]
    axis = axis_at(widths, "half-width of the bracket / default", "log")
    panels = [
        Panel("RMSE / bound, worst parameter", worst, axis, Scale("log")),
        Panel("seeds that hold the truth [%]", held, axis),
        Panel("rollouts for one flight", spent, axis, Scale("log")),
    ]
    return Figure("bracket_and_seeds", [panel._replace(width=340, height=260) for panel in panels])


def by_noise(folder: Path) -> xr.Dataset:
    """The Dataset of a study, by noise scale and estimator alone."""
    return squeezed(read_results(folder), "scale", "estimator")


def each_study(folder: Path) -> dict[str, xr.Dataset]:
    """The Datasets of the studies in a folder, by the names of their folders."""
    return {path.parent.name: read_results(path.parent) for path in sorted(folder.glob("*/results.nc"))}


def report(path: Path) -> Any:
    """What an experiment wrote as JSON."""
    return json.loads(path.read_text(encoding="utf-8"))


SCRIPTS = {
    "benchmarks.plot": plotter(report, {"benchmarks": figures_of_flights.benchmarks}),
    "bracket_and_seeds.plot": plotter(each_study, {"bracket_and_seeds": bracket_and_seeds}),
    "closed_loop.plot": plotter(report, {"closed_loop": figures_of_flights.closed_loop}),
    "closed_loop.plot_effects": plotter(report, {"closed_loop_effects": figures_of_flights.effects}),
    "comparison.plot": plotter(by_noise, {"comparison": comparison}),
    "frontier.plot": plotter(load_results, {"frontier": frontier}),
    "inverse_crime.plot": plotter(each_study, {"inverse_crime": inverse_crime}),
    "noise_kinds.plot": plotter(read_results, {"noise_kinds": noise_kinds}),
    "noise_study.plot": plotter(
        by_noise, {"noise_study-error": study_figures.errors, "noise_study-efficiency": study_figures.efficiency}
    ),
    "peers.plot": plotter(report, {"peers": figures_of_flights.peers}),
    "public_flights.plot": plotter(report, {"public_flights": figures_of_flights.horizons}),
    "published_corrected.plot": plotter(load_results, {"published_corrected": published_corrected}),
    "real_flight.plot": plotter(report, {"real_flight": figures_of_flights.real_flight}),
    "rollout_budget.plot": plotter(load_results, {"rollout_budget": rollout_budget}),
    "scale.plot": plotter(
        by_noise, {"scale-efficiency": study_figures.efficiency, "scale-coverage": study_figures.coverage}
    ),
}
