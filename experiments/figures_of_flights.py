"""The figures of experiments with vehicles, from the JSON that they write; and of the benchmarks."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.benchmarks.contenders import is_ours
from experiments.drawing import grid, legend, line, log_axis, name_axis
from experiments.fits import INERTIAS, THRUST, summary
from experiments.monte_carlo import Row, groups
from jaxos4.report.panels import BOUND_DASHES, FAINT, INK, styles
from jaxos4.results import NINETY_FIVE

FARTHEST = 60.0  # %; what lies beyond is drawn at the edge
SHOWN = "Crazyflie, 0", "Crazyflie, 2", "Crazyflie, 5", "MuJoCo, 2", "RotorPy, calm", "RotorPy, gusty"
AHEAD = {"error": "prediction", "constant": "constant rates", "network": "network for rates"}
GROWTH = {"flights": "flights in one call", "steps": "steps (rates alone)", "unknowns": "unknowns"}


def closed_loop(report: Row) -> Figure:
    """Bias and coverage against the strength of gusts: a panel for each moment of inertia, a line for each estimator.

    Bars are two Monte-Carlo errors.
    """
    figure, panels = grid(6, columns=3, height=2.4)
    cases = {case: summary(rows) for case, rows in sorted(groups(report["rows"], "gust", "estimator").items())}
    gusts, names = (list(dict.fromkeys(row[key] for row in report["rows"])) for key in ("gust", "estimator"))
    for column, inertia in enumerate(INERTIAS):
        bias, covered = panels[column], panels[column + 3]
        bias.axhline(0, color=INK, linewidth=1.0)
        covered.axhline(95, color=INK, linewidth=1.0)
        for name, look in styles(names).items():
            rows = {gust: found[inertia] for (gust, one), found in cases.items() if one == name and inertia in found}
            for panel, key in ((bias, "mean"), (covered, "covered")):
                errors = [200 * (row[f"{key}_error"] or 0) for row in rows.values()]
                values = [100 * row[key] for row in rows.values()]
                panel.errorbar(list(rows), values, yerr=errors, label=name, **line(look))
        bias.set_title(f"{inertia}: bias [%]")
        covered.set_title(f"{inertia}: 95 % intervals that hold the truth [%]")
        covered.set_ylim(-5, 105)
        for panel in (bias, covered):
            panel.set_xticks(gusts, [f"{gust:g}" for gust in gusts])
            panel.set_xlabel("gusts [rad/s^2]")
    legend(figure, panels[0], 3)
    return figure


def effects(report: Row) -> Figure:
    """For each effect of real flights and quantity: mean error and median half-width, and below the coverage."""
    quantities = (*INERTIAS, THRUST)
    figure, panels = grid(2 * len(quantities), columns=len(quantities), height=3.0)
    cases = {case: summary(rows) for case, rows in groups(report["rows"], "kind", "estimator").items()}
    kinds, names = (list(dict.fromkeys(row[key] for row in report["rows"])) for key in ("kind", "estimator"))
    for column, quantity in enumerate(quantities):
        error, covered = panels[column], panels[column + len(quantities)]
        error.axvline(0, color=INK, linewidth=1.0)
        covered.axvline(95, color=INK, linewidth=1.0)
        for shift, (name, look) in zip(np.linspace(-0.2, 0.2, len(names)), styles(names).items(), strict=True):
            own = {kind: found[quantity] for (kind, one), found in cases.items() if one == name and quantity in found}
            rows, places = list(own.values()), [kinds.index(kind) + shift for kind in own]
            mark, widths = line(look, linestyle="", label=name), [100 * row["width"] for row in rows]
            error.errorbar([100 * row["mean"] for row in rows], places, xerr=widths, **mark)
            covered.plot([100 * row["covered"] for row in rows], places, **mark)
        error.set_title(f"{quantity}: mean error [%]")
        covered.set_title(f"{quantity}: covered [%]")
        covered.set_xlim(-5, 105)
        for panel in (error, covered):
            panel.set_yticks(range(len(kinds)), kinds if column == 0 else [""] * len(kinds))
            panel.set_ylim(len(kinds) - 0.5, -0.5)
    legend(figure, panels[0], 3)
    return figure


def real_flight(report: Row) -> Figure:
    """The moments of inertia that each flight says, and how well what was not fitted is predicted, with 95 % intervals.

    A colour for each estimator.
    """
    figure, panels = grid(4, columns=2, height=2.8)
    estimators, flights = (list(dict.fromkeys(row[key] for row in report["rows"])) for key in ("estimator", "flight"))
    looks = styles(estimators)
    above, below = dict(zip(("Ix", "Iy"), panels[:2], strict=True)), dict(zip("pq", panels[2:], strict=True))
    for number, ((estimator,), rows) in enumerate(groups(report["rows"], "estimator").items()):
        places = np.arange(len(flights)) + 0.2 * (number - (len(looks) - 1) / 2)
        look = line(looks[estimator], linestyle="none", capsize=2)
        for name, panel in above.items():
            known = [row["constants"].get(name) for row in rows]
            some = [(at, 1e5 * x["estimate"], 1e5 * x["std"]) for at, x in zip(places, known, strict=True) if x]
            at, value, std = np.array(some).reshape(-1, 3).T
            panel.errorbar(at, value, NINETY_FIVE * std, label=estimator, **look)
        for rate, panel in below.items():
            for at, row in zip(places, rows, strict=True):
                if rate in row["ahead"]:
                    value, std = row["ahead"][rate]
                    panel.errorbar([at], [value], [NINETY_FIVE * std], **look)
    for name, panel in above.items():
        panel.axhline(1e5 * report["authors"][name], color=INK, linestyle=BOUND_DASHES[2], label="the flights' authors")
        panel.set_title(f"{name} [1e-5 kg m²], 95 %")
        panel.set_yscale("log")
    for rate, panel in below.items():
        panel.axhline(0, color=INK, linewidth=0.8)
        panel.set_title(f"skill in {rate}, 0.25 s ahead; 0: as good as no change")
        panel.set_ylim(-1, 1)
    for panel in panels:
        name_axis(panel, flights)
    legend(figure, panels[0], 3)
    return figure


def horizons(report: Row) -> Figure:
    """The error of predicted rates against the horizon: of each flight, and of the true vehicle in simulated gusts."""
    flights = {name: found["quantities"] for name, found in report["flights"].items()}
    flights |= {f"true vehicle, gusts of {gust} rad/s^2": found for gust, found in report["simulated"].items()}
    figure, panels = grid(len(flights), columns=4, height=2.0)
    looks = styles(list(AHEAD))
    for panel, (name, quantities) in zip(panels, flights.items(), strict=True):
        for kind, label in AHEAD.items():
            if kind in quantities["p"]:
                error = np.mean([quantities[rate][kind] for rate in "pq"], axis=0)
                panel.plot(0.01 * np.arange(1, len(error) + 1), error, color=looks[kind].color, label=label)
        panel.set_title(name, fontsize="small")
        panel.set_ylim(0, None)
        panel.set_xlabel("ahead [s]")
    panels[0].set_ylabel("error of p and q [rad/s]")
    legend(figure, panels[0], 3)
    return figure


def peers(report: Row) -> Figure:
    """The 95 % intervals of Ix and Iy that each tool gives for the same simulated flights, beside the truth.

    Side by side the flights of a kind; a colour for each tool.
    """
    figure, panels = grid(2, columns=1, height=2.3)
    tools = list(dict.fromkeys(row["tool"] for row in report["rows"]))
    kinds = [kind for kind in SHOWN if any(row["case"] == kind for row in report["rows"])]
    for panel, name in zip(panels, ("Ix", "Iy"), strict=True):
        panel.axhline(0, color=INK, linewidth=1.0)
        for number, (tool, look) in enumerate(styles(tools).items()):
            places, errors, arms = [], [], []
            for k, kind in enumerate(kinds):
                own = [row for row in report["rows"] if (row["case"], row["tool"]) == (kind, tool)]
                rows = [row[name] for row in own if name in row]
                for i, row in enumerate(rows):
                    places.append(k + (number + (i + 1) / (len(rows) + 1)) / (len(tools) + 0.5) - 0.45)
                    errors.append(100 * row["error"])
                    arms.append(100 * NINETY_FIVE * row["std"])
            inside = [min(max(error, -FARTHEST), FARTHEST) for error in errors]
            panel.errorbar(places, inside, arms, label=tool, **line(look, linestyle="none", markersize=3))
        panel.set_title(f"{name}: error with 95 % interval [%]; errors beyond {FARTHEST:g} % lie at the edge")
        panel.set_ylim(-1.05 * FARTHEST, 1.05 * FARTHEST)
        name_axis(panel, kinds)
    legend(figure, panels[0], 4)
    return figure


def benchmarks(report: Row) -> Figure:
    """One panel for each part of the report that is there."""
    parts: list[tuple[Any, ...]] = [
        (_draw_times, f"{start} initial state", rows) for start, rows in report["fits"].items()
    ]
    parts += [(_draw_growth, report["growth"])] if report["growth"] else []
    parts += [(_draw_roofline, report["roofline"])] if "share" in report["roofline"] else []
    figure, panels = grid(len(parts), columns=2, height=2.9)
    for panel, (draw, *arguments) in zip(panels, parts, strict=True):
        draw(panel, *arguments)
    return figure


def _draw_times(panel: Axes, title: str, rows: dict[str, Row]) -> None:
    """A bar for each contender from the fastest to the slowest; a line from its shortest to its longest lap."""
    timed = sorted((row["median_seconds"], name) for name, row in rows.items() if "laps" in row)
    ours, others = (look.color for look in styles(["ibss", "svsf"]).values())
    for place, (seconds, name) in enumerate(timed):
        color = ours if is_ours(name) else others
        panel.barh(place, 1e3 * seconds, color=color, height=0.6)
        ends = [1e3 * rows[name]["min_seconds"], 1e3 * rows[name]["max_seconds"]]
        panel.plot(ends, [place, place], color=INK, linewidth=1.0)
    panel.set_yticks(range(len(timed)), [name for _, name in timed])
    panel.set_ylim(len(timed) - 0.4, -0.6)
    panel.grid(axis="y", visible=False)
    panel.set_title(title)
    log_axis(panel, "x")
    panel.set_xlabel("ms / flight")


def _draw_growth(panel: Axes, rows: list[Row]) -> None:
    """Time of one flight against each size."""
    for (axis, label), look in zip(GROWTH.items(), styles(["ibss", "network", "hybrid"]).values(), strict=True):
        some = [row for row in rows if row["axis"] == axis]
        if some:
            x, y = ([row[key] for row in some] for key in ("size", "median_seconds"))
            panel.plot(x, 1e3 * np.array(y), label=label, **line(look))
    log_axis(panel, "xy")
    panel.set(title="growth", xlabel="size", ylabel="ms / flight")
    panel.legend()


def _draw_roofline(panel: Axes, found: dict[str, float]) -> None:
    """The most operations that the machine allows at each number of operations for each byte, and our shots."""
    peak, stream = found["peak_operations_per_second"] / 1e9, found["peak_bytes_per_second"] / 1e9
    corner, at = peak / stream, found["operations_per_step"] / found["bytes_per_step"]
    x = np.geomspace(min(corner, at) / 10, max(corner, at) * 10, 50)
    panel.plot(x, np.minimum(peak, stream * x), color=INK, label="peak")
    look = styles(["ibss"])["ibss"]
    panel.plot([at], [found["operations_per_second"] / 1e9], look.marker, color=look.color, label="our shots")
    panel.axvline(at, color=FAINT, linewidth=0.8)
    log_axis(panel, "xy")
    panel.set(title="roofline", xlabel="operations / byte", ylabel="Gop/s")
    panel.legend()
