"""The signals of an identification on the time axis of its page."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..analysis.prediction import Predictions, decisive_horizon
from ..analysis.traces import Traces
from ..errors import printable
from ..flight import STATE_NAMES, STATE_UNITS
from ..identification.results import Identification, VehicleIdentification
from ..models.state import CASCADE_ORDER
from .panels import BOUND_DASHES, Style, style
from .timeline import TimeAxis, line, panel, signals, spans, view

BAND = 0.95
"""The share of the errors that the band of the predictions holds."""
# Channels of an OS4 that are shown together, in cascade order.
_GROUPS = {"rates": (0, 1, 2), "attitude": (3, 4, 5), "position": (6, 8, 10), "velocity": (7, 9, 11)}


def identified_signals(found: Identification, look: Style) -> str:
    """The signals of a result's page, as JSON; empty if the result has none.

    A vehicle has a view for each horizon of its predictions, and one of trajectories. An OS4 has one for each group of
    channels.
    """
    traces, ahead, paths, look = found.traces, None, None, look._replace(dash=BOUND_DASHES[0])
    if isinstance(found, VehicleIdentification):
        ahead, paths = found.predictions, found.trajectories
    if traces is None:
        return ""
    validate, shown, shaded, before = found.provenance.validate or "", 0, [], None
    axis = _axis(traces, ahead)
    time, known = axis.place(traces.time, traces.log), np.asarray(np.isfinite(traces.measured).any(axis=1))
    if traces.predicted.shape[1]:
        views = [
            view(name, time, _panels(traces.measured, traces.predicted, look, group))
            for name, group in _GROUPS.items()
            if group[0] < traces.predicted.shape[1]
        ]
    elif ahead is not None:
        views = [_horizon(traces, ahead, i, axis, look) for i in range(ahead.horizons.size)]
        if paths is not None:
            views.append(_trajectories(traces, ahead, paths, axis, look))
        shown = decisive_horizon(ahead.horizons, np.isfinite(ahead.measured).any(axis=(0, 2)))
        shaded = spans(time, known)
        # Of the samples that were held out, the first is kept, as missing: the line breaks there.
        kept = known | np.diff(known, prepend=False)
        before = view("", time[kept], _panels(traces.measured[kept], None, look))
    else:
        views = [view("rates", time, _panels(traces.measured, None, look))]
    names = [printable(Path(name).name) for name in (*found.logs, validate)]
    common = view("", time, _common(traces))
    return signals(
        axis, [common] * bool(common["panels"]), views, before=before, shown=shown, shaded=shaded, names=names
    )


def _axis(traces: Traces, ahead: Predictions | None) -> TimeAxis:
    """The axis of all logs, with the moments that are predicted."""
    starts, longest = traces.start_time, 0.0 if ahead is None else float(ahead.horizons.max())
    time = np.concatenate([traces.time, starts, starts + longest])
    log = np.concatenate([traces.log, traces.start_log, traces.start_log])
    order = np.lexsort([time, log])
    return TimeAxis.of(time[order], log[order])


def _panels(
    measured: Float[np.ndarray, "samples _"],
    predicted: Float[np.ndarray, "samples _"] | None,
    look: Style,
    channels: Sequence[int] = (0, 1, 2),
    half: Float[np.ndarray, " channels"] | None = None,
) -> list[dict[str, Any]]:
    """Measured and predicted values of channels, counted in cascade order, each with the residual below."""
    panels = []
    for i in channels:
        column, lines = CASCADE_ORDER[i], [line("measured", measured[:, i])]
        lines += [] if predicted is None else [line("predicted", predicted[:, i], look)]
        title = f"{STATE_NAMES[column]} [{STATE_UNITS[column]}]"
        panels.append(panel(title, lines, half=0.0 if half is None else float(half[i]), residual=predicted is not None))
    return panels


def _common(traces: Traces) -> list[dict[str, Any]]:
    """The inputs, and the disturbances of a vehicle."""
    panels = []
    if np.isfinite(traces.rotors).any():
        rotors = [line(f"rotor {i + 1}", column, style(i)) for i, column in enumerate(traces.rotors.T)]
        panels.append(panel("inputs [rad/s]", rotors))
    gusts = [
        line(name, each, style(i)) for i, (name, each) in enumerate(zip("pqr", traces.disturbance.T, strict=False))
    ]
    # At the ends of a log the filters err much: a few samples would hide all others.
    known = np.abs(traces.disturbance[np.isfinite(traces.disturbance)])
    reach = 1.3 * float(np.quantile(known, 0.99)) if known.size else 0.0
    return [*panels, panel("gusts [rad/s²]", gusts, reach=reach)] if gusts else panels


def _horizon(traces: Traces, ahead: Predictions, place: int, axis: TimeAxis, look: Style) -> dict[str, Any]:
    """The predictions so far ahead. The line breaks between predictions that are not of one stretch."""
    horizon, half, breaks = float(ahead.horizons[place]), prediction_band(ahead)[place], ahead.breaks
    start = axis.place(traces.start_time + horizon, traces.start_log)
    start = np.insert(start, breaks, (start[breaks - 1] + start[breaks]) / 2)
    measured, predicted = (np.insert(x[:, place], breaks, np.nan, axis=0) for x in (ahead.measured, ahead.predicted))
    return view(f"{horizon:.3g} s ahead", start, _panels(measured, predicted, look, half=half))


def _trajectories(
    traces: Traces, ahead: Predictions, paths: Predictions, axis: TimeAxis, look: Style
) -> dict[str, Any]:
    """The predictions from each start, of which one is chosen, beside all that was measured meanwhile."""
    place = np.searchsorted(ahead.start, paths.start)
    begin, log = traces.start_time[place], traces.start_log[place]
    # A trajectory that ends before the next one begins is followed by a sample without values.
    horizons = np.concatenate([[0.0], paths.horizons, [paths.horizons[-1] + 1e-4]])
    kept = np.ones((place.size, horizons.size), bool)
    kept[:-1, -1] = (np.diff(begin) > horizons[-1]) | (np.diff(log) != 0)
    start = np.broadcast_to(np.arange(place.size)[:, None], kept.shape)[kept]
    measured, predicted = (
        np.concatenate([paths.initial[:, None], each, np.full((place.size, 1, 3), np.nan)], axis=1)[kept]
        for each in (paths.measured, paths.predicted)
    )
    time = axis.place((begin[:, None] + horizons)[kept], log[start])
    return view("from one start", time, _panels(measured, predicted, look), start)


def prediction_band(ahead: Predictions) -> Float[np.ndarray, "horizons 3"]:
    """Half the width of the band that holds 95 % of the errors, by horizon and rate [rad/s]."""
    errors = np.abs(ahead.predicted - ahead.measured)
    return np.nanquantile(np.where(np.isnan(errors).all(axis=0), 0.0, errors), BAND, axis=0)
