"""A row a parameter: the share of 95 % intervals that hold the truth, with two Monte-Carlo errors, of each airframe."""

import numpy as np
from matplotlib.figure import Figure

from experiments.shared import plotter, read_json
from jaxos4.report.style import INK, grid, styles


def draw(report: dict) -> Figure:
    """A panel an airframe."""
    cases = report["cases"]
    figure, axes = grid(len(cases), columns=len(cases), height=4.2)
    look = styles(["ibss"])["ibss"]
    for panel, case in zip(axes, cases, strict=True):
        rows = case["summary"]
        y = np.arange(len(rows))
        panel.axvline(95, color=INK, linewidth=1.0)
        panel.errorbar(
            [100 * row["covered"] for row in rows.values()],
            y,
            xerr=[200 * row["monte_carlo_error"] for row in rows.values()],
            color=look.color,
            marker=look.marker,
            linestyle="none",
        )
        panel.set_ylim(len(rows) - 0.5, -0.5)
        panel.set_yticks(y, list(rows))
        panel.set_title(f"{case['airframe']}, {len(case['flights'])} flights")
        panel.set_xlabel("intervals that hold the truth [%]")
    return figure


main = plotter(read_json, {"dirty_flights": draw})
