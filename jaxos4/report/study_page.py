"""The report of a study: the figures of its scenarios, and one HTML page that needs no other file."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from .._files import check_writable, write_file
from ..study import metrics
from . import one_flight, study_tables
from .html import Drawing, draw as draw_panels, render, swatch
from .study_tables import best_estimators, bounds, error_unit, names, positive_scales, scenarios
from .style import BOUND_DASHES, INK, Style, drawing, estimator_gid, grid, label, legend, log_axis, scale_axis, styles
from .text import plain

MOST_DRAWN = 12
"""At most this many scenarios have figures. All scenarios have tables."""

# Attributes of the Dataset, and their labels on the page.
_PROVENANCE = {"version": "jaxos4", "jax": "jax", "precision": "precision", "device": "device", "seed": "seed"}
_COLUMNS, _SPECIFICATION = 4, "specification.toml"
_AGAIN = f"jaxos4 study {_SPECIFICATION} --out .  # in the folder of this page"
_WIDEST, _NARROWEST = 3.0, 1.0  # line widths [pt] of the first and the last estimator, so that none hides another


def write_report(dataset: xr.Dataset, directory: Path) -> list[Path]:
    """Draws all figures, then writes `report.html` and `figures/*.svg`; returns their paths, the page first.

    The specification is written too, as `specification.toml`: the page's command names it.
    """
    target, folder = directory / "report.html", directory / "figures"
    check_writable(target)
    every, drawings, sections = list(scenarios(dataset)), [], []
    of_one = one_flight.is_of_one(dataset)
    figures = {"intervals": one_flight.intervals} if of_one else SCENARIO_FIGURES
    for number, title, data in every:
        shown = figures if number <= MOST_DRAWN else {}
        drawings.append(draw(shown, data, f"-{number}" if len(every) > 1 else ""))
        found = {"number": number, "label": title, "figures": drawings[-1], "best": best_estimators(data)}
        found["channels"] = study_tables.channels_by_estimator(data)
        found |= {"tables": study_tables.scenario_tables(data), "trouble": study_tables.troubled_flights(data)}
        if of_one:
            found |= {"outcomes": one_flight.outcomes(data), "best": {}}
            found["tables"]["estimates"] = one_flight.estimates(data)
        sections.append(found)
    estimators, attributes = names(dataset, "estimator"), {name: str(x) for name, x in dataset.attrs.items()}
    specification = attributes.get("specification", "")
    missing, cells = study_tables.cells_not_run(dataset)
    page = render(
        "study.html.j2",
        title=attributes.get("title", "") or "A study",
        command=_AGAIN if specification else "",
        specification=specification,
        provenance=[(shown, attributes[name]) for name, shown in _PROVENANCE.items() if name in attributes],
        estimators=estimators,
        bounds=list(bounds(dataset))[: len(BOUND_DASHES)],
        swatches=[swatch(look) for look in styles(estimators).values()],
        sections=sections,
        of_one=of_one,
        level=f"{100 * study_tables.shown_level(dataset):g} %",
        failed=study_tables.failed_cells(dataset),
        missing=missing,
        cells=cells,
        drawn=min(len(drawings), MOST_DRAWN),
        zero_scale=bool((dataset["scale"] == 0).any()),
    )
    files = {folder / f"{each.stem}.svg": each.svg for figures in drawings for each in figures.values()}
    folder.mkdir(exist_ok=True)
    if specification:
        write_file(directory / _SPECIFICATION, specification)
    for path, content in files.items():
        write_file(path, content)
    write_file(target, page)
    return [target, *files]


def draw(figures: Mapping[str, Callable[..., Figure | None]], data: xr.Dataset, suffix: str = "") -> dict[str, Drawing]:
    """The figures whose data are present. `suffix`: the end of the names of the files."""
    made = {}
    for name, draw_figure in figures.items():
        with drawing():
            if (figure := draw_figure(data)) is not None:
                made[name] = draw_panels(figure, f"{name}{suffix}")
    return made


def errors(data: xr.Dataset) -> Figure | None:
    """RMS error of each parameter and estimator against the noise scale, with the Cramer-Rao bounds."""
    data = positive_scales(data)
    found, best, seen = metrics.estimator_error(data), metrics.bound_error(data), bounds(data)
    units = [error_unit(data, place) for place in range(data.sizes["parameter"])]
    values = [found[kind].isel(parameter=place) for place, (kind, _, _) in enumerate(units)]
    figure, x = _against_noise(data, values, "RMS error", bounds=list(seen)), data["scale"].values
    if figure is None:
        return None
    for place, (panel, (kind, unit, why)) in enumerate(zip(figure.axes, units, strict=True)):
        for dash, estimator in zip(BOUND_DASHES, seen.values(), strict=False):
            y = best[kind].isel(parameter=place, estimator=estimator).values
            marker = "_" if len(x) == 1 else None
            panel.plot(x, y, color=INK, linestyle=dash, linewidth=1.1, marker=marker, zorder=1.9)
        log_axis(panel, "y")
        panel.set_title(f"{names(data, 'parameter')[place]} [{unit}]")
        if why:
            low, high = panel.get_ylim()
            panel.set_ylim(low, high * (high / low) ** 0.22)
            panel.text(0.03, 0.98, f"absolute: {why}", transform=panel.transAxes, va="top", fontsize=7)
    return figure


def efficiency(data: xr.Dataset) -> Figure | None:
    """RMSE / bound of each parameter and estimator against the noise scale, with Monte-Carlo intervals."""
    data = positive_scales(data)
    found = metrics.efficiency(data)
    values = [found["efficiency"].isel(parameter=place) for place in range(data.sizes["parameter"])]
    figure = _against_noise(data, values, "RMSE / bound", interval=found)
    if figure is None:
        return None
    for panel in figure.axes:
        panel.axhline(1, color=INK, linewidth=1.1, zorder=1.9)
    lows, highs = zip(*(panel.get_ylim() for panel in figure.axes), strict=True)
    for panel in figure.axes:
        panel.set_ylim(min(lows), max(highs))
        log_axis(panel, "y")
    return figure


def _against_noise(
    data: xr.Dataset,
    values: list[xr.DataArray],
    quantity: str,
    *,
    interval: xr.Dataset | None = None,
    bounds: Sequence[str] = (),
) -> Figure | None:
    """A panel for each parameter: its `values` for each estimator against the noise scale, with intervals if any."""
    if not any(one.notnull().any() for one in values):
        return None
    figure, axes = grid(len(values), columns=_COLUMNS, height=2.2)
    scales = data["scale"].values
    for parameter, (panel, name) in enumerate(zip(axes, names(data, "parameter"), strict=True)):
        for place, look in _looks(data):
            x = scales if interval is None else dodged(scales, place, data.sizes["estimator"])
            wide = _width(data, place)
            y, gid = values[parameter].isel(estimator=place).values, estimator_gid(place)
            panel.plot(x, y, gid=gid, linewidth=wide, markersize=2.5 + 1.8 * wide, **look.line)
            if interval is not None:
                one = interval.isel(parameter=parameter, estimator=place)
                ends = one["low"].values, one["high"].values
                panel.vlines(x, *ends, color=look.color, linewidth=1.0, gid=estimator_gid(place))
        if not np.isfinite(values[parameter].values).any():
            panel.text(0.5, 0.5, "no estimates", transform=panel.transAxes, ha="center")
        scale_axis(panel, scales)
        panel.set_yscale("log")
        panel.set_title(name)
    label(figure, x="noise scale", y=quantity)
    legend(figure, names(data, "estimator"), bounds=bounds)
    return figure


def coverage(data: xr.Dataset) -> Figure | None:
    """Share of intervals that contain the truth against the level that they claim, at each noise scale."""
    found = metrics.mean_coverage(data)
    if not found["coverage"].notnull().any():
        return None
    estimators, levels, count = names(data, "estimator"), data["level"].values, data.sizes["scale"]
    figure, axes = grid(count, columns=_COLUMNS, width=2.25 * min(count, _COLUMNS) + 1.2, height=2.8)
    lowest = min(float(found["low"].min()), float(levels.min())) - 0.04
    for place, panel in enumerate(axes):
        one = found.isel(scale=place)
        for x, level in enumerate(levels):
            panel.hlines(level, x - 0.45, x + 0.45, color=INK, linewidth=1.4)
        for row, look in _looks(data):
            shift = 0.7 * (row / max(len(estimators) - 1, 1) - 0.5)
            at, part, gid = np.arange(len(levels)) + shift, one.isel(estimator=row), estimator_gid(row)
            panel.vlines(at, part["low"].values, part["high"].values, color=look.color, linewidth=1.0, gid=gid)
            shares = part["coverage"].values
            panel.plot(at, shares, color=look.color, marker=look.marker, linestyle="none", markersize=4, gid=gid)
        panel.set_title(f"noise scale {data['scale'].values[place]:g}")
        panel.set_xticks(range(len(levels)), [f"{100 * level:g} %" for level in levels])
        panel.set_ylim(lowest, 1.02)
        panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:g} %"))
        panel.grid(axis="x", visible=False)
    label(figure, x="level claimed", y="intervals that contain the truth")
    legend(figure, estimators)
    return figure


def overview(data: xr.Dataset) -> Figure | None:
    """RMSE / least bound, the mean of all parameters: left against the noise scale, right against the rollouts."""
    data = positive_scales(data)
    found = metrics.accuracy_interval(data)
    rollouts = metrics.mean_rollouts(data).transpose("scale", "estimator").values
    values, low, high = (found[name].values for name in ("accuracy", "low", "high"))
    known = np.isfinite(values) & np.isfinite(rollouts)
    if not known.any():
        return None
    figure, (by_noise, by_rollouts) = grid(2, columns=2, height=3.6)
    none = 0.5  # the place on the logarithmic axis for an estimator without rollouts
    spent = np.maximum(rollouts, none)
    for row, look in _looks(data):
        at, line = known[:, row], {"color": look.color, "linestyle": look.dash, "gid": estimator_gid(row)}
        line["linewidth"] = _width(data, row)
        x, y, across = dodged(data["scale"].values, row, data.sizes["estimator"])[at], values[at, row], spent[at, row]
        by_noise.plot(x, y, **line)
        by_noise.vlines(x, low[at, row], high[at, row], color=look.color, linewidth=1.0, gid=estimator_gid(row))
        by_rollouts.plot(across, y, **{**line, "zorder": 1.5})
        for size, (place, a, b, c) in enumerate(zip(np.flatnonzero(at), x, across, y, strict=True)):
            tip = f"noise x {data['scale'].values[place]:g}: {plain(c)} ({plain(low[place, row])} to "
            tip += f"{plain(high[place, row])}), {plain(rollouts[place, row])} rollouts"
            marks: dict[str, Any] = {"color": look.color, "marker": look.marker, "linewidths": 0}
            marks["gid"] = estimator_gid(row, f"{names(data, 'estimator')[row]}, {tip}")
            by_noise.scatter(a, c, s=30, **marks)
            by_rollouts.scatter(b, c, s=26 + 30 * size, alpha=0.8, **marks)
    for panel in (by_noise, by_rollouts):
        panel.axhline(1, color=INK, linewidth=1.1, zorder=1.4)
        panel.set_ylim(min(0.9, 0.9 * np.nanmin(low[known])), 1.15 * np.nanmax(high[known]))
        log_axis(panel, "y")
    by_noise.set_title("RMSE / least bound, by noise")
    scale_axis(by_noise, data["scale"].values)
    by_noise.set_xlabel("noise scale")
    by_rollouts.set_title("RMSE / least bound, by rollouts")
    by_rollouts.set_xscale("log")
    powers = 10.0 ** np.arange(np.ceil(np.log10(max(spent[known].max(), 10.0))) + 1)
    ticks = {none: "none"} if (rollouts[known] <= 0).any() else {}
    ticks |= {power: f"{power:,.0f}" for power in powers}
    by_rollouts.set_xticks(list(ticks), list(ticks.values()))
    by_rollouts.xaxis.set_minor_locator(NullLocator())
    by_rollouts.set_xlim(min(ticks) / 1.5, max(ticks) * 1.2)
    by_rollouts.set_xlabel("rollouts for one flight; larger marks: more noise")
    legend(figure, names(data, "estimator"))
    return figure


def dodged(scales: np.ndarray, place: int, count: int) -> np.ndarray:
    """The noise scales for estimator `place` of `count`, spread over 0.3 of the gap between two, so that marks show."""
    gap = np.diff(np.log(np.sort(scales))).min() if len(scales) > 1 else np.log(3.0)
    return scales * np.exp(0.3 * gap * (place / max(count - 1, 1) - 0.5))


def _width(data: xr.Dataset, place: int) -> float:
    """The width of the line of an estimator [pt]: a later one lies on an earlier one, and is narrower."""
    return _WIDEST - (_WIDEST - _NARROWEST) * place / max(data.sizes["estimator"] - 1, 1)


def _looks(data: xr.Dataset) -> Iterator[tuple[int, Style]]:
    """The index and the style of each estimator."""
    return enumerate(styles(names(data, "estimator")).values())


SCENARIO_FIGURES: dict[str, Callable[..., Figure | None]] = {
    "overview": overview,
    "error": errors,
    "efficiency": efficiency,
    "coverage": coverage,
}
"""The figures of each scenario. Each is `None` if its data are absent. `study.html.j2` has titles and captions."""
