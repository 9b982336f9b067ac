"""Vibration in a gyro: a line of its spectrum above the frequencies of a rigid body."""

from collections.abc import Sequence

import numpy as np

from ..airframe import AXES
from ..flight import RATES
from ..logs import Recording


def vibrating_rates(
    stretches: Sequence[Recording],
    *,
    above: float = 25.0,
    times: float = 5.0,
    seconds: float = 1.0,
    fewest: int = 5,
    octave: float = 2.0,
) -> dict[str, float]:
    """The body rates (`p`, `q`, `r`) whose spectrum shows a line, with its frequency [Hz].

    Rotors that turn at nearly one speed shake a gyro at this frequency, or at one that the log's rate folds it to.
    White noise, its filter and the motion of a rigid body have no line.

    **Arguments:**

    - `stretches`: as logged, not averaged, of one vehicle.
    - `above`: a rigid body that rotors turn moves below this frequency [Hz].
    - `times`: a line has this many times the power of its surroundings: the median within an `octave` to both sides.
    - `seconds`, `fewest`: how long the samples of one spectrum last [s], and how many of them are averaged at least.
    """
    step = max((each.dt for each in stretches), default=np.inf)
    length = round(seconds / step) if np.isfinite(step) else 0
    frequency = np.fft.rfftfreq(length, step) if length > 1 else np.zeros(1)
    high = np.flatnonzero((frequency >= above) & (frequency < 0.98 * frequency[-1]))
    found = {}
    for axis, column in zip(AXES, RATES, strict=True):
        spectra = []
        for each in stretches:
            rate = each.states[:, column]
            for begin in range(0, len(rate) - length, max(length // 2, 1)):
                own = rate[begin : begin + length]
                if np.isfinite(own).all():
                    spectra.append(np.square(np.abs(np.fft.rfft(np.hanning(length) * (own - own.mean())))))
        if len(spectra) < fewest or not high.size:
            continue
        power = np.convolve(np.mean(spectra, axis=0), np.full(3, 1 / 3), "same")  # speeds vary a little
        around = [
            np.median(power[(frequency > frequency[i] / octave) & (frequency < frequency[i] * octave)]) for i in high
        ]
        ratio = power[high] / np.maximum(around, np.finfo(float).tiny)
        if ratio.max() > times:
            found[axis.rate] = float(frequency[high[np.argmax(ratio)]])
    return found
