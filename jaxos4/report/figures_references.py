"""The figure of designed references: what to fly, and the bounds of the moments of inertia against the flight time."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from .._files import write_atomically
from ..design import ReferenceDesign
from .style import INK, drawing, grid, log_axis, styles, svg

_COLUMNS = 4
_TITLES = ("roll [rad]", "pitch [rad]", "yaw [rad]", "vertical [m/s^2]")
# The references are drawn for so many periods, and the bounds up to this multiple of the flight.
_PERIODS, _LONGER = 2, 10


def references_figure(found: ReferenceDesign, accuracy: float) -> Figure:
    """Above the references, below the bounds of Ix, Iy and Iz after flights of other lengths, in percent."""
    figure, panels = grid(_COLUMNS + 3, columns=_COLUMNS, height=1.9)
    every, designed = {"designed": found.designed, **found.standard}, found.designed
    looks, some = styles(list(every)), round(_PERIODS * designed.period / designed.dt)
    time = designed.dt * np.arange(designed.references.shape[0])
    for i, panel in enumerate(panels[:_COLUMNS]):
        panel.plot(time[:some], designed.references[:some, i], color=looks["designed"].color)
        panel.set_title(_TITLES[i])
        panel.set_xlabel("time [s]")
    seconds = np.geomspace(designed.period, _LONGER * designed.duration, 50)
    for i, panel in enumerate(panels[_COLUMNS:]):
        panel.axhline(100 * accuracy, color=INK, linewidth=0.8)
        for name, one in every.items():
            bound = np.minimum(one.bounds[i] * np.sqrt(one.duration / seconds), found.prior[i]) / found.inertia[i]
            panel.plot(seconds, 100 * bound, color=looks[name].color, linestyle=looks[name].dash, label=name)
        log_axis(panel, "x")
        log_axis(panel, "y")
        panel.set_title(f"{designed.names[i]}: bound [%]")
        panel.set_xlabel("flight [s]")
    figure.legend(*panels[_COLUMNS].get_legend_handles_labels(), loc="outside lower center", ncols=len(every))
    return figure


def write_references_figure(found: ReferenceDesign, accuracy: float, out: Path) -> None:
    """Writes the figure as SVG; `accuracy` as of `print_references`, a line."""
    with drawing():
        content = svg(references_figure(found, accuracy))
    with write_atomically(out) as beside:
        beside.write_bytes(content)
