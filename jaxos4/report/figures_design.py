"""The figure of a designed input: rotor speeds, and the bound of each parameter against time."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from .._files import write_atomically
from ..design import InputDesign
from .style import INK, drawing, grid, label_edges, log_axis, styles, svg

_COLUMNS = 4


def design_figure(found: InputDesign) -> Figure:
    """Above the rotor speeds, below the bound of each parameter: designed, and the standard inputs."""
    count = len(found.names)
    figure, panels = grid(_COLUMNS + count, columns=_COLUMNS, height=1.9)
    time = found.designed.dt * np.arange(found.designed.omega.shape[0])
    inputs = {"designed": found.designed, **found.standard}
    looks = styles(list(inputs))
    for rotor, panel in enumerate(panels[:_COLUMNS]):
        for name in ("multisine", "designed"):
            if name in inputs:
                panel.plot(time, inputs[name].omega[:, rotor], color=looks[name].color, linestyle=looks[name].dash)
        panel.set_title(f"rotor {rotor + 1} [rad/s]")
    for i, panel in enumerate(panels[_COLUMNS:]):
        panel.axhline(found.half_width[i], color=INK, linewidth=0.8)
        for name, one in inputs.items():
            known = np.where(one.bounds[:, i] < 3 * found.half_width[i], one.bounds[:, i], np.nan)
            panel.plot(time, known, color=looks[name].color, linestyle=looks[name].dash, label=name)
        log_axis(panel, "y")
        panel.set_title(f"{found.names[i]}: bound [{found.units[i]}]")
    label_edges(panels, _COLUMNS, x="time [s]")
    figure.legend(*panels[_COLUMNS].get_legend_handles_labels(), loc="outside lower center", ncols=len(inputs))
    return figure


def write_design(found: InputDesign, out: Path) -> None:
    """Writes the figure as SVG."""
    with drawing():
        content = svg(design_figure(found))
    with write_atomically(out) as beside:
        beside.write_bytes(content)
