"""The figure of the frequency response: gain, phase and coherence against frequency, for each axis."""

import math

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MultipleLocator, NullLocator

from ..analysis.frequency_response import AxisResponse, FrequencyResponse
from .style import BOUND_DASHES, FAINT, INK, Style, grid

# The frequencies and gains that the figure shows, at most.
_HIGHEST, _GAINS = 40.0, (0.2, 5.0)
_GAIN_TICKS, _FREQUENCY_TICKS = (0.2, 0.5, 1, 2, 5), (1, 2, 5, 10, 20, 40)


def frequency_responses(found: FrequencyResponse, look: Style) -> Figure:
    """Gain, phase and coherence of roll, pitch and yaw, with 95 % bands, and the model as a line.

    The title of an axis says by how much the measured response exceeds the model's from 4 to 20 Hz. A frequency without
    a clear response is drawn faintly.
    """
    figure, panels = grid(9, columns=3, width=9.0, height=1.75)
    top = min(_HIGHEST, max(float(axis.frequency[-1]) if axis.frequency.size else 1.0 for axis in found))
    shown: list[Artist] = []
    for column, (name, axis) in enumerate(zip(found._fields, found, strict=True)):
        gain, phase, coherence = panels[column::3]
        drawn = _response(gain, axis, axis.gain, axis.gain * np.exp([-axis.half_width, axis.half_width]), look)
        degrees, spread = np.degrees(axis.phase), np.degrees(np.minimum(axis.half_width, math.pi))
        _response(phase, axis, degrees, degrees + np.array([-spread, spread]), look)
        coherence.plot(axis.frequency, axis.coherence, color=look.color)
        model = gain.axhline(1.0, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[2])
        phase.axhline(0.0, color=INK, linewidth=0.9, linestyle=BOUND_DASHES[2])
        coherence.axhline(0.6, color=FAINT, linewidth=0.9, linestyle=BOUND_DASHES[1])
        shown = [*drawn, model]
        gain.set_title(f"{name}: {_said(axis)}")
        gain.set_yscale("log")
        gain.set_ylim(_GAINS)
        _ticks(gain, "y", _GAIN_TICKS)
        phase.set_ylim(-180, 180)
        phase.yaxis.set_major_locator(MultipleLocator(90))
        coherence.set_ylim(0, 1.03)
        coherence.set_xlabel("frequency [Hz]")
        for panel in (gain, phase, coherence):
            panel.set_xscale("log")
            panel.set_xlim(1.0, top)
            _ticks(panel, "x", _FREQUENCY_TICKS)
            panel.tick_params(labelbottom=panel is coherence, labelleft=column == 0)
    for panel, label in zip(panels[::3], ("gain", "phase [degrees]", "coherence"), strict=True):
        panel.set_ylabel(label)
    labels = ("measured over modelled", "95 %", "coherence below 0.6", "the model")
    figure.legend(shown, labels, loc="outside lower left", ncols=4)
    return figure


def _response(panel: Axes, axis: AxisResponse, values: np.ndarray, band: np.ndarray, look: Style) -> list[Artist]:
    """A line with its band: strong for a clear response, else faint."""
    (faint,) = panel.plot(axis.frequency, values, color=FAINT, linewidth=0.8)
    shown = np.where(axis.clear, values, np.nan)
    low, high = np.where(axis.clear, band, np.nan)
    filled = panel.fill_between(axis.frequency, low, high, color=look.color, alpha=0.25, linewidth=0)
    (line,) = panel.plot(axis.frequency, shown, color=look.color)
    return [line, filled, faint]


def _said(axis: AxisResponse) -> str:
    agreement = axis.agreement()
    if math.isnan(agreement.ratio):
        return "no clear response"
    return "{:.2f} ({:.2f} to {:.2f}) times the model".format(agreement.ratio, *agreement.interval)


def _ticks(panel: Axes, which: str, ticks: tuple[float, ...]) -> None:
    axis = panel.xaxis if which == "x" else panel.yaxis
    axis.set_major_locator(FixedLocator(list(ticks)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())
