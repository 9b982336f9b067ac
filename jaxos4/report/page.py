"""The report as one HTML page that needs nothing but itself."""

import json
from typing import Any

import jinja2
import xarray as xr
from markupsafe import Markup, escape
from plotly.offline import get_plotlyjs

from . import tables
from .charts import charts
from .figures import Drawn
from .inline import inline
from .scenario import Scenario, names
from .style import styles

MOST_DRAWN = 12
"""So many scenarios have figures; the tables are of all."""

# What is known of a run, and how it is called on the page.
_PROVENANCE = (
    ("version", "jaxos4"),
    ("jax", "jax"),
    ("precision", "precision"),
    ("device", "device"),
    ("seed", "seed"),
)


def page(dataset: xr.Dataset, sections: list[tuple[Scenario, list[Drawn]]], once: list[Drawn]) -> str:
    """The page. `sections`: each scenario with its figures; `once`: the figures of the study as a whole."""
    attributes = {name: str(value) for name, value in dataset.attrs.items()}
    known = styles(names(dataset, "estimator"))
    interactive: dict[str, Any] = {}
    shown = [_section(scenario, drawn, interactive) for scenario, drawn in sections]
    missing, cells = tables.cells_not_run(dataset)
    return (
        environment()
        .get_template("template.html.j2")
        .render(
            title=attributes.get("title", "") or "A study",
            command=attributes.get("command", ""),
            specification=_indented(attributes.get("specification", "")),
            provenance=[(label, attributes[name]) for name, label in _PROVENANCE if name in attributes],
            estimators=[(place, name, look.color) for place, (name, look) in enumerate(known.items())],
            sections=shown,
            once=[_figure(drawn) for drawn in once],
            failed=tables.failed_cells(dataset),
            missing=missing,
            cells=cells,
            drawn=sum(bool(drawn) for _, drawn in sections),
            zero_scale=bool((dataset["scale"] == 0).any()),
            charts=script_json(interactive),
            plotly=Markup(get_plotlyjs().replace("</script", "<\\/script")),  # noqa: S704, the package's own script
        )
    )


def _section(scenario: Scenario, drawn: list[Drawn], interactive: dict[str, Any]) -> dict[str, Any]:
    data, figures = scenario.data, {figure.kind.name: _figure(figure) for figure in drawn}
    for name, chart in charts(data) if drawn else ():
        if name in figures:
            figures[name] |= {"chart": f"{name}-{scenario.number}", "svg": ""}
            interactive[f"{name}-{scenario.number}"] = chart
    return {
        "number": scenario.number,
        "label": scenario.label,
        "figures": figures,
        "tables": {
            table.name: table
            for table in (
                tables.error_table(data),
                tables.efficiency_table(data),
                tables.coverage_table(data),
                tables.levels_table(data),
                tables.result_table(data),
            )
        },
        "trouble": tables.troubled_flights(data),
    }


def _figure(drawn: Drawn) -> dict[str, Any]:
    label = str(escape(f"{drawn.kind.title}: {drawn.kind.caption}"))
    return {
        "stem": drawn.stem,
        "kind": drawn.kind,
        "svg": Markup(inline(drawn.svg, drawn.stem, label)),  # noqa: S704, drawn by us: names in it are outlines
        "chart": "",
    }


def _indented(specification: str) -> str:
    """For reading: a JSON object with a line for each of its names; anything else as it is."""
    try:
        table = json.loads(specification)
    except ValueError:
        return specification
    if not isinstance(table, dict):
        return specification
    lines = (f"  {json.dumps(name)}: {json.dumps(value, ensure_ascii=False)}" for name, value in table.items())
    return "{\n" + ",\n".join(lines) + "\n}"


def script_json(x: Any) -> Markup:
    """JSON that cannot end the script that it stands in."""
    text = json.dumps(x, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))  # noqa: S704


def environment() -> jinja2.Environment:
    """Of the templates beside this file."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader("jaxos4.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
