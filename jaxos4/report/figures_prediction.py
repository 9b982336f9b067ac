"""The figure of predictions: measured and predicted body rates against time."""

import math

import numpy as np
from matplotlib.figure import Figure

from ..analysis.prediction import Predictions
from .style import BOUND_DASHES, INK, Style, grid

BAND = 0.95
"""The share of the errors that the band holds."""

# Width of the figure by the time that it shows [inch/s], and its limits [inch].
_INCHES_A_SECOND, _NARROWEST, _WIDEST = 0.25, 9.0, 30.0


def predicted_rates(predicted: Predictions, sample_time: float, horizon: int, look: Style) -> Figure:
    """Measured and predicted p, q, r against the time that is predicted, with a band that holds 95 % of the errors.

    **Arguments:**

    - `sample_time`: of the flight [s].
    - `horizon`: index into `predicted.horizons`.
    """
    time = predicted.start * sample_time + predicted.horizons[horizon]
    # Lines break between stretches.
    usual = np.median(np.diff(predicted.start)) if predicted.start.size > 1 else 1
    breaks = np.flatnonzero(np.diff(predicted.start) > 1.5 * usual) + 1
    width = float(np.clip(_INCHES_A_SECOND * np.ptp(time), _NARROWEST, _WIDEST))
    figure, panels = grid(3, columns=1, width=width, height=1.9)
    for rate, (panel, name) in enumerate(zip(panels, "pqr", strict=True)):
        y, measured = predicted.predicted[:, horizon, rate], predicted.measured[:, horizon, rate]
        errors = np.abs(y - measured)
        errors = errors[np.isfinite(errors)]
        half = float(np.quantile(errors, BAND)) if errors.size else math.nan
        x, y, measured = (np.insert(values.astype(float), breaks, np.nan) for values in (time, y, measured))
        band = panel.fill_between(x, y - half, y + half, color=look.color, alpha=0.22, linewidth=0)
        (line,) = panel.plot(x, y, color=look.color)
        (dots,) = panel.plot(x, measured, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[1])
        panel.set_title(f"{name} [rad/s]")
        panel.margins(x=0.01)
        panel.tick_params(labelbottom=rate == 2)
        if rate == 2:
            panel.set_xlabel("time [s]")
            labels = ("measured", f"predicted {predicted.horizons[horizon]:.3g} s ahead", f"{100 * BAND:g} % of errors")
            figure.legend([dots, line, band], labels, loc="outside lower left", ncols=3)
    return figure
