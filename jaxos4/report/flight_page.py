"""The report of one identified flight as one HTML page that needs nothing but itself: `jaxos4 estimate --report`."""

import json
import math
import os
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from .._files import check_writable, write_atomically
from ..analysis.prediction import Predictions
from ..results import NINETY_FIVE
from .charts import without_nan
from .numbers import MISSING, plain
from .page import environment, script_json
from .style import Style, styles

RATE_NAMES = ("p", "q", "r")
# The horizon that the chart shows first [s], the share of the errors that its bands hold, and of a panel [pixels].
_SHOWN, _BAND, _HEIGHT = 0.25, 0.95, 190
# Standard deviations to either side that hold 95 % of a Gaussian.
_DIGITS = 4
# What the page says elsewhere than in the list of provenance.
_APART = ("command", "notes")


class ParameterRow(NamedTuple):
    """A row of the table of parameters, as text."""

    name: str
    unit: str
    estimate: str
    interval: str
    bound: str
    note: str
    held: bool


def write_flight_page(
    path: str | os.PathLike[str], *, report: dict[str, Any], predicted: Predictions | None, title: str
) -> None:
    """Writes the page, whole or not at all.

    **Arguments:**

    - `report`: what `jaxos4 estimate` writes as JSON: `estimator`, `model`, `result`, `cost`, `rollouts`, `seconds`,
      `parameters`, `held`, `constants`, `skill`, `provenance`. What it lacks, the page omits; `None`: not identifiable.
      `skill` holds `horizons` [s], `starts`, and for p, q and r `skill`, `std`, `rmse`, `persistence` by horizon, and
      `equation_error` where its skill was computed; `provenance["command"]` is how to run it again, its `sample_time`
      gives the chart its seconds.
    - `predicted`: what the chart shows, of a flight that was not fitted; `None`: no chart.
    - `title`: of the page.

    **Raises:** `OSError` where it cannot be written.
    """
    check_writable(path)
    text = flight_page(report, predicted, title)
    with write_atomically(path) as beside:
        beside.write_text(text, encoding="utf-8")


def flight_page(report: dict[str, Any], predicted: Predictions | None, title: str) -> str:
    """The page; arguments as of `write_flight_page`."""
    provenance = report.get("provenance") or {}
    look = styles([str(report.get("estimator", ""))]).popitem()[1]
    chart = None if predicted is None else prediction_chart(predicted, provenance.get("sample_time"), look)
    return (
        environment()
        .get_template("flight.html.j2")
        .render(
            title=title,
            about=_about(report),
            parameters=_parameters(report),
            constants=_constants(report.get("constants") or {}),
            consistency=_number((report.get("constants") or {}).get("consistency_p"), 2),
            skill=_skill(report.get("skill") or {}),
            starts=(report.get("skill") or {}).get("starts"),
            equation_error=any("equation_error" in _rate(report, rate) for rate in RATE_NAMES),
            has_chart=chart is not None,
            band=f"{100 * _BAND:g}",
            command=provenance.get("command", ""),
            notes=provenance.get("notes") or [],
            provenance=[(name.replace("_", " "), _said(x)) for name, x in provenance.items() if name not in _APART],
            charts=script_json({} if chart is None else {"predictions": chart}),
            plotly=Markup("" if chart is None else get_plotlyjs().replace("</script", "<\\/script")),  # noqa: S704
        )
    )


def prediction_chart(predicted: Predictions, sample_time: float | None, look: Style) -> dict[str, Any]:
    """Measured against predicted p, q, r by the time that is predicted, a choice for each horizon.

    The band holds 95 % of the errors of this horizon and rate.
    """
    usual = int(np.median(np.diff(predicted.start))) if predicted.start.size > 1 else 1
    # A line ends where a stretch does.
    breaks = np.flatnonzero(np.diff(predicted.start) > 1.5 * usual) + 1
    unit = 1.0 if sample_time is None else float(sample_time)
    choices = []
    for at, horizon in enumerate(predicted.horizons):
        time = predicted.start * unit + (0.0 if sample_time is None else horizon)
        panels = []
        for rate, name in enumerate(RATE_NAMES):
            y, measured = predicted.predicted[:, at, rate], predicted.measured[:, at, rate]
            errors = np.abs(y - measured)
            band = np.quantile(errors[np.isfinite(errors)], _BAND) if np.isfinite(errors).any() else math.nan
            panels.append(
                {
                    "title": f"{name} [rad/s]",
                    "x": {"title": "time [s]" if sample_time is not None else "sample at the start"},
                    "y": {},
                    "traces": [
                        *_band(time, y, band, breaks, look),
                        _line("predicted", time, y, breaks, {"color": look.color, "width": 1.6}),
                        _line("measured", time, measured, breaks, {"color": "ink", "width": 1.1, "dash": "dot"}),
                    ],
                }
            )
        choices.append({"label": f"{horizon:.3g} s ahead", "panels": panels})
    chosen = int(np.argmin(np.abs(predicted.horizons - _SHOWN)))
    return without_nan({"choices": choices, "chosen": chosen, "height": _HEIGHT, "columns": 1, "entries": 3})


def _line(name: str, x: np.ndarray, y: np.ndarray, breaks: np.ndarray, line: dict[str, Any]) -> dict[str, Any]:
    return {
        "name": name,
        "x": np.insert(x.astype(float), breaks, np.nan),
        "y": np.insert(y.astype(float), breaks, np.nan),
        "mode": "lines",
        "line": line,
        "hovertemplate": "%{x:.2f}: %{y:.3g} rad/s",
    }


def _band(x: np.ndarray, y: np.ndarray, half: float, breaks: np.ndarray, look: Style) -> list[dict[str, Any]]:
    """A polygon for each run of predictions that is finite and in one stretch."""
    there = np.isfinite(y)
    traces = []
    for run in np.split(np.arange(y.size), np.union1d(breaks, np.flatnonzero(np.diff(there)) + 1)):
        if run.size < 2 or not there[run[0]] or not math.isfinite(half):
            continue
        traces.append(
            {
                "name": f"{100 * _BAND:g} % band",
                "x": np.concatenate([x[run], x[run][::-1]]),
                "y": np.concatenate([y[run] + half, y[run][::-1] - half]),
                "mode": "lines",
                "line": {"width": 0, "color": look.color},
                "fill": "toself",
                "fillcolor": look.color + "38",
                "hoverinfo": "skip",
            }
        )
    return traces


def _about(report: dict[str, Any]) -> str:
    """One line: what fitted what, and how it ended."""
    parts = [str(report["estimator"])] if report.get("estimator") else []
    parts += [f"{report['model']} model"] if report.get("model") else []
    ended = str(report.get("result") or "").replace("_", " ")
    parts += [ended] if ended else []
    if report.get("rollouts") is not None:
        parts.append(f"{int(report['rollouts'])} rollouts")
    if report.get("seconds") is not None:
        parts.append(f"{plain(float(report['seconds']))} s")
    if report.get("cost") is not None:
        parts.append(f"cost {plain(float(report['cost']))}")
    return ", ".join(parts)


def _parameters(report: dict[str, Any]) -> list[ParameterRow]:
    """Estimated ones, then those that were held, with the reason."""
    rows = []
    for name, row in (report.get("parameters") or {}).items():
        rows.append(
            ParameterRow(
                name,
                row.get("unit") or "",
                _number(row.get("estimate")),
                _interval(row.get("ci95")),
                _number(row.get("bound"), 2),
                row.get("note") or "",
                False,
            )
        )
    for name, row in (report.get("held") or {}).items():
        said = row.get("note") or "held"
        rows.append(ParameterRow(name, row.get("unit") or "", _number(row.get("value")), "", "", said, True))
    return rows


def _constants(constants: dict[str, Any]) -> list[ParameterRow]:
    rows = []
    for name, row in constants.items():
        if not isinstance(row, dict):
            continue
        value, std, interval = row.get("estimate"), row.get("std"), row.get("ci95")
        if interval is None and value is not None and std is not None:
            interval = [value - NINETY_FIVE * std, value + NINETY_FIVE * std]
        rows.append(
            ParameterRow(
                name, row.get("unit") or "", _number(value), _interval(interval), "", row.get("note") or "", False
            )
        )
    return rows


def _rate(report: dict[str, Any], rate: str) -> dict[str, Any]:
    return (report.get("skill") or {}).get(rate) or {}


def _skill(skill: dict[str, Any]) -> list[tuple[str, list[dict[str, str]]]]:
    """For each rate, a row for each horizon: all as text."""
    groups = []
    for rate in RATE_NAMES:
        of_rate, rows = skill.get(rate) or {}, []
        for i, horizon in enumerate(skill.get("horizons") or []):
            row = {name: _at(of_rate, name, i) for name in ("rmse", "persistence", "equation_error")}
            std = _at(of_rate, "std", i)
            error = "" if std == MISSING else f"± {std}"
            rows.append(row | {"horizon": plain(float(horizon)), "skill": _at(of_rate, "skill", i), "error": error})
        if of_rate and rows:
            groups.append((rate, rows))
    return groups


def _at(table: dict[str, Any], name: str, i: int) -> str:
    values = table.get(name) or []
    if i >= len(values) or values[i] is None:
        return MISSING
    # Skills and their errors are shares: two decimals are what they are worth.
    return plain(float(values[i])) if name in ("rmse", "persistence") else f"{float(values[i]):.2f}"


def _number(value: float | None, digits: int = _DIGITS) -> str:
    return MISSING if value is None else plain(float(value), digits)


def _interval(ends: list[float] | None) -> str:
    return "" if ends is None or any(end is None for end in ends) else f"{_number(ends[0])} to {_number(ends[1])}"


def _said(x: Any) -> str:
    if isinstance(x, str):
        return x
    return MISSING if x is None else json.dumps(x, ensure_ascii=False)
