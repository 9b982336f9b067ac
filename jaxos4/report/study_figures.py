"""The figures of a study's scenarios: each is `None` if its data are absent."""

from collections.abc import Callable, Iterator

import numpy as np
import xarray as xr

from ..study import metrics
from .panels import BOUND_DASHES, EVERYWHERE, Figure, Line, Panel, Scale, Style, across, spread, styles
from .study_tables import bounds, error_unit, names, positive_scales, scale_labels, shown_level
from .text import plain

_WIDEST, _NARROWEST = 4.0, 1.4  # line widths [px] of the first and the last estimator, so that none hides another


def intervals(data: xr.Dataset) -> Figure | None:
    """Estimate - truth of each parameter over the least bound of any estimator, with its interval; a panel a scale."""
    data = positive_scales(data).isel(flight=0)
    least = data["bound"].min("estimator")
    error = (data["estimate"] - data["truth"]) / least.where(least > 0)
    half = data["half_width"].sel(level=shown_level(data)) / least.where(least > 0)
    if not np.isfinite(error.values).any():
        return None
    estimators, parameters, panels = names(data, "estimator"), names(data, "parameter"), []
    places = np.arange(len(parameters))
    scale = Scale(ends=(len(parameters) - 0.4, -0.6), ticks=dict(enumerate(parameters)), lines=False)
    height = 90 + len(parameters) * (14 + 6 * len(estimators))
    for i, title in enumerate(scale_labels(data)):
        marks = [Line((0, 0), EVERYWHERE, width=1.5)]
        for j, (name, look) in enumerate(styles(estimators).items()):
            y = places + 0.6 * (j - (len(estimators) - 1) / 2) / len(estimators)
            x, reach = (each.isel(scale=i, estimator=j).values for each in (error, half))
            marks += [across(y, x - reach, x + reach, color=look.color, group=j)]
            marks += [Line(x, y, look.color, 0, marker=look.marker, size=6, group=j, name=name)]
        panels.append(Panel(title, marks, Scale(label="(estimate - truth) / bound"), scale, height=height))
    return Figure("intervals", panels)


def errors(data: xr.Dataset) -> Figure | None:
    """RMS error of each parameter and estimator against the noise scale, with the Cramer-Rao bounds."""
    data = positive_scales(data)
    errors_and_bounds = metrics.estimator_error(data), metrics.bound_error(data)
    found, best = (each.transpose("parameter", "estimator", "scale") for each in errors_and_bounds)
    x, panels = data["scale"].values, []
    if not found["absolute"].notnull().any():
        return None
    seen_by, dots = bounds(data), {"marker": "" if len(x) > 1 else "s", "size": 4}
    for place, name in enumerate(names(data, "parameter")):
        kind, unit, why = error_unit(data, place)
        values, least = (each[kind].values[place] for each in (found, best))
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
    found = metrics.efficiency(data).transpose("parameter", "estimator", "scale")
    if not found["efficiency"].notnull().any():
        return None
    scales, panels = data["scale"].values, []
    values, low, high = (found[each].values for each in ("efficiency", "low", "high"))
    for place, name in enumerate(names(data, "parameter")):
        marks = [Line(EVERYWHERE, (1, 1), width=1.5)]
        for i, look in _looks(data):
            x, at = dodged(scales, i, data.sizes["estimator"]), (place, i)
            marks += [_line(data, i, look, x, values[at])]
            marks += [spread(x, low[at], high[at], color=look.color, width=1.3, group=i)]
        panels.append(Panel(name, marks, _scales(scales), Scale("log"), 270, 220))
    ends = [end for panel in panels for end in panel.fitted().y.ends or ()]
    panels = [panel._replace(y=Scale("log", (min(ends), max(ends)))) for panel in panels]
    return Figure("efficiency", panels, columns=4)


def coverage(data: xr.Dataset) -> Figure | None:
    """Share of intervals that contain the truth against the level that they claim, at each noise scale."""
    found, panels = metrics.mean_coverage(data).transpose("scale", "estimator", "level"), []
    if not found["coverage"].notnull().any():
        return None
    estimators, levels = names(data, "estimator"), data["level"].values
    share, low, high = (found[each].values for each in ("coverage", "low", "high"))
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
    by_noise = [Line(EVERYWHERE, (1, 1), width=1.5)]
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


_BEST = "1 is the best that an unbiased estimator can do."
FIGURES: dict[str, tuple[Callable[[xr.Dataset], Figure | None], str, str]] = {
    "intervals": (
        intervals,
        "Estimates and their intervals",
        "Estimate - truth of each parameter, in multiples of the smallest Cramer-Rao bound of any estimator, with "
        "intervals. The line at 0 is the truth. From estimate, truth, half_width, bound.",
    ),
    "overview": (
        overview,
        "Which method, at which noise?",
        "RMSE / least bound of any estimator (geometric mean over the parameters), with the 95 % Monte-Carlo interval "
        f"of one parameter; left against noise, right against simulated flights. {_BEST} An estimator that looks at "
        "the body rates alone cannot reach 1 if others see more channels. From metrics.accuracy, mean_rollouts.",
    ),
    "error": (
        errors,
        "Error against noise",
        "Root-mean-square error over the converged flights, and the Cramer-Rao bounds of the channels used. From "
        "metrics.estimator_error, bound_error.",
    ),
    "efficiency": (
        efficiency,
        "Efficiency against noise",
        f"RMSE / bound, each estimator relative to its own bound, with 95 % Monte-Carlo intervals. {_BEST} From "
        "metrics.efficiency.",
    ),
    "coverage": (
        coverage,
        "Coverage by level",
        "Share of intervals that contain the truth, averaged over the parameters, with 95 % Monte-Carlo intervals. "
        "Long lines: the level that the intervals claim. From metrics.mean_coverage.",
    ),
}
"""Each figure with its title and its caption. A scenario of one flight has the first, others have the rest."""


def draw(data: xr.Dataset) -> dict[str, Figure]:
    """The figures of a scenario by name."""
    first, *others = FIGURES
    kinds = [first] if data.sizes["flight"] == 1 else others
    return {name: figure for name in kinds if (figure := FIGURES[name][0](data)) is not None}
