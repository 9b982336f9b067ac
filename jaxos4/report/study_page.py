"""The report of a study: the figures of its scenarios, and one HTML page that needs no other file."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import xarray as xr
from markupsafe import Markup

from .._files import check_writable, write_file
from ..logs.table import counted
from ..study import metrics
from . import study_of_one_flight, study_tables
from .page import Section, folded, picture, table, text, write_page
from .panels import Figure, Line, Panel, Scale, across, spread
from .study_tables import ScenarioData, best_estimators, bounds, error_unit, names, positive_scales, scenarios
from .style import BOUND_DASHES, Style, styles
from .svg import as_file
from .text import plain

MOST_DRAWN = 12
"""At most this many scenarios have figures. All scenarios have tables."""

# Attributes of the Dataset, and their labels on the page.
_PROVENANCE = {"version": "jaxos4", "jax": "jax", "precision": "precision", "device": "device", "seed": "seed"}
_SPECIFICATION = "specification.toml"
_AGAIN = f"jaxos4 study {_SPECIFICATION} --out .  # in the folder of this page"
_WIDEST, _NARROWEST = 4.0, 1.4  # line widths [px] of the first and the last estimator, so that none hides another
_EVERYWHERE = (-np.inf, np.inf)
_BEST = "1 is the best that an unbiased estimator can do."
# Of each figure: its title and its caption.
_WORDS = {
    "intervals": (
        "Estimates and their intervals",
        "Estimate - truth of each parameter, in multiples of the smallest Cramer-Rao bound of any estimator, with "
        "intervals. The line at 0 is the truth. From estimate, truth, half_width, bound.",
    ),
    "overview": (
        "Which method, at which noise?",
        "RMSE / least bound of any estimator (geometric mean over the parameters), with the 95 % Monte-Carlo interval "
        f"of one parameter; left against noise, right against simulated flights. {_BEST} An estimator that looks at "
        "the body rates alone cannot reach 1 if others see more channels. From metrics.accuracy, mean_rollouts.",
    ),
    "error": (
        "Error against noise",
        "Root-mean-square error over the converged flights, and the Cramer-Rao bounds of the channels used. From "
        "metrics.estimator_error, bound_error.",
    ),
    "efficiency": (
        "Efficiency against noise",
        f"RMSE / bound, each estimator relative to its own bound, with 95 % Monte-Carlo intervals. {_BEST} From "
        "metrics.efficiency.",
    ),
    "coverage": (
        "Coverage by level",
        "Share of intervals that contain the truth, averaged over the parameters, with 95 % Monte-Carlo intervals. "
        "Long lines: the level that the intervals claim. From metrics.mean_coverage.",
    ),
}


def write_report(dataset: xr.Dataset, directory: Path, *, pdf: bool = False) -> list[Path]:
    """Writes `report.html` and `figures/*.svg`, and as PDF too if wanted; returns their paths, the page first.

    The specification is written too, as `specification.toml`: the page's command names it.
    """
    target, folder = directory / "report.html", directory / "figures"
    check_writable(target)
    sections, drawn, several = [], [], len(list(scenarios(dataset))) > 1
    for scenario in scenarios(dataset):
        figures = draw(scenario, several=several) if scenario.number <= MOST_DRAWN else {}
        sections += _scenario(scenario, figures, bool((dataset["scale"] == 0).any()))
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
    for figure in () if pdf else drawn:  # those of another run would not be of these figures
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
    counts = names(dataset, "estimator"), list(scenarios(dataset)), range(study_tables.cells_not_run(dataset)[1])
    sizes = (counted(len(each), kind) for each, kind in zip(counts, ("estimator", "scenario", "cell"), strict=True))
    of_one = (
        " Each scenario has one flight: there are answers, but no statistics. The file of a study holds no signals; "
        "jaxos4 estimate FLIGHT --report shows those of a flight."
    )
    about = f"Identification of a quadrotor's parameters from simulated, noisy flights: {', '.join(sizes)}."
    return about + of_one * study_of_one_flight.is_of_one(dataset)


def _trouble(dataset: xr.Dataset) -> list[Markup]:
    """Cells that were not run, and those that failed; scenarios without figures."""
    (missing, cells), (failed, listed) = study_tables.cells_not_run(dataset), study_tables.failed_cells(dataset)
    parts = []
    if missing:
        runs = "; the command at the end of the page runs them" * ("specification" in dataset.attrs)
        parts.append(text(f"Incomplete: {missing} of {cells} cells have not been run yet{runs}.", "warning"))
    if failed:
        parts += [text(f"{failed} of {cells} cells failed:", "warning"), text(listed)]
    if (count := len(list(scenarios(dataset)))) > MOST_DRAWN:
        parts.append(text(f"The first {MOST_DRAWN} scenarios have figures; all {count} have tables.", "note"))
    return parts


def _scenario(scenario: ScenarioData, figures: Mapping[str, Figure], has_zero: bool) -> list[Section]:
    """The sections of one scenario."""
    number, label, data = scenario
    of_one, estimators = study_of_one_flight.is_of_one(data), names(data, "estimator")
    tables = {"estimates": study_of_one_flight.estimates(data)} if of_one else {}
    tables |= study_tables.scenario_tables(data)
    differ = "; ".join(f"{', '.join(who)} see {seen}" for seen, who in study_tables.channels_by_estimator(data).items())
    differ = f" Not of the same channels: {differ}" if "; " in differ else ""

    def drawn(name: str) -> Markup:
        if name not in figures:
            return Markup()
        (title, caption), figure = _WORDS[name], figures[name]
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
        outcomes = study_of_one_flight.outcomes(data)
        first.append(text(outcomes) if len(outcomes) > 1 else text(outcomes[0], "verdict"))
        first += [drawn("intervals"), shown("estimates")]
    elif best := best_estimators(data):
        said = "; ".join(f"{who} at {scales}" for scales, who in best.items())
        first.append(text(f"Most accurate, within Monte-Carlo error: {said}.", "verdict"))
    sections = [Section(f"scenario-{number}", label, [*first, drawn("overview")])]
    if not of_one:
        sections += [
            section("Errors", [drawn("error"), shown("error")]),
            section("Efficiency", [drawn("efficiency"), more("efficiency")]),
            section("Coverage", [drawn("coverage"), more("coverage", "levels")]),
        ]
    lost = "A logarithmic axis cannot show the noise scale 0: it is in the tables only." if has_zero and figures else ""
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


def draw(scenario: ScenarioData, *, several: bool = False) -> dict[str, Figure]:
    """The figures whose data are present. `several`: their names end with the scenario's number."""
    of_one = study_of_one_flight.is_of_one(scenario.data)
    kinds = {"intervals": study_of_one_flight.intervals} if of_one else SCENARIO_FIGURES
    found = {name: make(scenario.data) for name, make in kinds.items()}
    suffix = f"-{scenario.number}" if several else ""
    return {name: figure._replace(stem=f"{name}{suffix}") for name, figure in found.items() if figure is not None}


def errors(data: xr.Dataset) -> Figure | None:
    """RMS error of each parameter and estimator against the noise scale, with the Cramer-Rao bounds."""
    data = positive_scales(data)
    found, best, x, panels = metrics.estimator_error(data), metrics.bound_error(data), data["scale"].values, []
    if not found["absolute"].notnull().any():
        return None
    seen_by, dots = bounds(data), {"marker": "" if len(x) > 1 else "s", "size": 4}
    for place, name in enumerate(names(data, "parameter")):
        kind, unit, why = error_unit(data, place)
        values, least = (_by(each[kind].isel(parameter=place), "estimator", "scale") for each in (found, best))
        marks = [_line(data, i, look, x, values[i]) for i, look in _looks(data)]
        marks += [
            Line(x, least[estimator], width=1.5, dash=dash, name=f"bound, {seen}", **dots)
            for dash, (seen, estimator) in zip(BOUND_DASHES, seen_by.items(), strict=False)
        ]
        title, subtitle = f"{name} [{unit}]", f"absolute: {why}" if why else ""
        panels.append(Panel(title, marks, _scales(x), Scale("log"), 270, 220, subtitle))
    return Figure("error", panels, columns=4)


def efficiency(data: xr.Dataset) -> Figure | None:
    """RMSE / bound of each parameter and estimator against the noise scale, with Monte-Carlo intervals."""
    data = positive_scales(data)
    found, scales, panels = metrics.efficiency(data), data["scale"].values, []
    if not found["efficiency"].notnull().any():
        return None
    values, low, high = (_by(found[each], "parameter", "estimator", "scale") for each in ("efficiency", "low", "high"))
    for place, name in enumerate(names(data, "parameter")):
        marks = [Line(_EVERYWHERE, (1, 1), width=1.5)]
        for i, look in _looks(data):
            x, at = dodged(scales, i, data.sizes["estimator"]), (place, i)
            marks += [_line(data, i, look, x, values[at])]
            marks += [spread(x, low[at], high[at], color=look.color, width=1.3, group=i)]
        panels.append(Panel(name, marks, _scales(scales), Scale("log"), 270, 220))
    ends = [end for panel in panels for end in panel.fitted().y.ends or ()]
    panels = [panel._replace(y=Scale("log", (min(ends), max(ends)))) for panel in panels]
    return Figure("efficiency", panels, columns=4)


def _by(values: xr.DataArray, *axes: str) -> np.ndarray:
    return values.transpose(*axes).values


def coverage(data: xr.Dataset) -> Figure | None:
    """Share of intervals that contain the truth against the level that they claim, at each noise scale."""
    found, panels = metrics.mean_coverage(data), []
    if not found["coverage"].notnull().any():
        return None
    estimators, levels = names(data, "estimator"), data["level"].values
    share, low, high = (_by(found[each], "scale", "estimator", "level") for each in ("coverage", "low", "high"))
    lowest, places = min(float(np.nanmin(low)), float(levels.min())) - 0.04, np.arange(len(levels))
    y = Scale(ends=(lowest, 1.02), ticks={x / 10: f"{10 * x} %" for x in range(11)})
    ticks: dict[float, str] = {k: f"{100 * x:g} %" for k, x in enumerate(levels.tolist())}
    x = Scale("linear", (-0.6, len(levels) - 0.4), ticks, "level claimed", lines=False)
    for place, scale in enumerate(data["scale"].values):
        marks = [across(levels, places - 0.45, places + 0.45, width=1.8)]
        for i, look in _looks(data):
            x_of, at = places + 0.7 * (i / max(len(estimators) - 1, 1) - 0.5), (place, i)
            marks += [spread(x_of, low[at], high[at], color=look.color, width=1.3, group=i)]
            marks += [Line(x_of, share[at], look.color, 0, marker=look.marker, size=6, group=i, name=estimators[i])]
        panels.append(Panel(f"noise scale {scale:g}", marks, x, y, 270, 240))
    return Figure("coverage", panels, columns=4)


def overview(data: xr.Dataset) -> Figure | None:
    """RMSE / least bound, the mean of all parameters: left against the noise scale, right against the rollouts."""
    data = positive_scales(data)
    found, scales = metrics.accuracy_interval(data), data["scale"].values
    rollouts = metrics.mean_rollouts(data).transpose("scale", "estimator").values
    values, low, high = (found[name].values for name in ("accuracy", "low", "high"))
    known = np.isfinite(values) & np.isfinite(rollouts)
    if not known.any():
        return None
    none = 0.5  # the place on the logarithmic axis for an estimator without rollouts
    spent, count = np.maximum(rollouts, none), data.sizes["estimator"]
    by_noise = [Line(_EVERYWHERE, (1, 1), width=1.5)]
    by_rollouts = list(by_noise)
    for i, look in _looks(data):
        at, name = np.flatnonzero(known[:, i]), names(data, "estimator")[i]
        x, y = dodged(scales, i, count)[at], values[at, i]
        line = _line(data, i, look, x, y)._replace(marker="", name="")
        by_noise += [line, spread(x, low[at, i], high[at, i], color=look.color, width=1.3, group=i)]
        by_rollouts += [line._replace(x=spent[at, i])]
        for size, (place, a) in enumerate(zip(at.tolist(), x, strict=True)):
            tip = f"{name}, noise x {scales[place]:g}: {plain(values[place, i])} ({plain(low[place, i])} to "
            tip += f"{plain(high[place, i])}), {plain(rollouts[place, i])} rollouts"
            mark = Line([a], [values[place, i]], look.color, 0, marker=look.marker, name=name, group=i, tip=tip)
            by_noise += [mark]
            by_rollouts += [mark._replace(x=[spent[place, i]], size=6.0 + 2 * size)]
    y = Scale("log", (min(0.9, 0.9 * float(np.nanmin(low[known]))), 1.15 * float(np.nanmax(high[known]))))
    powers = 10.0 ** np.arange(np.ceil(np.log10(max(spent[known].max(), 10.0))) + 1)
    ticks = {none: "none"} if (rollouts[known] <= 0).any() else {}
    ticks |= {power: f"{power:,.0f}" for power in powers.tolist()}
    x = Scale("log", (min(ticks) / 1.5, max(ticks) * 1.2), ticks, "rollouts for one flight; larger marks: more noise")
    panels = [
        Panel("RMSE / least bound, by noise", by_noise, _scales(scales), y, 430, 300),
        Panel("RMSE / least bound, by rollouts", by_rollouts, x, y, 430, 300),
    ]
    return Figure("overview", panels, columns=2)


def dodged(scales: np.ndarray, place: int, count: int) -> np.ndarray:
    """The noise scales for estimator `place` of `count`, spread over 0.3 of the gap between two, so that marks show."""
    gap = np.diff(np.log(np.sort(scales))).min() if len(scales) > 1 else np.log(3.0)
    return scales * np.exp(0.3 * gap * (place / max(count - 1, 1) - 0.5))


def _scales(scales: np.ndarray) -> Scale:
    """The axis of the noise, with a tick at each scale."""
    ends = float(scales.min()) / 1.8, float(scales.max()) * 1.8
    return Scale("log", ends, {scale: f"{scale:g}" for scale in scales.tolist()}, "noise scale")


def _line(data: xr.Dataset, place: int, look: Style, x: np.ndarray, y: np.ndarray) -> Line:
    """The line of an estimator: a later one lies on an earlier one, and is narrower."""
    width = _WIDEST - (_WIDEST - _NARROWEST) * place / max(data.sizes["estimator"] - 1, 1)
    name = names(data, "estimator")[place]
    return Line(x, y, look.color, width, look.dash, look.marker, 3.5 + 1.8 * width, name=name, group=place)


def _looks(data: xr.Dataset) -> Iterator[tuple[int, Style]]:
    """The index and the style of each estimator."""
    return enumerate(styles(names(data, "estimator")).values())


SCENARIO_FIGURES: dict[str, Callable[..., Figure | None]] = {
    "overview": overview,
    "error": errors,
    "efficiency": efficiency,
    "coverage": coverage,
}
"""The figures of each scenario. Each is `None` if its data are absent."""
