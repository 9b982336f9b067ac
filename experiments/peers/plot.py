"""The 95 % intervals of Ix and Iy that each tool gives for the same simulated flights, beside the truth."""

from typing import Any

from matplotlib.figure import Figure

from experiments.drawing import grid
from experiments.shared import plotter, read_json
from jaxos4.report.style import INK, styles
from jaxos4.results import NINETY_FIVE

FARTHEST = 60.0  # %; what lies beyond is drawn at the edge
SHOWN = "Crazyflie, 0", "Crazyflie, 2", "Crazyflie, 5", "MuJoCo, 2", "RotorPy, calm", "RotorPy, gusty"


def draw(report: dict[str, Any]) -> Figure:
    """A panel for each moment of inertia; side by side the flights of a kind, a color for each tool."""
    figure, panels = grid(2, columns=1, height=2.3)
    tools = list(dict.fromkeys(row["tool"] for row in report["rows"]))
    kinds = [kind for kind in SHOWN if any(row["case"] == kind for row in report["rows"])]
    for panel, name in zip(panels, ("Ix", "Iy"), strict=True):
        panel.axhline(0, color=INK, linewidth=1.0)
        for number, (tool, look) in enumerate(styles(tools).items()):
            places, errors, arms = [], [], []
            for k, kind in enumerate(kinds):
                rows = [
                    row[name] for row in report["rows"] if (row["case"], row["tool"]) == (kind, tool) and name in row
                ]
                for i, row in enumerate(rows):
                    places.append(k + (number + (i + 1) / (len(rows) + 1)) / (len(tools) + 0.5) - 0.45)
                    errors.append(100 * row["error"])
                    arms.append(100 * NINETY_FIVE * row["std"])
            inside = [min(max(error, -FARTHEST), FARTHEST) for error in errors]
            bars = {"color": look.color, "marker": look.marker, "linestyle": "none", "markersize": 3}
            panel.errorbar(places, inside, arms, label=tool, **bars)
        panel.set_title(f"{name}: error with 95 % interval [%]; errors beyond {FARTHEST:g} % lie at the edge")
        panel.set_ylim(-1.05 * FARTHEST, 1.05 * FARTHEST)
        panel.set_xticks(range(len(kinds)), kinds)
        panel.grid(visible=False, axis="x")
    figure.legend(*panels[0].get_legend_handles_labels(), ncols=4, loc="outside lower center")
    return figure


main = plotter(read_json, {"peers": draw})
