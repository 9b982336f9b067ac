"""Measured against predicted rates over one tested block, skill by horizon, and the inertias against the lag.

The block is the first that was tested: none was chosen.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import typer
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jaxos4.cli.experiment import write_figure
from jaxos4.report.style import BOUND_DASHES, FAINT, INK, styles

RATES = "pqr"
AHEAD = 0.25
NINETY_FIVE = 1.96
# What the skill's bars are of: the name in the results, and in the legend.
REGRESSION = "memory 0, alone", "memory 0.9, lag of shooting, holds what shooting held"
SHOOTING = ("ibss", "output-error", "hybrid")


def draw_predictions(panels: list[Axes], report: dict[str, Any], flown: dict[str, np.ndarray]) -> None:
    """Each rate over one block; the band holds 95 % of the errors of all blocks."""
    look, at = styles(["ibss"])["ibss"], int(np.argmin(np.abs(flown["horizons"] - AHEAD)))
    block = flown["block"] == 0
    begin = report["tested"][0][0]
    time = begin + report["sample_time"] * flown["start"][block] + flown["horizons"][at]
    for rate, panel in enumerate(panels):
        y, measured = (flown[name][:, at, rate] for name in ("predicted", "measured"))
        half = np.nanquantile(np.abs(y - measured), 0.95)
        panel.fill_between(time, y[block] - half, y[block] + half, color=look.color, alpha=0.2, linewidth=0)
        panel.plot(time, y[block], color=look.color, label=f"predicted {flown['horizons'][at]:.2g} s ahead (ibss)")
        panel.plot(time, measured[block], color=INK, linewidth=1.0, linestyle=BOUND_DASHES[1], label="measured")
        panel.set_ylabel(f"{RATES[rate]} [rad/s]")
        panel.set_xlim(time[0], time[-1])
        panel.margins(y=0.02)
        panel.tick_params(labelbottom=rate == 2)
    panels[0].set_title("One tested block, and the band that holds 95 % of the errors")
    handles, labels = panels[0].get_legend_handles_labels()
    handles.append(Patch(color=look.color, alpha=0.2, linewidth=0))
    panels[-1].set_xlabel("time [s]")
    panels[-1].legend(handles, [*labels, "95 %"], ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.35))


def draw_skill(panels: list[Axes], report: dict[str, Any]) -> None:
    """Bars by horizon, with 95 % error bars; below -1 they are cut, and say what they are."""
    bars = {name: (name, report["estimators"][name]) for name in SHOOTING if name in report["estimators"]}
    bars["ibss without flapping"] = ("no flapping term", report["estimators"]["ibss without flapping"])
    for name, key in zip(("equation-error", "rls"), REGRESSION, strict=True):
        row = report.get("regression", {}).get("rows", {}).get(key)
        if row is not None:
            bars[name] = (f"equation error, {key}", row)
    looks = styles([*(name for name in bars if name != "ibss without flapping"), "svsf"])
    looks["ibss without flapping"] = looks.pop("svsf")
    width = 0.8 / len(bars)
    for rate, panel in zip(RATES, panels, strict=True):
        for place, (name, (label, row)) in enumerate(bars.items()):
            skill = row["skill"]
            x = np.arange(len(skill["horizons"])) + (place - (len(bars) - 1) / 2) * width
            y, std = np.array(skill[rate]["skill"]), np.array(skill[rate]["std"])
            panel.bar(x, np.maximum(y, -1.2), 0.9 * width, color=looks[name].color, label=label)
            shown = y > -1
            panel.errorbar(x[shown], y[shown], NINETY_FIVE * std[shown], fmt="none", ecolor=INK, elinewidth=0.8)
            for at, value in zip(x[~shown], y[~shown], strict=True):
                panel.text(
                    at, -0.97, f"{value:.1f}", rotation=90, ha="center", va="bottom", fontsize=6.5, color="white"
                )
        panel.axhline(0, color=INK, linewidth=0.8)
        panel.set_ylim(-1, 1)
        panel.set_xticks(range(len(skill["horizons"])), [f"{horizon:.2g}" for horizon in skill["horizons"]])
        panel.set_title(f"skill in {rate}")
        panel.grid(visible=False, axis="x")
    panels[-1].set_xlabel("predicted so far ahead [s]; 0: as good as no change")
    panels[-1].legend(ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.3))


def draw_inertias(panels: list[Axes], report: dict[str, Any]) -> None:
    """Against the lag that is held; the authors' figures are lines, the free fit is the square."""
    rows, free = report["lag"], report["estimators"]["ibss"]
    lags = [1e3 * row["lag"] for row in rows]
    shot, best = styles(["ibss", "output-error"]).values()
    regressed = styles(["equation-error"])["equation-error"]
    grid = [row for row in report.get("regression", {}).get("grid", []) if row["delay"] == 0]
    for panel, name in zip(panels, ("Ix", "Iy"), strict=True):
        y = np.array([row["inertias"][name]["estimate"] for row in rows]) * 1e5
        ends = np.array([row["inertias"][name]["ci95"] for row in rows]).T * 1e5
        panel.errorbar(
            lags, y, np.abs(ends - y), color=shot.color, marker="o", capsize=2, label="ibss, lag held, delay free"
        )
        if "inertias" in free and "rotor_lag" in free["parameters"]:
            lag, value = free["parameters"]["rotor_lag"], free["inertias"][name]
            middle = 1e5 * value["estimate"]
            panel.errorbar(
                [1e3 * lag["estimate"]],
                [middle],
                np.abs(1e5 * np.array(value["ci95"])[:, None] - middle),
                [1e3 * NINETY_FIVE * lag["std"]],
                color=best.color,
                marker="s",
                capsize=2,
                linestyle="none",
                label="ibss, lag free",
            )
        if grid:
            x = [1e3 * row["lag"] for row in grid]
            panel.plot(
                x,
                [1e5 * row[name] for row in grid],
                color=regressed.color,
                linestyle=regressed.dash,
                label="equation error, memory 0, no delay",
            )
        panel.axhline(1e5 * report["authors"][name], color=INK, linestyle=BOUND_DASHES[2], label="authors")
        panel.set_title(f"{name} [1e-5 kg m²]")
        panel.set_xlabel("rotor lag that is held [ms]")
    below = panels[0].twinx()
    below.plot(lags, [row["cost"] / 1e3 for row in rows], color=FAINT, linewidth=0.9, label="cost of the fit")
    below.set_ylabel("cost [1000]", color=FAINT)
    below.grid(visible=False)
    panels[-1].legend(ncols=1, loc="upper left", bbox_to_anchor=(0, -0.28))


def draw(report: dict[str, Any], flown: dict[str, np.ndarray]) -> Figure:
    """Three columns: predictions, skill, inertias."""
    figure = Figure(figsize=(12.5, 7.0), layout="constrained")
    with_lag = "lag" in report
    columns = figure.subfigures(1, 3 if with_lag else 2, width_ratios=[1.25, 1, 0.85][: 3 if with_lag else 2])
    draw_predictions(list(columns[0].subplots(3, 1)), report, flown)
    draw_skill(list(columns[1].subplots(3, 1)), report)
    if with_lag:
        draw_inertias(list(columns[2].subplots(2, 1)), report)
    return figure


def main(results: Path, figures: Path) -> None:
    """Draws what run.py wrote."""
    report = json.loads((results / "results.json").read_text(encoding="utf-8"))
    with np.load(results / "predictions.npz") as file:
        flown = dict(file)
    write_figure(lambda: draw(report, flown), figures, "real_flight")


if __name__ == "__main__":
    typer.run(main)
