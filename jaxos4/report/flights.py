"""A design of a flight, and the prediction of one: the tables that their commands print, and their figures."""

import math
import os
from pathlib import Path

import numpy as np
from rich.console import Console

from .._files import write_file
from ..design import Design
from ..forecast import QUANTITIES, FlightPrediction
from ..logs.sampling import euler_angles
from .text import Listing, percent, plain, say

_COLUMNS = 4
# By the kind of design: what a missing bound means, what the geometric mean is taken of, what the other inputs share
# with the design, and the titles of the panels of the inputs.
_WORDS = {
    "rotor speeds": (
        "no better than the default bracket, not excited",
        "that both have",
        "in the same envelope and time",
        tuple(f"rotor {i} [rad/s]" for i in range(1, 5)),
    ),
    "references": (
        "the flight adds little to the bracket",
        "of Ix, Iy and Iz",
        "of the same length and largest angle",
        ("roll [rad]", "pitch [rad]", "yaw [rad]", "vertical [m/s^2]"),
    ),
}


def print_design(console: Console, found: Design, accuracy: float) -> None:
    """Print the table, the gain, the use of limits, and how long to fly for an `accuracy`, as a share of each scale."""
    task, rows = found.task, []
    unexcited, targets, compared, _ = _WORDS[task.kind]
    every = {"designed": found.designed, **found.standard}
    for i, (name, unit) in enumerate(zip(task.names, task.units, strict=True)):
        in_percent = task.kind == "references" and i < task.scale.size
        unit, factor = ("%", 100 / task.scale[i]) if in_percent else (unit, 1.0)
        bounds = [one.bounds[i] for one in every.values()]
        rows.append((name, unit, *(plain(factor * x, 2) if x < task.unexcited[i] else "-" for x in bounds)))
    Listing(("parameter", "unit", *every), rows, right=tuple(every)).print_on(console)
    console.print(f"the smallest possible standard deviation; -: {unexcited}.")
    gains, count = [], task.scale.size
    for name in found.standard:
        ratio, excited = found.gain(name)
        some = "" if excited == count else f" ({excited} of {count})"
        gains.append(f"{plain(ratio, 2)} x {name}{some}" if excited else f"{name} excites nothing")
    console.print(f"geometric mean of the bounds {targets}: {'; '.join(gains)}; {compared}.")
    uses = ", ".join(f"{name} {100 * share:.0f} %" for name, share in found.designed.uses.items())
    console.print(f"largest share of each limit, of {task.vehicles} vehicles from the bracket: {uses}.")
    designed = found.designed
    times = designed.shortest(accuracy * task.scale)
    longest = float(np.max(times))
    if task.kind == "references":
        after = ", ".join(f"{name} after {x:.3g} s" for name, x in zip(task.names, times, strict=False))
        so = f"So fly at least {longest:.3g} s; the references repeat every {designed.period:.3g} s."
        console.print(f"known to {100 * accuracy:g} %: {after}. {so}")
        return
    repeats, how = longest / designed.duration, "not by this input"
    if repeats < 1e4:
        how = f"the first {longest:.2f} s are enough" if repeats <= 1 else f"fly it {math.ceil(repeats)} times"
    console.print(f"every parameter known to {100 * accuracy:g} % of its bracket's half-width: {how}.")


def write_design(found: Design, accuracy: float, out: Path) -> None:
    """Write the figure as SVG: above what to fly, below the bound of each target against the time of flight.

    A line shows the wanted accuracy (references), or the half-width of the bracket (rotor speeds).
    """
    from .style import INK, drawing, grid, label, log_axis, styles, svg  # a second that the table does not need

    task, designed, in_percent = found.task, found.designed, found.task.kind == "references"
    every, targets = {"designed": designed, **found.standard}, task.scale.size
    with drawing():
        figure, panels = grid(_COLUMNS + targets, columns=_COLUMNS, height=1.9)
        looks, shown = styles(list(every)), round(2 * designed.period / designed.dt)
        time = designed.dt * np.arange(designed.inputs.shape[0])
        for i, (panel, title) in enumerate(zip(panels, _WORDS[task.kind][-1], strict=False)):
            for name in ("designed",) if in_percent else ("multisine", "designed"):
                if name in every:
                    look = looks[name]
                    panel.plot(time[:shown], every[name].inputs[:shown, i], color=look.color, linestyle=look.dash)
            panel.set_title(title)
        for i, panel in enumerate(panels[_COLUMNS:]):
            panel.axhline(100 * accuracy if in_percent else float(task.scale[i]), color=INK, linewidth=0.8)
            for name, one in every.items():
                if one.history is None:
                    seconds = np.geomspace(designed.period, 10 * designed.duration, 50)
                    bound = one.bounds[i] * np.sqrt(one.duration / seconds)
                    bound = np.where(bound < task.unexcited[i], 100 * bound / task.scale[i], np.nan)
                else:
                    seconds, bound = time, one.history[:, i]
                    bound = np.where(bound < 3 * task.scale[i], bound, np.nan)
                panel.plot(seconds, bound, color=looks[name].color, linestyle=looks[name].dash, label=name)
            if in_percent:
                log_axis(panel, "x")
            log_axis(panel, "y")
            panel.set_title(f"{task.names[i]}: bound [{'%' if in_percent else task.units[i]}]")
        label(figure, x="time [s]")
        for panel in panels[_COLUMNS:] if in_percent else ():
            panel.set_xlabel("flight [s]")
        handles = panels[_COLUMNS].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=len(every))
        content = svg(figure)
    write_file(out, content)


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
            rows.append((*row, f"{found.horizons[i]:.2f} s", *errors, percent(quality.coverage[i])))
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
    from .style import BOUND_DASHES, INK, drawing, grid, style, svg  # a second that the table does not need

    columns = [("roll [rad]", 6), ("pitch [rad]", 7), ("yaw [rad]", 8)]
    columns += [(f"{axis} [rad/s]", 9 + i) for i, axis in enumerate("pqr")]
    if "velocity" not in found.missing:
        columns += [(f"{axis} [m/s]", 3 + i) for i, axis in enumerate(("vx", "vy", "vz"))]
    with drawing():
        figure, panels = grid(len(columns), columns=3, width=11.0, height=1.9)
        look, shown, times = style(0), [], found.time.tolist()
        for start, time in enumerate(times):
            is_free = not shown or time >= times[shown[-1]] + found.horizons[-1]
            if is_free and time + found.horizons[-1] <= times[0] + max(most, 2 * found.horizons[-1]):
                shown.append(start)
        # Lines break between predictions.
        x = np.pad(found.time[shown, None] + found.horizons, ((0, 0), (0, 1)), constant_values=np.nan).ravel()
        both = (found.measured[shown], found.predicted[shown])  # with angles in the place of the quaternion
        measured, predicted = (
            np.concatenate([x[..., :6], euler_angles(x[..., 6:10]), x[..., 10:]], axis=-1) for x in both
        )
        # The same turn of an angle.
        predicted[..., 6:9] = np.unwrap(predicted[..., 6:9], axis=-2)
        measured[..., 6:9] -= 2 * np.pi * np.nan_to_num(np.round((measured - predicted)[..., 6:9] / (2 * np.pi)))
        handles = []
        for panel, (title, column) in zip(panels, columns, strict=True):
            y, half, seen = (
                np.pad(values[..., column], ((0, 0), (0, 1)), constant_values=np.nan).ravel()
                for values in (predicted, found.half_width[shown], measured)
            )
            band = panel.fill_between(x, y - half, y + half, color=look.color, alpha=0.22, linewidth=0)
            (line,) = panel.plot(x, y, color=look.color)
            (dots,) = panel.plot(x, seen, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[1])
            handles = [dots, line, band]
            panel.set_title(title)
            panel.margins(x=0.01)
            # The band of the first predictions is wide, because their offsets are unknown.
            lines = np.concatenate([y, seen])
            low, high = np.nanmin(lines), np.nanmax(lines)
            panel.set_ylim(low - 0.4 * (high - low) - 1e-3, high + 0.4 * (high - low) + 1e-3)
        for panel in panels[-3:]:
            panel.set_xlabel("time [s]")
        labels = ("measured", f"predicted up to {found.horizons[-1]:.3g} s ahead", "95 % band")
        figure.set_layout_engine(None)  # to fit all labels exactly would take half of the time
        below, width, height = 0.5, *figure.get_size_inches()
        figure.subplots_adjust(0.5 / width, (below + 0.4) / height, 1 - 0.1 / width, 1 - 0.3 / height, hspace=0.35)
        figure.legend(handles, labels, loc="lower left", ncols=3)
        drawn = svg(figure)
    write_file(path, drawn)
