"""The report of a study as one HTML page that needs no other file."""

from typing import Any

import jinja2
import xarray as xr

from . import tables
from .figures import Drawn
from .inline import drawings
from .scenario import Scenario, names
from .style import styles

MOST_DRAWN = 12
"""At most so many scenarios have figures. All scenarios have tables."""

# Attributes of the Dataset, and their labels on the page.
_PROVENANCE = {"version": "jaxos4", "jax": "jax", "precision": "precision", "device": "device", "seed": "seed"}


def page(dataset: xr.Dataset, sections: list[tuple[Scenario, list[Drawn]]], once: list[Drawn]) -> str:
    """The page. `sections`: each scenario with its figures; `once`: figures that belong to no scenario."""
    attributes = {name: str(value) for name, value in dataset.attrs.items()}
    known = styles(names(dataset, "estimator"))
    missing, cells = tables.cells_not_run(dataset)
    return (
        environment()
        .get_template("template.html.j2")
        .render(
            title=attributes.get("title", "") or "A study",
            command=attributes.get("command", ""),
            specification=attributes.get("specification", ""),
            provenance=[(label, attributes[name]) for name, label in _PROVENANCE.items() if name in attributes],
            estimators=[(place, name, look.color) for place, (name, look) in enumerate(known.items())],
            sections=[_section(scenario, drawn) for scenario, drawn in sections],
            once=[_figure(drawn, list(known)) for drawn in once],
            failed=tables.failed_cells(dataset),
            missing=missing,
            cells=cells,
            drawn=sum(bool(drawn) for _, drawn in sections),
            zero_scale=bool((dataset["scale"] == 0).any()),
        )
    )


def _section(scenario: Scenario, drawn: list[Drawn]) -> dict[str, Any]:
    data = scenario.data
    made = (
        tables.error_table(data),
        tables.efficiency_table(data),
        tables.coverage_table(data),
        tables.levels_table(data),
        tables.result_table(data),
    )
    return {
        "number": scenario.number,
        "label": scenario.label,
        "figures": {figure.kind.name: _figure(figure, names(data, "estimator")) for figure in drawn},
        "tables": {table.name: table for table in made},
        "trouble": tables.troubled_flights(data),
    }


def _figure(drawn: Drawn, estimators: list[str]) -> dict[str, Any]:
    return {
        "stem": drawn.stem,
        "kind": drawn.kind,
        "drawings": drawings(
            list(drawn.choices.values()),
            list(drawn.choices),
            list(drawn.choices.values()).index(drawn.svg),
            stem=drawn.stem,
            description=f"{drawn.kind.title}: {drawn.kind.caption}",
            estimators=estimators,
        ),
    }


def environment() -> jinja2.Environment:
    """The environment of the templates in this folder."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader("jaxos4.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
