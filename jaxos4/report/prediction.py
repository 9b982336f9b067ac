"""The prediction of a flight: the table that `jaxos4 predict` prints, its figure, and its page."""

import os

import numpy as np
from rich.console import Console

from .._files import write_file
from ..forecast import QUANTITIES, FlightPrediction
from ..rotations import euler_angles
from .page import Section, picture, table, text, write_page
from .panels import BOUND_DASHES, FAINT, INK, Band, Figure, Line, Panel, Scale, style
from .svg import as_file
from .text import Listing, plain, say

_LONGEST = 10.0  # s; the figure shows this much of a flight, but two horizons at least
_HEADINGS = ("quantity", "unit", "ahead", "error", "unaware", "constant", "regression", "in band %")
_WORDS = (
    "error: mean absolute error; sum: over all horizons. unaware: without the disturbance that the filters know at the "
    "start. constant: velocity and rates stay as they are. in band: inside the 95 % band."
)


def print_prediction(console: Console, found: FlightPrediction) -> None:
    """Prints notes, and errors by quantity: at a fifth, half and all of the horizon, and summed over all horizons."""
    for note in found.notes:
        say(console, f"note: {note}")
    Listing(_HEADINGS, _rows(found), _HEADINGS[3:]).print_on(console)
    say(console, _WORDS)
    if found.missing:
        say(console, f"not measured, and so not compared: {', '.join(found.missing)}.")
    say(console, f"{found.found} predicts {found.flight}, {_size(found)}")


def _size(found: FlightPrediction) -> str:
    return f"{found.time.size} starts, {found.horizons.size} steps to {found.horizons[-1]:.3g} s"


def _rows(found: FlightPrediction) -> list[tuple[str, ...]]:
    last, rows = found.horizons.size, []
    places = sorted({max(round(share * last) - 1, 0) for share in (0.2, 0.5, 1.0)})
    for name, quality in found.quality.items():
        row = name, QUANTITIES[name][0]
        for i in places:
            shares = plain(100 * quality.coverage[i])
            rows.append((*row, f"{found.horizons[i]:.2f} s", *(plain(x[i]) for x in quality[:-1]), shares))
        rows.append((*row, "sum", *(plain(x) for x in quality.sums.values()), ""))
    return rows


def write_prediction_figure(path: str | os.PathLike[str], found: FlightPrediction) -> None:
    """Writes the figure of measured and predicted signals as SVG. Raises `OSError`."""
    write_file(path, as_file(predicted_signals(found)))


def predicted_signals(found: FlightPrediction) -> Figure:
    """Measured lines, and predictions with their band from starts one horizon apart."""
    columns = [("roll [rad]", 6), ("pitch [rad]", 7), ("yaw [rad]", 8)]
    columns += [(f"{axis} [rad/s]", 9 + i) for i, axis in enumerate("pqr")]
    if "velocity" not in found.missing:
        columns += [(f"{axis} [m/s]", 3 + i) for i, axis in enumerate(("vx", "vy", "vz"))]
    shown, times = [], found.time.tolist()
    for start, time in enumerate(times):
        is_free = not shown or time >= times[shown[-1]] + found.horizons[-1]
        if is_free and time + found.horizons[-1] <= times[0] + max(_LONGEST, 2 * found.horizons[-1]):
            shown.append(start)
    # Lines break between predictions.
    x = np.pad(found.time[shown, None] + found.horizons, ((0, 0), (0, 1)), constant_values=np.nan).ravel()
    both = (found.measured[shown], found.predicted[shown])  # with angles in the place of the quaternion
    measured, predicted = (np.concatenate([x[..., :6], euler_angles(x[..., 6:10]), x[..., 10:]], axis=-1) for x in both)
    # The same turn of an angle.
    predicted[..., 6:9] = np.unwrap(predicted[..., 6:9], axis=-2)
    measured[..., 6:9] -= 2 * np.pi * np.nan_to_num(np.round((measured - predicted)[..., 6:9] / (2 * np.pi)))
    look, panels = style(0), []
    for title, column in columns:
        y, half, seen = (
            np.pad(values[..., column], ((0, 0), (0, 1)), constant_values=np.nan).ravel()
            for values in (predicted, found.half_width[shown], measured)
        )
        marks = [
            Band(x, y - half, y + half, look.color, 0.22, name="95 % band"),
            Line(x, y, look.color, name=f"predicted up to {found.horizons[-1]:.3g} s ahead"),
            Line(x, seen, width=1.2, dash=BOUND_DASHES[1], name="measured"),
        ]
        # The band of the first predictions is wide, because their offsets are unknown.
        lines = np.concatenate([y, seen])
        low, high = float(np.nanmin(lines)), float(np.nanmax(lines))
        room = 0.4 * (high - low) + 1e-3
        panels.append(Panel(title, marks, Scale(label="time [s]"), Scale(ends=(low - room, high + room))))
    return Figure("prediction", panels)


def errors_ahead(found: FlightPrediction) -> Figure:
    """The error of each quantity against the time ahead, beside those of the simple predictions."""
    panels, x = [], Scale(label="ahead [s]")
    looks = (("this vehicle", style(0).color, 2.2, 0), ("constant rates", INK, 1.4, 2), ("regression", FAINT, 1.4, 1))
    for name, quality in found.quality.items():
        values = (quality.error, quality.constant, quality.regression)
        marks = [
            Line(found.horizons, y, color, width, BOUND_DASHES[dash], name=label)
            for y, (label, color, width, dash) in zip(values, looks, strict=True)
            if np.isfinite(y).any()
        ]
        panels.append(Panel(f"{name}: error [{QUANTITIES[name][0]}]", marks, x))
    return Figure("errors", panels)


def headline(found: FlightPrediction) -> str:
    """How far ahead the vehicle predicts each quantity better than both simple predictions."""
    simple = {name: np.fmin(x.constant, x.regression) for name, x in found.quality.items()}
    known = [name for name, errors in simple.items() if np.isfinite(errors).all()]
    if not known:
        return "Nothing was measured that a prediction can be compared with."
    better = {name: np.append(found.quality[name].error < simple[name], False).argmin() for name in known}
    reach = ", ".join(f"{name} {found.horizons[count - 1]:.2g} s" for name, count in better.items() if count)
    never = ", ".join(name for name, count in better.items() if not count)
    said = [f"Better than constant rates and than a regression up to {reach} ahead."] * bool(reach)
    return " ".join([*said, *[f"Never better: {never}."] * bool(never)])


def write_prediction(path: str | os.PathLike[str], found: FlightPrediction, *, command: str = "") -> None:
    """Writes the page of a prediction, completely or not at all. `command`: that makes it again. Raises `OSError`."""
    rows, group = list[str | tuple[str, ...]](), ""
    for name, unit, *cells in _rows(found):
        rows += [f"{name} [{unit}]"] * (group != name)
        rows.append(tuple(cells))
        group = name
    drawn = picture(
        predicted_signals(found),
        "Each prediction starts from the measured state and uses the recorded motors. Shown: at most the first "
        f"{max(_LONGEST, 2 * found.horizons[-1]):.3g} s.",
    )
    grown = picture(
        errors_ahead(found),
        "Mean absolute error by the time ahead. The vehicle helps where its line is below those of constant rates and "
        "of the regression.",
    )
    notes = [f"not measured, and so not compared: {', '.join(found.missing)}."] * bool(found.missing)
    write_page(
        path,
        title=f"{found.flight}, predicted",
        about=f"Another flight, predicted with the vehicle of {found.found}: {_size(found)}.",
        top=[text(headline(found), "verdict"), text([*found.notes, *notes])],
        sections=[
            Section("errors", "Errors by time ahead", [grown], "Errors"),
            Section("prediction", "Measured and predicted", [drawn], "Signals"),
            Section(
                "quantities",
                "All errors",
                [table("errors-table", "Mean absolute errors", _HEADINGS[2:], rows, [_WORDS])],
                "Table",
            ),
        ],
        command=command,
        provenance=[("result", found.found), ("flight", found.flight), ("seed", str(found.seed))],
    )
