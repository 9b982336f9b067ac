"""The benchmark as a figure: time of one flight by contender, growth, and the roofline."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.benchmarks.contenders import is_ours
from experiments.drawing import log_axis
from experiments.shared import plotter, read_json
from jaxos4.report.style import FAINT, INK, styles

_AXES = {"flights": "flights in one call", "steps": "steps (rates alone)", "unknowns": "unknowns"}


def _draw_times(panel: Axes, title: str, rows: dict[str, Any]) -> None:
    """A bar for each contender from the fastest to the slowest; a line from its shortest to its longest lap."""
    timed = sorted((row["median_seconds"], name) for name, row in rows.items() if "laps" in row)
    names = [name for _, name in timed]
    ours, others = (look.color for look in styles(["ibss", "svsf"]).values())
    for place, (seconds, name) in enumerate(timed):
        row = rows[name]
        panel.barh(place, 1e3 * seconds, color=ours if is_ours(name) else others, height=0.6)
        panel.plot([1e3 * row["min_seconds"], 1e3 * row["max_seconds"]], [place, place], color=INK, linewidth=1.0)
    panel.set_yticks(range(len(names)), names)
    panel.set_ylim(len(names) - 0.4, -0.6)
    panel.grid(axis="y", visible=False)
    panel.set_title(title)
    log_axis(panel, "x")
    panel.set_xlabel("ms / flight")


def _draw_growth(panel: Axes, rows: list[dict[str, Any]]) -> None:
    """Time of one flight against each size."""
    for (axis, label), look in zip(_AXES.items(), styles(["ibss", "network", "hybrid"]).values(), strict=True):
        some = [row for row in rows if row["axis"] == axis]
        if some:
            x, y = ([row[key] for row in some] for key in ("size", "median_seconds"))
            panel.plot(x, 1e3 * np.array(y), color=look.color, marker=look.marker, linestyle=look.dash, label=label)
    log_axis(panel, "x")
    log_axis(panel, "y")
    panel.set_title("growth")
    panel.set_xlabel("size")
    panel.set_ylabel("ms / flight")
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
    log_axis(panel, "x")
    log_axis(panel, "y")
    panel.set_title("roofline")
    panel.set_xlabel("operations / byte")
    panel.set_ylabel("Gop/s")
    panel.legend()


def draw(report: dict[str, Any]) -> Figure:
    """One panel for each part of the report that is there."""
    parts = [(_draw_times, (f"{start} initial state", rows)) for start, rows in report["fits"].items()]
    parts += [(_draw_growth, (report["growth"],))] if report["growth"] else []
    parts += [(_draw_roofline, (report["roofline"],))] if "share" in report["roofline"] else []
    rows = -(-len(parts) // 2)
    figure = Figure(figsize=(9.0, 2.9 * rows), layout="constrained")
    for place, (function, arguments) in enumerate(parts):
        function(figure.add_subplot(rows, min(2, len(parts)), place + 1), *arguments)
    return figure


main = plotter(read_json, {"benchmarks": draw})
