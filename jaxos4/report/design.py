"""A design of a flight beside the standard inputs: the table that `jaxos4 design` prints, and its figure."""

import math
import os

import numpy as np
from rich.console import Console

from .._files import write_file
from ..design import Design
from .panels import EVERYWHERE, Figure, Line, Panel, Scale, styles
from .svg import as_file
from .text import Listing, plain, say

_WIDTH, _HEIGHT = 270.0, 190.0  # of a panel [px]
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
    """Prints the table, the gain, the use of limits, and how long to fly for an `accuracy`: a share of each scale."""
    task, rows = found.task, []
    unexcited, targets, compared, _ = _WORDS[task.kind]
    every = {"designed": found.designed, **found.standard}
    for i, (name, unit) in enumerate(zip(task.names, task.units, strict=True)):
        in_percent = task.kind == "references" and i < task.scale.size
        unit, factor = ("%", 100 / task.scale[i]) if in_percent else (unit, 1.0)
        bounds = [one.bounds[i] for one in every.values()]
        rows.append((name, unit, *(plain(factor * x, 2) if x < task.unexcited[i] else "-" for x in bounds)))
    Listing(("parameter", "unit", *every), rows, right=tuple(every)).print_on(console)
    say(console, f"the smallest possible standard deviation; -: {unexcited}.")
    gains, count = [], task.scale.size
    for name in found.standard:
        ratio, excited = found.gain(name)
        some = "" if excited == count else f" ({excited} of {count})"
        gains.append(f"{plain(ratio, 2)} x {name}{some}" if excited else f"{name} excites nothing")
    say(console, f"geometric mean of the bounds {targets}: {'; '.join(gains)}; {compared}.")
    uses = ", ".join(f"{name} {100 * share:.0f} %" for name, share in found.designed.uses.items())
    say(console, f"largest share of each limit, of {task.vehicles} vehicles from the bracket: {uses}.")
    designed = found.designed
    times = designed.shortest(accuracy * task.scale)
    longest = float(np.max(times))
    if task.kind == "references":
        after = ", ".join(f"{name} after {x:.3g} s" for name, x in zip(task.names, times, strict=False))
        so = f"So fly at least {longest:.3g} s; the references repeat every {designed.period:.3g} s."
        say(console, f"known to {100 * accuracy:g} %: {after}. {so}")
        return
    repeats, how = longest / designed.duration, "not by this input"
    if repeats < 1e4:
        how = f"the first {longest:.2f} s are enough" if repeats <= 1 else f"fly it {math.ceil(repeats)} times"
    say(console, f"every parameter known to {100 * accuracy:g} % of its bracket's half-width: {how}.")


def write_design_figure(path: str | os.PathLike[str], found: Design, accuracy: float) -> None:
    """Writes the figure as SVG: above what to fly, below the bound of each target against the time of flight.

    A line shows the wanted accuracy (references), or the half-width of the bracket (rotor speeds). Raises `OSError`.
    """
    task, designed, in_percent = found.task, found.designed, found.task.kind == "references"
    every, panels = {"designed": designed, **found.standard}, []
    looks = {name: (look.color, 1.6, look.dash) for name, look in styles(list(every)).items()}
    time, shown = designed.dt * np.arange(designed.inputs.shape[0]), round(2 * designed.period / designed.dt)
    flown = [name for name in (("designed",) if in_percent else ("multisine", "designed")) if name in every]
    for i, title in enumerate(_WORDS[task.kind][-1]):
        lines = [Line(time[:shown], every[name].inputs[:shown, i], *looks[name], name=name) for name in flown]
        panels.append(Panel(title, lines, Scale(label="time [s]"), width=_WIDTH, height=_HEIGHT))
    x = Scale("log", label="flight [s]") if in_percent else Scale(label="time [s]")
    for i, (name, unit) in enumerate(zip(task.names[: task.scale.size], task.units, strict=False)):
        line, meaning = (100 * accuracy, "wanted") if in_percent else (float(task.scale[i]), "bracket")
        marks = [Line(EVERYWHERE, (line, line), width=1.2, name=meaning)]
        for kind, one in every.items():
            if one.history is None:
                seconds = np.geomspace(designed.period, 10 * designed.duration, 50)
                bound = one.bounds[i] * np.sqrt(one.duration / seconds)
                bound = np.where(bound < task.unexcited[i], 100 * bound / task.scale[i], np.nan)
            else:
                seconds, bound = time, one.history[:, i]
                bound = np.where(bound < 3 * task.scale[i], bound, np.nan)
            marks.append(Line(seconds, bound, *looks[kind], name=kind))
        title = f"{name}: bound [{'%' if in_percent else unit}]"
        panels.append(Panel(title, marks, x, Scale("log"), _WIDTH, _HEIGHT))
    write_file(path, as_file(Figure("design", panels, columns=4)))
