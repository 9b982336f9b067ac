"""Errors and intervals of each quantity for each effect of real flights, an estimator each figure's colour."""

import numpy as np
from matplotlib.figure import Figure

from experiments.drawing import grid
from experiments.fits import INERTIAS, THRUST
from experiments.shared import plotter, read_json
from jaxos4.report.style import INK, styles


def draw(report: dict) -> Figure:
    """A panel for each quantity: above mean error and median half-width, below the coverage of the intervals."""
    quantities = (*INERTIAS, THRUST)
    figure, panels = grid(2 * len(quantities), columns=len(quantities), height=3.0)
    kinds = list(dict.fromkeys(case["kind"] for case in report["cases"]))
    names = list(dict.fromkeys(case["estimator"] for case in report["cases"]))
    for column, quantity in enumerate(quantities):
        error, covered = panels[column], panels[column + len(quantities)]
        error.axvline(0, color=INK, linewidth=1.0)
        covered.axvline(95, color=INK, linewidth=1.0)
        for shift, (name, look) in zip(np.linspace(-0.2, 0.2, len(names)), styles(names).items(), strict=True):
            cases = [case for case in report["cases"] if case["estimator"] == name and quantity in case["summary"]]
            rows = [case["summary"][quantity] for case in cases]
            places = [kinds.index(case["kind"]) + shift for case in cases]
            line = {"color": look.color, "marker": look.marker, "linestyle": "", "label": name}
            widths = [100 * row["width"] for row in rows]
            error.errorbar([100 * row["mean"] for row in rows], places, xerr=widths, **line)
            covered.plot([100 * row["covered"] for row in rows], places, **line)
        error.set_title(f"{quantity}: mean error [%]")
        covered.set_title(f"{quantity}: covered [%]")
        covered.set_xlim(-5, 105)
        for panel in (error, covered):
            panel.set_yticks(range(len(kinds)), kinds if column == 0 else [""] * len(kinds))
            panel.set_ylim(len(kinds) - 0.5, -0.5)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


main = plotter(read_json, {"closed_loop_effects": draw})
