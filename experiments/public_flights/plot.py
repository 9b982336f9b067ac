"""The error of predicted rates against the horizon, of each flight, and of the true vehicle in simulated gusts."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.drawing import grid
from experiments.shared import plotter, read_json
from jaxos4.report.style import styles

KINDS = {"error": "prediction", "constant": "constant rates", "network": "network for rates"}


def draw(report: dict[str, Any]) -> Figure:
    """A panel for each flight, and one for each strength of simulated gusts."""
    panels = {name: found["quantities"] for name, found in report["flights"].items()}
    panels |= {f"true vehicle, gusts of {gust} rad/s^2": found for gust, found in report["simulated"].items()}
    figure, every = grid(len(panels), columns=4, height=2.0)
    looks = styles(list(KINDS))
    for panel, (name, quantities) in zip(every, panels.items(), strict=True):
        for kind, label in KINDS.items():
            if kind not in quantities["p"]:
                continue
            error = np.mean([quantities[rate][kind] for rate in "pq"], axis=0)
            panel.plot(0.01 * np.arange(1, len(error) + 1), error, color=looks[kind].color, label=label)
        panel.set_title(name, fontsize="small")
        panel.set_ylim(0, None)
        panel.set_xlabel("ahead [s]")
    every[0].set_ylabel("error of p and q [rad/s]")
    figure.legend(*every[0].get_legend_handles_labels(), ncols=3, loc="outside lower center")
    return figure


main = plotter(read_json, {"public_flights": draw})
