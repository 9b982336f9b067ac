"""Measured against predicted rates over one tested block, skill by horizon, and the inertias against the lag.

The block is the first that was tested: none was chosen.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import typer
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Patch

from jaxos4.report.experiment import write_figure
from jaxos4.report.style import BOUND_DASHES, INK, styles

RATES = "pqr"
AHEAD = 0.25
NINETY_FIVE = 1.96
# Horizons above this [s] have bars, of shooting and of two of the regressions.
SHORTEST = 0.06
REGRESSION = "memory 0, alone", "memory 0.9, rotors of shooting, holds what shooting held"
LABELS = {"equation-error": "equation error alone", "rls": "equation error, told by ibss"}
SHOOTING = ("ibss", "output-error", "hybrid")


def draw_predictions(column: SubFigure, report: dict[str, Any], flown: dict[str, np.ndarray]) -> None:
    """Each rate over one block; the band holds 95 % of the errors of all blocks."""
    panels = list(column.subplots(3, 1))
    look, at = styles(["ibss"])["ibss"], int(np.argmin(np.abs(flown["horizons"] - AHEAD)))
    block = flown["block"] == 0
    begin = report["tested"][0][0]
    time = begin + report["sample_time"] * flown["start"][block] + flown["horizons"][at]
    for rate, panel in enumerate(panels):
        y, measured = (flown[name][:, at, rate] for name in ("predicted", "measured"))
        half = np.nanquantile(np.abs(y - measured), 0.95)
        panel.fill_between(time, y[block] - half, y[block] + half, color=look.color, alpha=0.2, linewidth=0)
        panel.plot(time, y[block], color=look.color, label=f"predicted {flown['horizons'][at]:.2g} s ahead")
        panel.plot(time, measured[block], color=INK, linewidth=1.0, linestyle=BOUND_DASHES[1], label="measured")
        panel.set_ylabel(f"{RATES[rate]} [rad/s]")
        panel.set_xlim(time[0], time[-1])
        panel.margins(y=0.02)
        panel.tick_params(labelbottom=rate == 2)
    panels[0].set_title("One tested block, and the band that holds 95 % of the errors")
    handles, labels = panels[0].get_legend_handles_labels()
    handles.append(Patch(color=look.color, alpha=0.2, linewidth=0))
    panels[-1].set_xlabel("time [s]")
    column.legend(handles, [*labels, "95 % of errors"], ncols=3, loc="outside lower center")


def draw_skill(column: SubFigure, report: dict[str, Any]) -> None:
    """Bars by horizon, with 95 % error bars; below -1 they are cut, and say what they are."""
    panels = list(column.subplots(3, 1))
    bars = {name: (name, report["estimators"][name]) for name in SHOOTING if name in report["estimators"]}
    if "ibss without flapping" in report["estimators"]:
        bars["ibss without flapping"] = ("ibss, no flapping term", report["estimators"]["ibss without flapping"])
    for (name, label), key in zip(LABELS.items(), REGRESSION, strict=True):
        row = report.get("regression", {}).get("rows", {}).get(key)
        if row is not None:
            bars[name] = (label, row)
    looks = styles([*(name for name in bars if name != "ibss without flapping"), "svsf"])
    looks["ibss without flapping"] = looks["svsf"]
    width = 0.84 / len(bars)
    for rate, panel in zip(RATES, panels, strict=True):
        for place, (name, (label, row)) in enumerate(bars.items()):
            shown = [at for at, horizon in enumerate(row["skill"]["horizons"]) if horizon > SHORTEST]
            x = np.arange(len(shown)) + (place - (len(bars) - 1) / 2) * width
            y, std = (np.array(row["skill"][rate][part])[shown] for part in ("skill", "std"))
            panel.bar(x, np.maximum(y, -1.2), 0.9 * width, color=looks[name].color, label=label)
            seen = y > -1
            panel.errorbar(x[seen], y[seen], NINETY_FIVE * std[seen], fmt="none", ecolor=INK, elinewidth=0.8)
            for at, value in zip(x[~seen], y[~seen], strict=True):
                panel.text(at, -0.96, f"{value:.1f}", rotation=90, ha="center", va="bottom", fontsize=7, color="white")
            panel.set_xticks(range(len(shown)), [f"{row['skill']['horizons'][at]:.2g} s" for at in shown])
        panel.axhline(0, color=INK, linewidth=0.8)
        panel.set_ylim(-1, 1)
        panel.set_title(f"skill in {rate}; 0: as good as no change")
        panel.grid(visible=False, axis="x")
    column.legend(*panels[0].get_legend_handles_labels(), ncols=2, loc="outside lower center")


def draw_inertias(column: SubFigure, report: dict[str, Any]) -> None:
    """Against the lag that is held; the authors' figures are lines, the free fit is the square."""
    panels = list(column.subplots(3, 1))
    rows, free, regression = report["lag"], report["estimators"]["ibss"], report.get("regression", {})
    lags = [1e3 * row["lag"] for row in rows]
    shot, best = styles(["ibss", "output-error"]).values()
    looks = styles(["equation-error", "rls"]).values()
    delays = sorted({0.0, regression["chosen"]["delay"]}) if regression else []
    for panel, name in zip(panels, ("Ix", "Iy"), strict=False):
        for look, delay in zip(looks, delays, strict=False):
            some = [row for row in regression["grid"] if row["delay"] == delay and row["lag"] >= min(lags) / 1e3]
            label = f"equation error, delay {1e3 * delay:g} ms"
            x, y = [1e3 * row["lag"] for row in some], [1e5 * row[name] for row in some]
            panel.plot(x, y, color=look.color, linestyle=look.dash, label=label)
        y, interval = _scaled([row["inertias"][name] for row in rows])
        panel.errorbar(lags, y, interval, color=shot.color, marker="o", capsize=2, label="ibss, lag held, delay free")
        if "rotor_lag" in free["parameters"]:
            lag = free["parameters"]["rotor_lag"]
            y, interval = _scaled([free["inertias"][name]])
            across = [1e3 * NINETY_FIVE * lag["std"]]
            look = {"color": best.color, "marker": "s", "capsize": 2, "linestyle": "none"}
            panel.errorbar([1e3 * lag["estimate"]], y, interval, across, label="ibss, lag free", **look)
        panel.axhline(1e5 * report["authors"][name], color=INK, linestyle=BOUND_DASHES[2], label="the flights' authors")
        panel.set_title(f"{name} [1e-5 kg m²]")
        panel.set_ylim(bottom=0)
    panels[-1].plot(lags, [row["cost"] / 1e3 for row in rows], color=shot.color, marker="o")
    panels[-1].set_title("cost of the fit [1000]")
    panels[-1].set_xlabel("rotor lag [ms]")
    column.legend(*panels[0].get_legend_handles_labels(), ncols=2, loc="outside lower center")


def _scaled(rows: list[dict[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """Estimates and their intervals' arms [1e-5 kg m^2]."""
    y, ends = np.array([row["estimate"] for row in rows]), np.array([row["ci95"] for row in rows], dtype=float).T
    return 1e5 * y, 1e5 * np.abs(ends - y)


def draw(report: dict[str, Any], flown: dict[str, np.ndarray]) -> Figure:
    """Columns: predictions, skill, inertias where the lag was varied."""
    figure = Figure(figsize=(13.5, 7.5), layout="constrained")
    draws = [lambda column: draw_predictions(column, report, flown), lambda column: draw_skill(column, report)]
    if "lag" in report:
        draws.append(lambda column: draw_inertias(column, report))
    for column, fill in zip(figure.subfigures(1, len(draws)), draws, strict=True):
        fill(column)
    return figure


def main(results: Path, figures: Path) -> None:
    """Draws what run.py wrote."""
    report = json.loads((results / "results.json").read_text(encoding="utf-8"))
    with np.load(results / "predictions.npz") as file:
        flown = dict(file)
    write_figure(lambda: draw(report, flown), figures, "real_flight")


if __name__ == "__main__":
    typer.run(main)
