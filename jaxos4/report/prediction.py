"""The prediction of a flight: as tables for a terminal, and as a figure."""

import os
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from .._files import write_atomically
from ..forecast import QUANTITIES, FlightPrediction
from .style import BOUND_DASHES, FAINT, INK, drawing, grid, pdf, style, svg
from .text import Listing, percent, plain

# The horizons of the table, as shares of the longest.
_SHARES = (0.2, 0.5, 1.0)
# The figure shows at most this much time [s], with as many predictions as fit into it without overlap.
_SHOWN = 10.0


def print_prediction(console: Console, found: FlightPrediction) -> None:
    """Prints notes, the errors by quantity and horizon, and their sums over all horizons."""

    def say(line: str) -> None:
        console.print(line, markup=False, highlight=False)

    for note in found.notes:
        say(f"note: {note}")
    last = found.horizons.size - 1
    places = sorted({max(round(share * (last + 1)) - 1, 0) for share in _SHARES})
    rows = []
    for name, quality in found.quality.items():
        unit = QUANTITIES[name][0]
        rows += [
            (
                name,
                unit,
                f"{found.horizons[i]:.2f} s",
                *(plain(x[i]) for x in quality[:-1]),
                percent(quality.coverage[i]),
            )
            for i in places
        ]
        rows.append((name, unit, "sum", *(plain(x) for x in quality.sums.values()), ""))
    errors = ("error", "unaware", "constant", "regression", "in band %")
    Listing(("quantity", "unit", "ahead", *errors), rows, errors).print_on(console)
    say(
        "error: mean absolute error; sum: over all horizons. unaware: without the disturbance that the filters know at "
        "the start. constant: velocity and rates stay as they are. in band: inside the 95 % band."
    )
    if found.missing:
        say(f"not measured, and so not compared: {', '.join(found.missing)}.")
    steps = f"{found.time.size} starts, {last + 1} steps to {found.horizons[-1]:.3g} s"
    say(f"{found.found} predicts {found.flight}, {steps}")


def write_prediction_figure(path: str | os.PathLike[str], found: FlightPrediction) -> None:
    """Writes the figure as SVG or PDF, by the suffix. Raises `OSError` if it cannot be written."""
    with drawing():
        drawn = (pdf if Path(path).suffix == ".pdf" else svg)(prediction_figure(found))
    with write_atomically(path) as beside:
        beside.write_bytes(drawn)


def prediction_figure(found: FlightPrediction) -> Figure:
    """Measured lines, and predictions with their band from starts that are one horizon apart; 10 s at most."""
    columns = [(f"{axis} [m/s]", 3 + i) for i, axis in enumerate(("vx", "vy", "vz"))] * (
        "velocity" not in found.missing
    )
    columns += [("roll [rad]", 6), ("pitch [rad]", 7), ("yaw [rad]", 8)]
    columns += [(f"{axis} [rad/s]", 9 + i) for i, axis in enumerate("pqr")]
    if "velocity" not in found.missing:
        columns += [(f"{axis} [m/s]", 3 + i) for i, axis in enumerate(("vx", "vy", "vz"))]
    figure, panels = grid(len(columns), columns=3, width=11.0, height=1.9)
    look, shown = style(0), []
    begin = found.time[0]
    for start, time in enumerate(found.time):
        free = not shown or time >= found.time[shown[-1]] + found.horizons[-1]
        if free and time + found.horizons[-1] <= begin + _SHOWN:
            shown.append(start)
    measured, predicted = (_angles(states) for states in (found.measured, found.predicted))
    for panel, (title, column) in zip(panels, columns, strict=True):
        for start in shown:
            time = found.time[start] + found.horizons
            # A band about a measured turn of 2 pi has its branch.
            jump = 2 * np.pi * np.round((predicted[start, :, column] - measured[start, :, column]) / (2 * np.pi))
            y = predicted[start, :, column] - np.nan_to_num(jump) * (6 <= column < 9)
            half = found.half_width[start, :, column]
            band = panel.fill_between(time, y - half, y + half, color=look.color, alpha=0.22, linewidth=0)
            (line,) = panel.plot(time, y, color=look.color)
            (dots,) = panel.plot(time, measured[start, :, column], color=INK, linewidth=0.9, linestyle=BOUND_DASHES[1])
            panel.axvline(found.time[start], color=FAINT, linewidth=0.4)
        panel.set_title(title)
        panel.margins(x=0.01)
    for panel in panels[-3:]:
        panel.set_xlabel("time [s]")
    labels = ("measured", f"predicted up to {found.horizons[-1]:.3g} s ahead", "95 % band")
    figure.legend([dots, line, band], labels, loc="outside lower left", ncols=3)
    return figure


def _angles(states: np.ndarray) -> np.ndarray:
    """The states with roll, pitch and yaw [rad] in the place of the quaternion."""
    w, x, y, z = np.moveaxis(states[..., 6:10], -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    angles = np.unwrap(np.stack([roll, pitch, yaw], axis=-1), axis=-2)
    return np.concatenate([states[..., :6], angles, states[..., 10:]], axis=-1)
