"""Plots what each model can identify, the errors of its fits, and the tests of their residuals."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from experiments.drawing import grid, log_axis
from experiments.shared import load_results, plotter
from jaxos4.report.style import FAINT, INK, styles
from jaxos4.results import NINETY_FIVE

LEVEL = 0.01
TESTS = {"white_p": "white", "input_p": "free of\ninputs", "level_p": "of the\nnoise's size"}


def draw(data: xr.Dataset) -> Figure:
    """Colour shows the fitted model. Filled markers: flights of the same model; open markers: of the other model."""
    figure, axes = grid(3 * data.sizes["channels"], columns=3, height=2.7, width=10.0)
    looks = dict(zip(data["fitted"].values, styles(["ibss", "network"]).values(), strict=True))
    rms, names = (data["error"] ** 2).mean("flight") ** 0.5, data["parameter"].values
    rejected = 100 * (data[list(TESTS)].to_dataarray("test") < LEVEL).mean("flight")
    for row, channels in enumerate(data["channels"].values):
        left, middle, right = axes[3 * row : 3 * row + 3]
        left.axhline(NINETY_FIVE, color=FAINT, linestyle="dashed", linewidth=1.0)
        middle.axhline(1, color=INK, linewidth=1.0)
        right.axhline(100 * LEVEL, color=INK, linewidth=1.0)
        for place, (fitted, look) in enumerate(looks.items()):
            own = data.sel(channels=channels, flown=fitted, fitted=fitted)
            size = (abs(own["truth"]) / own["bound"]).where(own["truth"] != 0)
            x = np.arange(len(names)) + 0.3 * (place - 0.5)
            left.plot(x, size, look.marker, color=look.color)
            for flown in data["flown"].values:
                which = {"channels": channels, "flown": flown, "fitted": fitted}
                fill = "full" if flown == fitted else "none"
                mark = {"color": look.color, "fillstyle": fill, "label": f"{fitted} fitted to {flown}"}
                middle.plot(x, rms.sel(which), look.marker, **mark)
                right.plot(np.arange(len(TESTS)) + 0.3 * (place - 0.5), rejected.sel(which), look.marker, **mark)
        for panel in (left, middle):
            panel.set_yscale("log")
            log_axis(panel, "y")
            panel.set_xticks(range(len(names)), [name.replace("alpha", "") for name in names])
            panel.set_xlabel("alpha")
        right.set_xticks(range(len(TESTS)), TESTS.values())
        right.set_ylim(-5, 105)
        seen = {"rates": "body rates", "all": "all channels"}.get(str(channels), str(channels))
        left.set_title(f"{seen}: |truth| / bound")
        middle.set_title("RMS error / bound")
        right.set_title(f"residuals rejected at {100 * LEVEL:g} % [%]")
    figure.legend(*middle.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


main = plotter(load_results, {"published_corrected": draw})
