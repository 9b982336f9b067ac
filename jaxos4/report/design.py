"""A design of a flight beside the standard inputs: the table that `jaxos4 design` prints, and its figure."""

import math
from pathlib import Path

import numpy as np
from rich.console import Console

from .._files import write_file
from ..design import Design
from .text import Listing, plain

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
