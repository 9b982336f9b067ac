"""The interactive charts: the figures' numbers as traces of plotly, which the page's script puts into panels."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr

from ..results import NINETY_FIVE
from ..study import metrics
from .figures_noise import dodged, error_unit, positive_scales
from .figures_spread import error_quantiles, nearest_scale, price, rollout_ticks
from .scenario import bounds, names
from .style import Style, styles

_BOUND_DASHES = ("solid", "dot", "dash")
# Of one row of panels [pixels].
_HEIGHT = 210
# Of a logarithmic axis with more ticks than powers of ten: its largest value over its least.
_DENSE = 100.0
# And of one with ticks of its own, where these are many enough to fall on it: RMSE / bound near 1.
_NARROW = 5.0
_TICKS = [0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0]


def charts(data: xr.Dataset) -> Iterator[tuple[str, dict[str, Any]]]:
    """The charts of one scenario by the name of the figure that they stand for, ready for JSON.

    A chart has `choices`, of which one is shown at a time; a choice has a label and panels; a panel has a title, axes
    and traces; a trace says in `estimator` with whom it is hidden, and has the colour "ink" where it follows the theme.
    """
    for name, make in (
        ("error", _error),
        ("efficiency", _efficiency),
        ("distribution", _distribution),
        ("rollouts", _rollouts),
    ):
        chart = make(data)
        if chart is not None:
            yield name, without_nan(chart)


def _error(data: xr.Dataset) -> dict[str, Any] | None:
    data = positive_scales(data)
    found, best = metrics.estimator_error(data), metrics.bound_error(data)
    if not found["absolute"].notnull().any():
        return None
    panels = []
    for place, name in enumerate(names(data, "parameter")):
        kind, unit, why = error_unit(data, place)
        hover = f"%{{x}} x noise: %{{y:.3g}} {unit}"
        traces = [
            {
                "name": f"bound, {seen}",
                "x": data["scale"].values,
                "y": best[kind].isel(parameter=place, estimator=at).values,
                "mode": "lines+markers",
                "line": {"color": "ink", "dash": dash, "width": 1.5},
                "marker": {"color": "ink", "size": 3},
                "hovertemplate": hover,
            }
            for dash, (seen, at) in zip(_BOUND_DASHES, bounds(data).items(), strict=False)
        ]
        for at, (estimator, look) in enumerate(styles(names(data, "estimator")).items()):
            y = found[kind].isel(parameter=place, estimator=at).values
            traces.append(_line(estimator, at, look, data["scale"].values, y, hover))
        note = f"absolute: {why}" if why else ""
        title, axis = f"{name} [{unit}]", _log(found[kind].isel(parameter=place))
        panels.append({"title": title, "note": note, "x": _scale_axis(data), "y": axis, "traces": traces})
    return _chart(panels)


def _efficiency(data: xr.Dataset) -> dict[str, Any] | None:
    data = positive_scales(data)
    found = metrics.efficiency(data)
    if not found["efficiency"].notnull().any():
        return None
    style = styles(names(data, "estimator"))
    panels = []
    for place, name in enumerate(names(data, "parameter")):
        traces = []
        for at, (estimator, look) in enumerate(style.items()):
            value, low, high = (
                found[part].isel(parameter=place, estimator=at).values for part in ("efficiency", "low", "high")
            )
            x = dodged(data["scale"].values, at, len(style))
            trace = _line(estimator, at, look, x, value, "%{y:.3g} (%{customdata[0]:.3g} to %{customdata[1]:.3g})")
            trace["customdata"] = np.stack([low, high], axis=-1)
            trace["error_y"] = {
                "type": "data",
                "symmetric": False,
                "array": high - value,
                "arrayminus": value - low,
                "thickness": 1,
                "width": 2,
            }
            traces.append(trace)
        axis = _log(found["efficiency"]) | {"line_at": 1, "shared": True}
        panels.append({"title": name, "x": _scale_axis(data), "y": axis, "traces": traces})
    return _chart(panels)


def _distribution(data: xr.Dataset) -> dict[str, Any] | None:
    found = error_quantiles(data)
    if not found.notnull().any():
        return None
    style = styles(names(data, "estimator"))
    choices = []
    for scale in range(data.sizes["scale"]):
        panels = []
        for place, name in enumerate(names(data, "parameter")):
            traces = []
            for at, (estimator, look) in enumerate(style.items()):
                box = found.isel(scale=scale, parameter=place, estimator=at).values
                if not np.isfinite(box).all():
                    continue
                ends = dict(zip(("lowerfence", "q1", "median", "q3", "upperfence"), ([x] for x in box), strict=True))
                traces.append(
                    {
                        "type": "box",
                        "orientation": "h",
                        "name": estimator,
                        "estimator": at,
                        "y": [estimator],
                        "line": {"color": look.color, "width": 1.5},
                        "fillcolor": look.color + "55",
                        "hoverinfo": "x+name",
                    }
                    | ends
                )
            y = {"type": "category", "autorange": "reversed"}
            x = {"lines_at": [-NINETY_FIVE, 0, NINETY_FIVE], "title": "error / bound"}
            panels.append({"title": name, "x": x, "y": y, "traces": traces})
        choices.append({"label": f"noise x {data['scale'].values[scale]:g}", "panels": panels})
    return {"choices": choices, "chosen": nearest_scale(data), "height": _HEIGHT}


def _rollouts(data: xr.Dataset) -> dict[str, Any] | None:
    data = positive_scales(data)
    spent, reached = metrics.mean_rollouts(data), metrics.accuracy(data)
    if not (spent.notnull() & reached.notnull()).any():
        return None
    traces = []
    for at, (estimator, look) in enumerate(styles(names(data, "estimator")).items()):
        one = spent.isel(estimator=at).values
        hover = "noise x %{customdata[0]}: %{customdata[1]:.3g} rollouts, %{y:.3g}"
        trace = _line(estimator, at, look, price(np.nan_to_num(one)), reached.isel(estimator=at).values, hover)
        trace["customdata"] = np.stack([data["scale"].values, one], axis=-1)
        traces.append(trace)
    ticks = rollout_ticks(spent.values[spent.notnull().values])
    x = {"type": "log", "title": "rollouts for one flight", "ticks": list(ticks), "labels": list(ticks.values())}
    y = _log(reached) | {"line_at": 1, "title": "RMSE / least bound"}
    return _chart([{"title": "", "x": x, "y": y, "traces": traces}], height=360)


def _chart(panels: list[dict[str, Any]], height: int = _HEIGHT) -> dict[str, Any]:
    return {"choices": [{"label": "", "panels": panels}], "chosen": 0, "height": height}


def _line(estimator: str, place: int, look: Style, x: np.ndarray, y: np.ndarray, hover: str) -> dict[str, Any]:
    return {
        "name": estimator,
        "estimator": place,
        "x": x,
        "y": y,
        "mode": "lines+markers",
        "line": {"color": look.color, "dash": look.plotly_dash, "width": 1.8},
        "marker": {"color": look.color, "symbol": look.symbol, "size": 8},
        "hovertemplate": hover,
    }


def _scale_axis(data: xr.Dataset) -> dict[str, Any]:
    scales = data["scale"].values
    return {"type": "log", "title": "noise scale", "ticks": scales, "labels": [f"{scale:g}" for scale in scales]}


def _log(values: xr.DataArray) -> dict[str, Any]:
    """The axis of these values; `dense`: they span so little that powers of ten would not do."""
    some = values.values[values.values > 0]
    span = some.max() / some.min() if some.size else np.inf
    if span < _NARROW and some.min() > _TICKS[0] and some.max() < _TICKS[-1]:
        return {"type": "log", "ticks": _TICKS, "labels": [f"{tick:g}" for tick in _TICKS]}
    return {"type": "log", "dense": bool(span < _DENSE)}


def without_nan(x: Any) -> Any:
    """For JSON: lists and numbers, with null for what is not finite."""
    if isinstance(x, dict):
        return {key: without_nan(value) for key, value in x.items()}
    if isinstance(x, np.ndarray):
        return without_nan(x.tolist())
    if isinstance(x, list | tuple):
        return [without_nan(value) for value in x]
    if isinstance(x, float):
        return float(f"{x:.6g}") if math.isfinite(x) else None
    return x.item() if isinstance(x, np.generic) else x
