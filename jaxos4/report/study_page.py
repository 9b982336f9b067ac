"""The report of a study: its figures with their captions, and one HTML page that needs no other file."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import xarray as xr
from matplotlib.figure import Figure

from .._files import check_writable, write_atomically
from . import example_figures, study_figures, study_tables
from .html import Drawing, drawings, render
from .study_data import Scenario, names, scenarios
from .style import drawing, pdf, styles, svg

MOST_DRAWN = 12
"""At most so many scenarios have figures. All scenarios have tables."""

# Attributes of the Dataset, and their labels on the page.
_PROVENANCE = {"version": "jaxos4", "jax": "jax", "precision": "precision", "device": "device", "seed": "seed"}


class Kind(NamedTuple):
    """A figure that a study can have.

    - `draw`: returns nothing if the data are absent.
    - `of_scale`: it shows one noise scale: the files the one nearest 1, the page the one that the reader chooses. Then
      `draw` also takes the figure of another scale, and draws into it.
    """

    name: str
    title: str
    caption: str
    source: str
    draw: Callable[..., Figure | None]
    of_scale: bool = False


OF_SCENARIOS = (
    Kind(
        "error",
        "Error against noise",
        "Root-mean-square error over the converged flights, with the Cramer-Rao bound of the channels used.",
        "estimate, truth, bound, seen, result",
        study_figures.errors,
    ),
    Kind(
        "efficiency",
        "Efficiency against noise",
        "RMSE / bound, each estimator relative to its own bound, with 95 % Monte-Carlo intervals. 1 is the best that "
        "an unbiased estimator can do.",
        "estimate, truth, bound, result",
        study_figures.efficiency,
    ),
    Kind(
        "distribution",
        "Distribution of the errors",
        "Error / bound: median, quartiles, and 95 % of the flights. The line of an efficient estimator reaches from "
        "one dashed line to the other. The file shows the noise scale nearest 1.",
        "estimate, truth, bound, result",
        study_figures.distribution,
        of_scale=True,
    ),
    Kind(
        "rollouts",
        "Accuracy against rollouts",
        "RMSE / least bound of any estimator (geometric mean over the parameters) against simulated flights.",
        "estimate, truth, bound, rollouts, result",
        study_figures.rollouts,
    ),
    Kind(
        "coverage",
        "Coverage by level",
        "Share of intervals that hold the truth, averaged over the parameters, with 95 % Monte-Carlo intervals. Long "
        "lines: the level that the intervals claim.",
        "estimate, truth, half_width, result",
        study_figures.coverage,
    ),
    Kind(
        "frontier",
        "The noise below which a parameter can be distinguished from 0",
        "Below its noise scale, a parameter is larger than 1.96 Cramer-Rao bounds. Above it, no estimator can "
        "distinguish the parameter from 0.",
        "truth, bound, seen",
        study_figures.frontier,
    ),
)
"""The figures of each scenario."""

OF_EXAMPLE = (
    Kind(
        "trajectories",
        "Measured and simulated",
        "Dots: measured. Black, or white on a dark page: true. Coloured: simulated with each estimate.",
        "example_measured, example_true, example_simulated",
        example_figures.trajectories,
    ),
    Kind(
        "deviations",
        "Simulated minus true",
        "Deviation of each simulation from the truth, on the same flight.",
        "example_simulated, example_true",
        example_figures.deviations,
    ),
    Kind(
        "path",
        "The path in space",
        "Dots: measured. Black, or white on a dark page: true. Coloured: simulated with each estimate.",
        "example_measured, example_true, example_simulated",
        example_figures.path,
    ),
    Kind(
        "search",
        "The search of IBSS",
        "Half-widths and centres of the brackets after each sweep, on the example flight.",
        "search_half_width, search_estimate",
        example_figures.search,
    ),
    Kind(
        "training",
        "Training",
        "Loss of the networks during training.",
        "training_loss, validation_loss, training_step",
        example_figures.training,
    ),
)
"""The figures of the study's one example flight and of its networks."""


class Drawn(NamedTuple):
    """A figure of one study: the bytes of its files, and the drawings among which the reader of the page chooses."""

    stem: str
    kind: Kind
    svg: bytes
    pdf: bytes | None
    drawings: tuple[Drawing, ...]


def write_report(dataset: xr.Dataset, directory: Path, *, with_pdf: bool = True) -> list[Path]:
    """Writes `report.html`, `figures/*.svg` and `figures/*.pdf` into `directory`; returns their paths, the page first.

    **Arguments:**

    - `with_pdf`: if false, figures are SVG only, which takes half the time.

    All figures are drawn before the first file is written. Figures that only an older report has are removed.
    """
    target, folder = directory / "report.html", directory / "figures"
    check_writable(target)
    every = list(scenarios(dataset))
    sections: list[tuple[Scenario, list[Drawn]]] = []
    for scenario in every:
        shown = OF_SCENARIOS if scenario.number <= MOST_DRAWN else ()
        suffix = f"-{scenario.number}" if len(every) > 1 else ""
        sections.append((scenario, list(draw(shown, scenario.data, suffix=suffix, with_pdf=with_pdf))))
    once = list(draw(OF_EXAMPLE, dataset, with_pdf=with_pdf))
    page = _page(dataset, sections, once).encode()
    folder.mkdir(exist_ok=True)
    files: dict[Path, bytes] = {}
    for drawn in [drawn for _, of_scenario in sections for drawn in of_scenario] + once:
        files[folder / f"{drawn.stem}.svg"] = drawn.svg
        if drawn.pdf is not None:
            files[folder / f"{drawn.stem}.pdf"] = drawn.pdf
    for path, content in (*files.items(), (target, page)):
        with write_atomically(path) as beside:
            beside.write_bytes(content)
    kinds = "|".join(kind.name for kind in (*OF_SCENARIOS, *OF_EXAMPLE))
    for path in folder.iterdir():
        if path not in files and re.fullmatch(rf"({kinds})(-\d+)?\.(svg|pdf)", path.name):
            path.unlink()
    return [target, *files]


def draw(kinds: tuple[Kind, ...], data: xr.Dataset, *, suffix: str = "", with_pdf: bool = True) -> Iterator[Drawn]:
    """The figures of these kinds, without those whose data are absent. `suffix`: of the names of the files."""
    for kind in kinds:
        with drawing():
            figure = kind.draw(data)
            if figure is None:
                continue
            as_svg, as_pdf = svg(figure), pdf(figure) if with_pdf else None
            choices = _of_each_scale(kind, data, figure, as_svg) if kind.of_scale else {"": as_svg}
        stem, description = f"{kind.name}{suffix}", f"{kind.title}: {kind.caption}"
        chosen, estimators = list(choices.values()).index(as_svg), names(data, "estimator")
        shown = drawings(choices, chosen, stem=stem, description=description, estimators=estimators)
        yield Drawn(stem, kind, as_svg, as_pdf, shown)


def _of_each_scale(kind: Kind, data: xr.Dataset, figure: Figure, nearest: bytes) -> dict[str, bytes]:
    """The figure of each noise scale. `figure`: of the scale nearest 1, and `nearest`, its bytes."""
    choices = {}
    for place, scale in enumerate(data["scale"].values):
        label = f"noise x {scale:g}"
        if place == study_figures.nearest_scale(data):
            choices[label] = nearest
        elif kind.draw(data.isel(scale=[place]), figure) is not None:
            choices[label] = svg(figure)
    return choices


def _page(dataset: xr.Dataset, sections: list[tuple[Scenario, list[Drawn]]], once: list[Drawn]) -> str:
    """The page. `sections`: each scenario with its figures; `once`: figures that belong to no scenario."""
    attributes = {name: str(value) for name, value in dataset.attrs.items()}
    known = styles(names(dataset, "estimator"))
    missing, cells = study_tables.cells_not_run(dataset)
    return render(
        "study.html.j2",
        title=attributes.get("title", "") or "A study",
        command=attributes.get("command", ""),
        specification=attributes.get("specification", ""),
        provenance=[(label, attributes[name]) for name, label in _PROVENANCE.items() if name in attributes],
        estimators=[(place, name, look.color) for place, (name, look) in enumerate(known.items())],
        sections=[_section(scenario, drawn) for scenario, drawn in sections],
        once=once,
        failed=study_tables.failed_cells(dataset),
        missing=missing,
        cells=cells,
        drawn=sum(bool(drawn) for _, drawn in sections),
        zero_scale=bool((dataset["scale"] == 0).any()),
    )


def _section(scenario: Scenario, drawn: list[Drawn]) -> dict[str, Any]:
    return {
        "number": scenario.number,
        "label": scenario.label,
        "figures": {figure.kind.name: figure for figure in drawn},
        "tables": study_tables.scenario_tables(scenario.data),
        "trouble": study_tables.troubled_flights(scenario.data),
    }
