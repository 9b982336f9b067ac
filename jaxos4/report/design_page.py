"""What `jaxos4 design` prints: the bounds of the designed input beside those of the standard inputs."""

import math

import numpy as np
import rich.box
from rich.console import Console
from rich.table import Table

from ..design import InputDesign
from .text import plain

_LONGEST_REPEATED = 1e4


def print_design(console: Console, found: InputDesign, accuracy: float) -> None:
    """Prints the table, what is gained, what limits the input, and how long to fly.

    `accuracy`: the wanted standard deviation of each parameter, as a share of its bracket's half-width.
    """
    table = Table(box=rich.box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in ("parameter", "unit", "designed", *found.standard):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right", no_wrap=True)
    columns = [found.designed.bounds[-1], *(one.bounds[-1] for one in found.standard.values())]
    for i, (name, unit) in enumerate(zip(found.names, found.units, strict=True)):
        cells = (plain(column[i], 2) if column[i] < found.usual[i] else "-" for column in columns)
        table.add_row(name, unit, *cells)
    console.print(table, markup=False)
    console.print("the smallest possible standard deviation; -: no better than the default bracket, not excited.")
    gains = "; ".join(_gain(found, name) for name in found.standard)
    console.print(f"geometric mean of the bounds that both have: {gains}; in the same envelope and time.")
    uses = ", ".join(f"{name} {100 * share:.0f} %" for name, share in found.designed.uses.items())
    console.print(f"largest share of each limit, of {found.vehicles} vehicles from the bracket: {uses}.")
    console.print(_duration(found, accuracy))


def _gain(found: InputDesign, name: str) -> str:
    ratio, excited = found.gain(name)
    if not excited:
        return f"{name} excites nothing"
    return f"{plain(ratio, 2)} x {name}{'' if excited == len(found.names) else f' ({excited} of {len(found.names)})'}"


def _duration(found: InputDesign, accuracy: float) -> str:
    wanted = accuracy * found.half_width
    goal = f"every parameter known to {100 * accuracy:g} % of its bracket's half-width"
    enough = found.designed.first_time(wanted)
    if math.isfinite(enough):
        return f"{goal}: the first {enough:.2f} s are enough."
    times = float(np.max(np.square(found.designed.bounds[-1] / wanted)))
    return f"{goal}: fly it {math.ceil(times)} times." if times < _LONGEST_REPEATED else f"{goal}: not by this input."
