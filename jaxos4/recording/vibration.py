"""Vibration in a gyro: a line of its spectrum above the frequencies of a rigid body."""

from collections.abc import Sequence

import numpy as np

from ..airframe import AXES
from ..flight import RATES
from ..logs import Recording
from .noise import spectra

ABOVE = 25.0  # Hz; a rigid body that rotors turn moves below this frequency
TIMES = 5.0  # a line has this many times the power of its surroundings: the median within an octave to both sides
OCTAVE = 2.0
SPECTRUM, MIN_SPECTRA = 1.0, 5  # s that the samples of one spectrum last; how many are averaged at least


def vibrating_rates(stretches: Sequence[Recording]) -> dict[str, float]:
    """The body rates (`p`, `q`, `r`) whose spectrum shows a line, with its frequency [Hz].

    Rotors that turn at nearly one speed shake a gyro at this frequency, or at one that the log's rate folds it to.
    White noise, its filter and the motion of a rigid body have no line.

    **Arguments:** `stretches`: as logged, not averaged, of one vehicle.
    """
    step = max((each.dt for each in stretches), default=SPECTRUM)
    length = round(SPECTRUM / step)
    frequency = np.fft.rfftfreq(max(length, 1), step)
    high, found = np.flatnonzero((frequency >= ABOVE) & (frequency < 0.98 * frequency[-1])), {}
    if not high.size:
        return found
    for axis, column in zip(AXES, RATES, strict=True):
        every = np.concatenate([spectra(each.states[:, column], length) for each in stretches])
        power = np.square(np.abs(every[np.isfinite(every).all(axis=-1)]))
        if len(power) < MIN_SPECTRA:
            continue
        power = np.convolve(power.mean(axis=0), np.full(3, 1 / 3), "same")  # speeds vary a little
        around = [
            np.median(power[(frequency > frequency[i] / OCTAVE) & (frequency < frequency[i] * OCTAVE)]) for i in high
        ]
        ratio = power[high] / np.maximum(around, np.finfo(float).tiny)
        if ratio.max() > TIMES:
            found[axis.rate] = float(frequency[high[np.argmax(ratio)]])
    return found
