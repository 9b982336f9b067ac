"""What `jaxos4 design --closed-loop` prints: the bounds of designed references beside those of standard ones."""

import numpy as np
import rich.box
from rich.console import Console
from rich.table import Table

from ..design import ReferenceDesign
from .text import plain

# A bound above this share of the bracket's standard deviation says that the flight adds little.
_LITTLE = 0.9


def print_references(console: Console, found: ReferenceDesign, accuracy: float) -> None:
    """Prints the table, what is gained, what limits the references, and how long to fly.

    `accuracy`: the wanted standard deviation of Ix, Iy and Iz, as a share of each.
    """
    table = Table(box=rich.box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in ("parameter", "unit", "designed", *found.standard):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right", no_wrap=True)
    every, inertia = (found.designed, *found.standard.values()), found.inertia
    for i, (name, unit) in enumerate(zip(found.designed.names, found.designed.units, strict=True)):
        of_inertia = i < inertia.size
        scale = 100 / inertia[i] if of_inertia else 1.0
        cells = (plain(scale * one.bounds[i], 2) if one.bounds[i] < _LITTLE * found.prior[i] else "-" for one in every)
        table.add_row(name, "%" if of_inertia else unit, *cells)
    console.print(table, markup=False)
    console.print("the smallest possible standard deviation; -: the flight adds little to the bracket.")
    gains = "; ".join(f"{plain(found.gain(name), 2)} x {name}" for name in found.standard)
    console.print(f"geometric mean of the bounds of Ix, Iy and Iz: {gains}; of the same length and largest angle.")
    uses = ", ".join(f"{name} {100 * share:.0f} %" for name, share in found.designed.uses.items())
    console.print(f"largest share of each limit, of {found.vehicles} vehicles from the bracket: {uses}.")
    times = found.designed.shortest(accuracy * inertia)
    after = ", ".join(f"{name} after {seconds:.3g} s" for name, seconds in zip(("Ix", "Iy", "Iz"), times, strict=True))
    console.print(
        f"known to {100 * accuracy:g} %: {after}. So fly at least {np.max(times):.3g} s; the references repeat every "
        f"{found.designed.period:.3g} s."
    )
