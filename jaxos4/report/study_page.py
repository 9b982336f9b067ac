"""The report of a study: an HTML page that needs no other file, and the files of its figures."""

from collections.abc import Mapping
from pathlib import Path

import xarray as xr
from markupsafe import Markup

from .._files import check_writable, write_file
from ..errors import counted
from . import study_tables
from .page import Section, folded, picture, table, text, write_page
from .panels import Figure, styles
from .study_figures import FIGURES, draw
from .study_tables import names, scenarios
from .svg import as_file

MOST_DRAWN = 12
"""At most this many scenarios have figures. All scenarios have tables."""

# Attributes of the Dataset, and their labels on the page.
_PROVENANCE = {"version": "jaxos4", "jax": "jax", "precision": "precision", "device": "device", "seed": "seed"}
_SPECIFICATION = "specification.toml"
_AGAIN = f"jaxos4 study {_SPECIFICATION} --out .  # in the folder of this page"


def write_report(dataset: xr.Dataset, directory: Path, *, pdf: bool = False) -> list[Path]:
    """Writes `report.html` and `figures/*.svg`, and as PDF too if wanted; returns their paths, the page first.

    The specification is written too, as `specification.toml`: the page's command names it.
    """
    target, folder = directory / "report.html", directory / "figures"
    check_writable(target)
    every, sections, drawn = scenarios(dataset), list[Section](), list[Figure]()
    for number, (label, data) in enumerate(every, start=1):
        suffix, figures = f"-{number}" * (len(every) > 1), draw(data) if number <= MOST_DRAWN else {}
        figures = {name: figure._replace(stem=f"{name}{suffix}") for name, figure in figures.items()}
        sections += _scenario(number, label, data, figures)
        drawn += figures.values()
    attributes = {name: str(x) for name, x in dataset.attrs.items()}
    specification = attributes.get("specification", "")
    files = {folder / f"{figure.stem}.svg": as_file(figure) for figure in drawn}
    if pdf:
        from .matplotlib_figures import as_pdf  # a second

        files |= {folder / f"{figure.stem}.pdf": as_pdf(figure) for figure in drawn}
    folder.mkdir(exist_ok=True)
    if specification:
        write_file(directory / _SPECIFICATION, specification)
    for figure in () if pdf else drawn:  # from an earlier run: other figures
        (folder / f"{figure.stem}.pdf").unlink(missing_ok=True)
    for path, content in files.items():
        write_file(path, content)
    write_page(
        target,
        title=attributes.get("title", "") or "A study",
        about=_about(dataset),
        top=_trouble(dataset),
        sections=sections,
        end=_end(specification),
        command=_AGAIN if specification else "",
        provenance=[(shown, attributes[name]) for name, shown in _PROVENANCE.items() if name in attributes],
        estimators=styles(names(dataset, "estimator")),
    )
    return [target, *files]


def _about(dataset: xr.Dataset) -> str:
    counts = {"estimator": dataset.sizes["estimator"], "scenario": len(scenarios(dataset))}
    counts |= {"cell": study_tables.cells_not_run(dataset)[1]}
    sizes = (counted(count, kind) for kind, count in counts.items())
    of_one = (
        " Each scenario has one flight: there are answers, but no statistics. The file of a study holds no signals; "
        "jaxos4 estimate FLIGHT --report shows those of a flight."
    )
    about = f"Identification of a quadrotor's parameters from simulated, noisy flights: {', '.join(sizes)}."
    return about + of_one * (dataset.sizes["flight"] == 1)


def _trouble(dataset: xr.Dataset) -> list[Markup]:
    """Cells that were not run, and those that failed; scenarios without figures."""
    (missing, cells), (failed, listed) = study_tables.cells_not_run(dataset), study_tables.failed_cells(dataset)
    parts = []
    if missing:
        runs = "; the command at the end of the page runs them" * ("specification" in dataset.attrs)
        parts.append(text(f"Incomplete: {missing} of {cells} cells have not been run yet{runs}.", "warning"))
    if failed:
        parts += [text(f"{failed} of {cells} cells failed:", "warning"), text(listed)]
    if (count := len(scenarios(dataset))) > MOST_DRAWN:
        parts.append(text(f"The first {MOST_DRAWN} scenarios have figures; all {count} have tables.", "note"))
    return parts


def _scenario(number: int, label: str, data: xr.Dataset, figures: Mapping[str, Figure]) -> list[Section]:
    """The sections of one scenario."""
    of_one, estimators, tables = data.sizes["flight"] == 1, names(data, "estimator"), study_tables.scenario_tables(data)
    differ = "; ".join(f"{', '.join(who)} see {seen}" for seen, who in study_tables.channels_by_estimator(data).items())
    differ = f" Not of the same channels: {differ}" if "; " in differ else ""

    def drawn(name: str) -> Markup:
        if name not in figures:
            return Markup()
        (_, title, caption), figure = FIGURES[name], figures[name]
        title += differ * (name == "overview")
        return picture(figure, f"{caption} Drawn in figures/{figure.stem}.svg.", title)

    def shown(name: str) -> Markup:
        return table(f"{name}-{number}", *tables[name], estimators)

    def more(name: str, *others: str) -> Markup:
        return folded(f"Every number of the {name}", *map(shown, (name, *others)))

    def section(title: str, parts: list[Markup]) -> Section:
        return Section(f"{title.split()[0].lower()}-of-{number}", title, parts, level=3)

    first = []
    if of_one:
        ended = study_tables.ended(data)
        first.append(text(ended) if len(ended) > 1 else text(ended[0], "verdict"))
        first += [drawn("intervals"), shown("estimates")]
    elif best := study_tables.best_estimators(data):
        said = "; ".join(f"{who} at {scales}" for scales, who in best.items())
        first.append(text(f"Most accurate, within Monte-Carlo error: {said}.", "verdict"))
    sections = [Section(f"scenario-{number}", label, [*first, drawn("overview")])]
    if not of_one:
        sections += [
            section("Errors", [drawn("error"), shown("error")]),
            section("Efficiency", [drawn("efficiency"), more("efficiency")]),
            section("Coverage", [drawn("coverage"), more("coverage", "levels")]),
        ]
    lost = "A logarithmic axis cannot show the noise scale 0: it is in the tables only."
    lost *= bool(figures) and bool((data["scale"] == 0).any())
    return [*sections, section("Results and rollouts", [shown("results"), *_troubled(data), text(lost, "note")])]


def _troubled(data: xr.Dataset) -> list[Markup]:
    total, listed = study_tables.troubled_flights(data)
    first = f"; the first {len(listed)}" if len(listed) < total else ""
    note = "These flights are counted in the table above, but not in errors, efficiency and coverage."
    summary = f"{counted(total, 'flight')} without a successful result{first}"
    return [folded(summary, text(listed), text(note, "note"), is_open=True)] if total else []


def _end(specification: str) -> list[Markup]:
    note = (
        "All numbers on this page are computed from results.nc in this folder, by the functions of "
        "jaxos4.study.metrics that the captions name. Errors include flights with the result successful or "
        "unidentifiable. An unidentifiable estimate is a real estimate, but no better than its bracket."
    )
    shown = Markup("<pre>{}</pre>").format(specification)
    return [*[folded("Specification", shown, is_open=True)] * bool(specification), text(note, "note")]
