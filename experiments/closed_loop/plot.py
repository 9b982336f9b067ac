"""Bias and interval coverage of the moments of inertia against the strength of gusts, a line for each estimator."""

from matplotlib.figure import Figure

from experiments.drawing import grid
from experiments.shared import plotter, read_json
from jaxos4.report.style import INK, styles

INERTIAS = ("Ix", "Iy", "Iz")


def draw(report: dict) -> Figure:
    """Above the bias, below the coverage: a panel for each moment of inertia, bars of two Monte-Carlo errors."""
    figure, panels = grid(6, columns=3, height=2.4)
    gusts = sorted({case["gust"] for case in report["cases"]})
    names = list(dict.fromkeys(case["estimator"] for case in report["cases"]))
    for column, inertia in enumerate(INERTIAS):
        bias, covered = panels[column], panels[column + 3]
        bias.axhline(0, color=INK, linewidth=1.0)
        covered.axhline(95, color=INK, linewidth=1.0)
        for name, look in styles(names).items():
            cases = [case for case in report["cases"] if case["estimator"] == name and inertia in case["summary"]]
            rows = {case["gust"]: case["summary"][inertia] for case in sorted(cases, key=lambda case: case["gust"])}
            line = {"color": look.color, "marker": look.marker, "linestyle": look.dash, "label": name}
            for panel, key in ((bias, "bias"), (covered, "covered")):
                errors = [200 * (row[f"{key}_error"] or 0) for row in rows.values()]
                panel.errorbar(list(rows), [100 * row[key] for row in rows.values()], yerr=errors, **line)
        bias.set_title(f"{inertia}: bias [%]")
        covered.set_title(f"{inertia}: 95 % intervals that hold the truth [%]")
        covered.set_ylim(-5, 105)
        for panel in (bias, covered):
            panel.set_xticks(gusts, [f"{gust:g}" for gust in gusts])
            panel.set_xlabel("gusts [rad/s^2]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


main = plotter(read_json, {"closed_loop": draw})
