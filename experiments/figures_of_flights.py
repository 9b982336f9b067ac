"""The figures of experiments with vehicles, from the JSON that they write; and of the benchmarks."""

import numpy as np

from experiments.benchmarks.contenders import is_ours
from experiments.drawing import PERCENT, axis_at, level, named_axis, named_rows, points
from experiments.fits import INERTIAS, THRUST, summary
from experiments.monte_carlo import Row, groups
from jaxos4.report.panels import BOUND_DASHES, EVERYWHERE, FAINT, Band, Figure, Line, Mark, Panel, Scale, across, styles
from jaxos4.results import NINETY_FIVE

FARTHEST = 60.0  # %; what lies beyond is drawn at the edge
SHOWN = "Crazyflie, 0", "Crazyflie, 2", "Crazyflie, 5", "MuJoCo, 2", "RotorPy, calm", "RotorPy, gusty"
AHEAD = {"error": "prediction", "constant": "constant rates", "network": "network for rates"}
GROWTH = {"flights": "flights in one call", "steps": "steps (rates alone)", "unknowns": "unknowns"}


def values_of(rows: list[Row], name: str) -> list:
    """The different values of an entry, in their order."""
    return list(dict.fromkeys(row[name] for row in rows))


def percent(rows: list[Row], name: str) -> np.ndarray:
    """An entry of rows in percent; 0 if it is `None`."""
    return 100 * np.array([row[name] or 0 for row in rows])


def closed_loop(report: Row) -> Figure:
    """Bias and coverage against the strength of gusts: a panel for each moment of inertia, a line for each estimator.

    Bars are two Monte-Carlo errors.
    """
    cases = {case: summary(rows) for case, rows in sorted(groups(report["rows"], "gust", "estimator").items())}
    looks, panels = styles(values_of(report["rows"], "estimator")), []
    gusts = axis_at(values_of(report["rows"], "gust"), "gusts [rad/s^2]")
    kinds = (("mean", "bias [%]", 0, Scale()), ("covered", "95 % intervals that hold the truth [%]", 95, PERCENT))
    for key, title, wanted, y in kinds:
        for inertia in INERTIAS:
            marks: list[Mark] = [level(wanted)]
            for name, look in looks.items():
                own = {gust: found[inertia] for (gust, k), found in cases.items() if k == name and inertia in found}
                value, error = (percent([*own.values()], each) for each in (key, f"{key}_error"))
                marks += points([*own], value, look, name, 2 * error)
            panels.append(Panel(f"{inertia}: {title}", marks, gusts, y, 340, 220))
    return Figure("closed_loop", panels)


def effects(report: Row) -> Figure:
    """For each effect of real flights and quantity: mean error and median half-width, and below the coverage."""
    cases = {case: summary(rows) for case, rows in groups(report["rows"], "kind", "estimator").items()}
    looks, kinds, panels = styles(values_of(report["rows"], "estimator")), values_of(report["rows"], "kind"), []
    y = named_rows(kinds)
    for key, title, wanted, x in (("mean", "mean error [%]", 0, Scale()), ("covered", "covered [%]", 95, PERCENT)):
        for quantity in (*INERTIAS, THRUST):
            marks: list[Mark] = [Line((wanted, wanted), EVERYWHERE, width=1.3)]
            for shift, (name, look) in zip(np.linspace(-0.2, 0.2, len(looks)), looks.items(), strict=True):
                own = {k: found[quantity] for (k, one), found in cases.items() if one == name and quantity in found}
                value, places = percent([*own.values()], key), np.array([kinds.index(kind) + shift for kind in own])
                marks += points(value, places, look, name, width=0)
                if key == "mean":
                    half = percent([*own.values()], "width")
                    marks.append(across(places, value - half, value + half, color=look.color, width=1.3))
            panels.append(Panel(f"{quantity}: {title}", marks, x, y, 300, 80 + 22 * len(kinds)))
    return Figure("closed_loop_effects", panels, columns=len(INERTIAS) + 1)


def real_flight(report: Row) -> Figure:
    """The moments of inertia that each flight says, and how well what was not fitted is predicted, with 95 % intervals.

    A colour for each estimator.
    """
    looks, flights = styles(values_of(report["rows"], "estimator")), values_of(report["rows"], "flight")
    marks: dict[str, list[Mark]] = {
        name: [level(1e5 * report["authors"][name], dash=BOUND_DASHES[2], name="the flights' authors")]
        for name in ("Ix", "Iy")
    }
    marks |= {rate: [level(0)] for rate in "pq"}
    for number, ((estimator,), rows) in enumerate(groups(report["rows"], "estimator").items()):
        for row in rows:
            at = [flights.index(row["flight"]) + 0.2 * (number - (len(looks) - 1) / 2)]
            known = {name: (1e5 * x["estimate"], 1e5 * x["std"]) for name, x in row["constants"].items()} | row["ahead"]
            for name, (value, std) in known.items():
                if name in marks:
                    marks[name] += points(at, [value], looks[estimator], estimator, [NINETY_FIVE * std], width=0)
    titles = {name: f"{name} [1e-5 kg m²], 95 %" for name in ("Ix", "Iy")}
    titles |= {rate: f"skill in {rate}, 0.25 s ahead; 0: as good as no change" for rate in "pq"}
    axes = {name: Scale("log") if name in INERTIAS else Scale(ends=(-1.0, 1.0)) for name in marks}
    panels = [Panel(titles[name], marks[name], named_axis(flights), axes[name], 430, 260) for name in marks]
    return Figure("real_flight", panels, columns=2)


def horizons(report: Row) -> Figure:
    """The error of predicted rates against the horizon: of each flight, and of the true vehicle in simulated gusts."""
    flights = {name: found["quantities"] for name, found in report["flights"].items()}
    flights |= {f"true vehicle, gusts of {gust} rad/s^2": found for gust, found in report["simulated"].items()}
    looks, panels = styles(list(AHEAD)), []
    for name, quantities in flights.items():
        known = [kind for kind in AHEAD if kind in quantities["p"]]
        errors = [np.mean([quantities[rate][kind] for rate in "pq"], axis=0) for kind in known]
        marks = [
            Line(0.01 * np.arange(1, len(error) + 1), error, looks[kind].color, dash=looks[kind].dash, name=AHEAD[kind])
            for kind, error in zip(known, errors, strict=True)
        ]
        y = Scale(ends=(0.0, 1.05 * float(np.nanmax(errors))))
        panels.append(Panel(name, marks, Scale(label="ahead [s]"), y, subtitle="error of p and q [rad/s]"))
    return Figure("public_flights", panels, columns=4)


def peers(report: Row) -> Figure:
    """The 95 % intervals of Ix and Iy that each tool gives for the same simulated flights, beside the truth.

    Side by side the flights of a kind; a colour for each tool.
    """
    tools, panels = values_of(report["rows"], "tool"), []
    kinds = [kind for kind in SHOWN if any(row["case"] == kind for row in report["rows"])]
    for name in ("Ix", "Iy"):
        marks: list[Mark] = [level(0)]
        for number, (tool, look) in enumerate(styles(tools).items()):
            places, found = [], []
            for k, kind in enumerate(kinds):
                own = [row for row in report["rows"] if (row["case"], row["tool"]) == (kind, tool)]
                rows = [row[name] for row in own if name in row]
                places += [
                    k + (number + (i + 1) / (len(rows) + 1)) / (len(tools) + 0.5) - 0.45 for i in range(len(rows))
                ]
                found += rows
            inside, half = np.clip(percent(found, "error"), -FARTHEST, FARTHEST), NINETY_FIVE * percent(found, "std")
            marks += points(places, inside, look, tool, half, width=0, size=4.0)
        title = f"{name}: error with 95 % interval [%]; errors beyond {FARTHEST:g} % lie at the edge"
        y = Scale(ends=(-1.05 * FARTHEST, 1.05 * FARTHEST))
        panels.append(Panel(title, marks, named_axis(kinds), y, 900, 220))
    return Figure("peers", panels, columns=1)


def benchmarks(report: Row) -> Figure:
    """One panel for each part of the report that is there."""
    panels = [_times(f"{start} initial state", rows) for start, rows in report["fits"].items()]
    panels += [_growth(report["growth"])] if report["growth"] else []
    panels += [_roofline(report["roofline"])] if "share" in report["roofline"] else []
    return Figure("benchmarks", [panel._replace(width=430, height=300) for panel in panels], columns=2)


def _times(title: str, rows: dict[str, Row]) -> Panel:
    """A bar for each contender from the fastest to the slowest; a line from its shortest to its longest lap."""
    timed = sorted((row["median_seconds"], name) for name, row in rows.items() if "laps" in row)
    ours, others = (look.color for look in styles(["ibss", "svsf"]).values())
    low = 0.5e3 * min((rows[name]["min_seconds"] for _, name in timed), default=1e-3)
    marks: list[Mark] = []
    for place, (seconds, name) in enumerate(timed):
        color, ends = ours if is_ours(name) else others, [1e3 * rows[name][f"{end}_seconds"] for end in ("min", "max")]
        marks += [Band((low, 1e3 * seconds), 2 * [place - 0.3], 2 * [place + 0.3], color, 0.8)]
        marks += [Line(ends, 2 * [place], width=1.3)]
    y = named_rows(name for _, name in timed)
    return Panel(title, marks, Scale("log", label="ms / flight"), y)


def _growth(rows: list[Row]) -> Panel:
    """Time of one flight against each size."""
    marks: list[Mark] = []
    for (axis, label), look in zip(GROWTH.items(), styles(["ibss", "network", "hybrid"]).values(), strict=True):
        some = [row for row in rows if row["axis"] == axis]
        times = 1e3 * np.array([row["median_seconds"] for row in some])
        marks += points([row["size"] for row in some], times, look, label)
    return Panel("growth: ms / flight", marks, Scale("log", label="size"), Scale("log"))


def _roofline(found: dict[str, float]) -> Panel:
    """The most operations that the machine allows at each number of operations for each byte, and our shots."""
    peak, stream = found["peak_operations_per_second"] / 1e9, found["peak_bytes_per_second"] / 1e9
    corner, at = peak / stream, found["operations_per_step"] / found["bytes_per_step"]
    x = np.geomspace(min(corner, at) / 10, max(corner, at) * 10, 50)
    marks = [Line(x, np.minimum(peak, stream * x), name="peak"), Line((at, at), EVERYWHERE, FAINT, 0.8)]
    marks += points([at], [found["operations_per_second"] / 1e9], styles(["ibss"])["ibss"], "our shots", width=0)
    return Panel("roofline: Gop/s", marks, Scale("log", label="operations / byte"), Scale("log"))
