"""The page of an identified vehicle, which needs no other file, and its figures: `jaxos4 estimate --report`."""

import json
import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from .._files import check_writable, write_atomically
from ..analysis.frequency_response import AxisResponse, FrequencyResponse
from ..analysis.prediction import Predictions
from ..identification.results import Identification, SampleTime
from ..results import NINETY_FIVE
from .html import inline, render
from .style import BOUND_DASHES, FAINT, INK, Style, drawing, grid, styles, svg, ticks_at
from .text import MISSING, plain

BAND = 0.95
"""The share of the errors that the band of the predictions holds."""

# The horizon that the page shows first [s], and the digits of its estimates.
_SHOWN, _DIGITS = 0.25, 4
# The page shows these entries of the provenance in a place of their own.
_ELSEWHERE = ("command", "notes")
# Width of the figure of predictions by the time that it shows [inch/s], and its limits [inch].
_INCHES_A_SECOND, _NARROWEST, _WIDEST = 0.25, 9.0, 30.0
# The frequencies [Hz] and gains that the figure of the response shows, at most, and their ticks.
_HIGHEST, _GAINS = 40.0, (0.2, 5.0)
_FREQUENCY_TICKS, _GAIN_TICKS = (1, 2, 5, 10, 20, 40), (0.2, 0.5, 1, 2, 5)


def write_flight_page(path: str | os.PathLike[str], found: Identification, *, title: str) -> None:
    """Writes the page of an identified vehicle, completely or not at all. Raises `OSError` if it cannot be written."""
    check_writable(path)
    look = styles([found.estimator])[found.estimator]
    predicted, used = found.predictions, found.provenance
    rates, response, inertias, chosen = {}, {}, {}, 0
    with drawing():
        if predicted is not None:
            chosen = int(np.argmin(np.abs(predicted.horizons - _SHOWN)))
            for i, horizon in enumerate(predicted.horizons):
                rates[f"{horizon:.3g} s ahead"] = svg(predicted_rates(predicted, used.sample_time, i, look))
        if found.response is not None:
            response[""] = svg(frequency_responses(found.response, look))
        if found.sample_times:
            inertias[""] = svg(inertias_by_sample_time(found.sample_times, used.sample_time, look))
    text = render(
        "identification.html.j2",
        filters={"number": _number, "interval": _interval, "share": _share, "plain": plain, "inline": inline},
        title=title,
        found=found,
        ninety_five=NINETY_FIVE,
        predictions=rates,
        chosen=chosen,
        band=f"{100 * BAND:g}",
        responses=response,
        sample_times=inertias,
        command=used.command or "",
        notes=[*used.notes, *filter(None, [found.motor_clock])],
        provenance=[(name.replace("_", " "), _text(x)) for name, x in used.to_dict().items() if name not in _ELSEWHERE],
    )
    with write_atomically(path) as beside:
        beside.write_text(text, encoding="utf-8")


def _number(value: float | None, digits: int = _DIGITS) -> str:
    return MISSING if value is None else plain(value, digits)


def _interval(ends: tuple[float, float] | None) -> str:
    return "" if ends is None else f"{_number(ends[0])} to {_number(ends[1])}"


def _share(value: float | None) -> str:
    return MISSING if value is None else f"{value:.2f}"


def _text(x: Any) -> str:
    if isinstance(x, str):
        return x
    return MISSING if x is None else json.dumps(x, ensure_ascii=False)


def predicted_rates(predicted: Predictions, sample_time: float, horizon: int, look: Style) -> Figure:
    """Measured and predicted p, q, r against the time that is predicted, with a band that holds 95 % of the errors.

    **Arguments:**

    - `sample_time`: of the flight [s].
    - `horizon`: index into `predicted.horizons`.
    """
    time = predicted.start * sample_time + predicted.horizons[horizon]
    # Lines break between stretches.
    usual = np.median(np.diff(predicted.start)) if predicted.start.size > 1 else 1
    breaks = np.flatnonzero(np.diff(predicted.start) > 1.5 * usual) + 1
    width = float(np.clip(_INCHES_A_SECOND * np.ptp(time), _NARROWEST, _WIDEST))
    figure, panels = grid(3, columns=1, width=width, height=1.9)
    for rate, (panel, name) in enumerate(zip(panels, "pqr", strict=True)):
        y, measured = predicted.predicted[:, horizon, rate], predicted.measured[:, horizon, rate]
        errors = np.abs(y - measured)
        errors = errors[np.isfinite(errors)]
        half = float(np.quantile(errors, BAND)) if errors.size else math.nan
        x, y, measured = (np.insert(values.astype(float), breaks, np.nan) for values in (time, y, measured))
        band = panel.fill_between(x, y - half, y + half, color=look.color, alpha=0.22, linewidth=0)
        (line,) = panel.plot(x, y, color=look.color)
        (dots,) = panel.plot(x, measured, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[1])
        panel.set_title(f"{name} [rad/s]")
        panel.margins(x=0.01)
        panel.tick_params(labelbottom=rate == 2)
        if rate == 2:
            panel.set_xlabel("time [s]")
            labels = ("measured", f"predicted {predicted.horizons[horizon]:.3g} s ahead", f"{100 * BAND:g} % of errors")
            figure.legend([dots, line, band], labels, loc="outside lower left", ncols=3)
    return figure


def frequency_responses(found: FrequencyResponse, look: Style) -> Figure:
    """Gain, phase and coherence of roll, pitch and yaw, with 95 % bands, and the model as a line.

    The title of an axis says by how much the measured response exceeds the model's from 4 to 20 Hz. A frequency without
    a clear response is drawn faintly.
    """
    figure, panels = grid(9, columns=3, width=9.0, height=1.75)
    top = min(_HIGHEST, max(float(axis.frequency[-1]) if axis.frequency.size else 1.0 for axis in found))
    shown: list[Artist] = []
    for column, (name, axis) in enumerate(zip(found._fields, found, strict=True)):
        gain, phase, coherence = panels[column::3]
        drawn = _response(gain, axis, axis.gain, axis.gain * np.exp([-axis.half_width, axis.half_width]), look)
        degrees, spread = np.degrees(axis.phase), np.degrees(np.minimum(axis.half_width, math.pi))
        _response(phase, axis, degrees, degrees + np.array([-spread, spread]), look)
        coherence.plot(axis.frequency, axis.coherence, color=look.color)
        model = gain.axhline(1.0, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[2])
        phase.axhline(0.0, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[2])
        coherence.axhline(0.6, color=FAINT, linewidth=0.9, linestyle=BOUND_DASHES[1])
        shown = [*drawn, model]
        gain.set_title(f"{name}: {_agreement(axis)}")
        gain.set_yscale("log")
        gain.set_ylim(_GAINS)
        ticks_at(gain.yaxis, _GAIN_TICKS)
        phase.set_ylim(-180, 180)
        phase.yaxis.set_major_locator(MultipleLocator(90))
        coherence.set_ylim(0, 1.03)
        coherence.set_xlabel("frequency [Hz]")
        for panel in (gain, phase, coherence):
            panel.set_xscale("log")
            panel.set_xlim(1.0, top)
            ticks_at(panel.xaxis, _FREQUENCY_TICKS)
            panel.tick_params(labelbottom=panel is coherence, labelleft=column == 0)
    for panel, label in zip(panels[::3], ("gain", "phase [degrees]", "coherence"), strict=True):
        panel.set_ylabel(label)
    labels = ("measured over modelled", "95 %", "coherence below 0.6", "the model")
    figure.legend(shown, labels, loc="outside lower left", ncols=4)
    return figure


def inertias_by_sample_time(answers: Sequence[SampleTime], chosen: float, look: Style) -> Figure:
    """Ix, Iy and Iz at each sample time, relative to those of the chosen one, with 95 % intervals.

    **Arguments:** `chosen`: the sample time of the estimate [s].
    """
    own = next((each.constants for each in answers if math.isclose(each.sample_time, chosen)), {})
    figure, panels = grid(3, columns=3, width=9.0, height=2.4)
    ticks = [1e3 * each.sample_time for each in answers]
    shown: list[Any] = []
    for panel, name in zip(panels, ("Ix", "Iy", "Iz"), strict=True):
        rows = [(1e3 * each.sample_time, each.constants[name]) for each in answers if name in each.constants]
        scale = own[name].estimate if name in own else math.nan
        times = [time for time, _ in rows]
        values, errors = ([getattr(row, field) / scale for _, row in rows] for field in ("estimate", "std"))
        errors = [NINETY_FIVE * error for error in errors]
        line = panel.errorbar(times, values, yerr=errors, color=look.color, marker="o", markersize=4, capsize=3)
        mark = panel.axvline(1e3 * chosen, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[1])
        level = panel.axhline(1.0, color=FAINT, linewidth=0.9, linestyle=BOUND_DASHES[2])
        shown = [line, mark, level]
        panel.set_title(f"{name} / chosen" if rows and name in own else f"{name}: not identified")
        panel.set_xscale("log")
        panel.set_xlim(0.8 * ticks[0], 1.25 * ticks[-1])
        ticks_at(panel.xaxis, ticks)
        panel.set_xlabel("sample time [ms]")
    labels = ("moment of inertia, 95 %", "chosen sample time", "chosen moment of inertia")
    figure.legend(shown, labels, loc="outside lower left", ncols=3)
    return figure


def _response(panel: Axes, axis: AxisResponse, values: np.ndarray, band: np.ndarray, look: Style) -> list[Artist]:
    """A line with its band: strong for a clear response, else faint."""
    (faint,) = panel.plot(axis.frequency, values, color=FAINT, linewidth=0.8)
    shown = np.where(axis.clear, values, np.nan)
    low, high = np.where(axis.clear, band, np.nan)
    filled = panel.fill_between(axis.frequency, low, high, color=look.color, alpha=0.25, linewidth=0)
    (line,) = panel.plot(axis.frequency, shown, color=look.color)
    return [line, filled, faint]


def _agreement(axis: AxisResponse) -> str:
    agreement = axis.agreement()
    if math.isnan(agreement.ratio):
        return "no clear response"
    return "{:.2f} ({:.2f} to {:.2f}) times the model".format(agreement.ratio, *agreement.interval)
