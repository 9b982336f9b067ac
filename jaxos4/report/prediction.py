"""The prediction of a flight: the table that `jaxos4 predict` prints, and its figure."""

import os

import numpy as np
from rich.console import Console

from .._files import write_file
from ..forecast import QUANTITIES, FlightPrediction
from ..logs.sampling import euler_angles
from .panels import Band, Figure, Line, Panel, Scale
from .style import BOUND_DASHES, style
from .svg import as_file
from .text import Listing, plain, say


def print_prediction(console: Console, found: FlightPrediction) -> None:
    """Prints notes, and errors by quantity: at a fifth, half and all of the horizon, and summed over all horizons."""
    for note in found.notes:
        say(console, f"note: {note}")
    last = found.horizons.size - 1
    places = sorted({max(round(share * (last + 1)) - 1, 0) for share in (0.2, 0.5, 1.0)})
    rows = []
    for name, quality in found.quality.items():
        row = name, QUANTITIES[name][0]
        for i in places:
            errors = [plain(x[i]) for x in quality[:-1]]
            rows.append((*row, f"{found.horizons[i]:.2f} s", *errors, plain(100 * quality.coverage[i])))
        rows.append((*row, "sum", *(plain(x) for x in quality.sums.values()), ""))
    errors = ("error", "unaware", "constant", "regression", "in band %")
    Listing(("quantity", "unit", "ahead", *errors), rows, errors).print_on(console)
    say(
        console,
        "error: mean absolute error; sum: over all horizons. unaware: without the disturbance that the filters know at "
        "the start. constant: velocity and rates stay as they are. in band: inside the 95 % band.",
    )
    if found.missing:
        say(console, f"not measured, and so not compared: {', '.join(found.missing)}.")
    steps = f"{found.time.size} starts, {last + 1} steps to {found.horizons[-1]:.3g} s"
    say(console, f"{found.found} predicts {found.flight}, {steps}")


def write_prediction_figure(path: str | os.PathLike[str], found: FlightPrediction, *, most: float = 10.0) -> None:
    """Writes measured lines, and predictions with their band from starts one horizon apart, as SVG. Raises `OSError`.

    `most`: the longest time that it shows [s], but two horizons at least.
    """
    columns = [("roll [rad]", 6), ("pitch [rad]", 7), ("yaw [rad]", 8)]
    columns += [(f"{axis} [rad/s]", 9 + i) for i, axis in enumerate("pqr")]
    if "velocity" not in found.missing:
        columns += [(f"{axis} [m/s]", 3 + i) for i, axis in enumerate(("vx", "vy", "vz"))]
    shown, times = [], found.time.tolist()
    for start, time in enumerate(times):
        is_free = not shown or time >= times[shown[-1]] + found.horizons[-1]
        if is_free and time + found.horizons[-1] <= times[0] + max(most, 2 * found.horizons[-1]):
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
    write_file(path, as_file(Figure("prediction", panels)))
