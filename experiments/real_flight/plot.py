"""The moments of inertia that each flight says, with 95 % intervals, and how well what was not fitted is predicted."""

from typing import Any

from matplotlib.figure import Figure

from experiments.drawing import grid
from experiments.shared import plotter, read_json
from jaxos4.report.style import BOUND_DASHES, INK, styles
from jaxos4.results import NINETY_FIVE

INERTIAS, RATES = ("Ix", "Iy"), ("p", "q")


def draw(report: dict[str, Any]) -> Figure:
    """Above a panel for each moment of inertia, below one for the skill of each rate; a color for each estimator."""
    figure, panels = grid(4, columns=2, height=2.8)
    looks = styles(list(report["estimators"]))
    flights = list(next(iter(report["estimators"].values()))["flights"])
    for number, (estimator, rows) in enumerate(report["estimators"].items()):
        shift = 0.2 * (number - (len(looks) - 1) / 2)
        look = {"color": looks[estimator].color, "marker": looks[estimator].marker, "linestyle": "none", "capsize": 2}
        for panel, name in zip(panels[:2], INERTIAS, strict=True):
            some = [
                (k, row["constants"][name])
                for k, row in enumerate(rows["flights"].values())
                if name in row["constants"]
            ]
            y, std = ([1e5 * x[part] for _, x in some] for part in ("estimate", "std"))
            arms = [NINETY_FIVE * each for each in std]
            panel.errorbar([k + shift for k, _ in some], y, arms, label=estimator, **look)
        for panel, rate in zip(panels[2:], RATES, strict=True):
            for k, row in enumerate(rows["flights"].values()):
                if rate in row["ahead"]:
                    value, std = row["ahead"][rate]
                    panel.errorbar([k + shift], [value], [NINETY_FIVE * std], **look)
    for panel, name in zip(panels[:2], INERTIAS, strict=True):
        panel.axhline(1e5 * report["authors"][name], color=INK, linestyle=BOUND_DASHES[2], label="the flights' authors")
        panel.set_title(f"{name} [1e-5 kg m²], 95 %")
        panel.set_yscale("log")
    for panel, rate in zip(panels[2:], RATES, strict=True):
        panel.axhline(0, color=INK, linewidth=0.8)
        panel.set_title(f"skill in {rate}, 0.25 s ahead; 0: as good as no change")
        panel.set_ylim(-1, 1)
    for panel in panels:
        panel.set_xticks(range(len(flights)), flights)
        panel.grid(visible=False, axis="x")
    figure.legend(*panels[0].get_legend_handles_labels(), ncols=3, loc="outside lower center")
    return figure


main = plotter(read_json, {"real_flight": draw})
