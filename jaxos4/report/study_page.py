"""The report of a study: its figures with their captions, and one HTML page that needs no other file."""

from collections.abc import Callable, Mapping
from pathlib import Path

import xarray as xr
from matplotlib.figure import Figure

from .._files import check_writable, write_file
from . import study_figures, study_tables
from .html import Drawing, draw as draw_panels, render, swatch
from .study_tables import Scenario, best_estimators, bounds, names, scenarios
from .style import BOUND_DASHES, drawing, styles

MOST_DRAWN = 12
"""At most so many scenarios have figures. All scenarios have tables."""

# Attributes of the Dataset, and their labels on the page.
_PROVENANCE = {"version": "jaxos4", "jax": "jax", "precision": "precision", "device": "device", "seed": "seed"}


# The figures of each scenario. Each draws nothing if its data are absent. `study.html.j2` has titles and captions.
SCENARIO_FIGURES: dict[str, Callable[..., Figure | None]] = {
    "overview": study_figures.overview,
    "error": study_figures.errors,
    "efficiency": study_figures.efficiency,
    "coverage": study_figures.coverage,
}


def write_report(dataset: xr.Dataset, directory: Path) -> list[Path]:
    """Writes `report.html` and `figures/*.svg` into `directory`; returns their paths, the page first.

    All figures are drawn before the first file is written.
    """
    target, folder = directory / "report.html", directory / "figures"
    check_writable(target)
    every, sections = list(scenarios(dataset)), []
    for scenario in every:
        shown = SCENARIO_FIGURES if scenario.number <= MOST_DRAWN else {}
        sections.append((scenario, draw(shown, scenario.data, f"-{scenario.number}" if len(every) > 1 else "")))
    files = {target: _page(dataset, sections).encode()}
    files |= {folder / f"{drawn.stem}.svg": drawn.svg for _, figures in sections for drawn in figures.values()}
    folder.mkdir(exist_ok=True)
    for path, content in reversed(files.items()):  # the page last
        write_file(path, content)
    return list(files)


def draw(figures: Mapping[str, Callable[..., Figure | None]], data: xr.Dataset, suffix: str = "") -> dict[str, Drawing]:
    """The figures whose data are present. `suffix`: the end of the names of the files."""
    made = {}
    for name, draw_figure in figures.items():
        with drawing():
            if (figure := draw_figure(data)) is not None:
                made[name] = draw_panels(figure, f"{name}{suffix}")
    return made


def _page(dataset: xr.Dataset, sections: list[tuple[Scenario, dict[str, Drawing]]]) -> str:
    """The page. `sections`: each scenario with its figures."""
    attributes = {name: str(value) for name, value in dataset.attrs.items()}
    estimators = names(dataset, "estimator")
    missing, cells = study_tables.cells_not_run(dataset)
    return render(
        "study.html.j2",
        title=attributes.get("title", "") or "A study",
        command=attributes.get("command", ""),
        specification=attributes.get("specification", ""),
        provenance=[(label, attributes[name]) for name, label in _PROVENANCE.items() if name in attributes],
        estimators=estimators,
        bounds=list(bounds(dataset))[: len(BOUND_DASHES)],
        swatches=[swatch(look) for look in styles(estimators).values()],
        sections=[
            scenario._asdict()
            | {"figures": drawn, "tables": study_tables.scenario_tables(scenario.data)}
            | {"trouble": study_tables.troubled_flights(scenario.data), "best": best_estimators(scenario.data)}
            for scenario, drawn in sections
        ],
        level=f"{100 * study_tables.shown_level(dataset):g} %",
        failed=study_tables.failed_cells(dataset),
        missing=missing,
        cells=cells,
        drawn=sum(bool(drawn) for _, drawn in sections),
        zero_scale=bool((dataset["scale"] == 0).any()),
    )
