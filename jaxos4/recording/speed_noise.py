"""White noise of measured rotor speeds, and the speeds that are expected given all measured ones.

A noisy input makes the slope of a regression too small: moments of inertia come out too large, and true parameters
predict worse than shrunken ones. The expectation of the speeds given the measurements has no such bias: what it misses
does not correlate with it, and acts as a disturbance. It is the Wiener filter, which has no delay.

Thrust and the torques of roll, pitch and yaw are filtered separately: rotors answer some of them more than others, and
the noise is the same in all.

Reference: Carroll, Ruppert, Stefanski and Crainiceanu 2006, Measurement Error in Nonlinear Models, ch. 4.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..airframe import Airframe
from .pieces import Recording

# Length of the windows whose spectra are averaged [s], and the fewest samples of a window.
_WINDOW, _FEWEST = 1.0, 32
# The band in which changes of speeds are divided into motion and noise, as shares of the highest frequency.
_BAND = (0.25, 0.9)
# Rates at which the speeds may have been written before they were interpolated, in units of the highest frequency.
_WRITTEN = (np.inf, 4.0, 2.8, 2.0, 1.7, 1.4, 1.2, 1.0)
_PASSES = 20  # of the weighted fit
# Noise with a smaller share of the power of the changes is none: it changes no answer.
_NEGLIGIBLE = 1e-3
# Spectra are averaged over this many neighbouring frequencies to either side.
_NEIGHBOURS = 2

Changes = Float[np.ndarray, "frequencies 4"]


def without_noise(pieces: Sequence[Recording], airframe: Airframe) -> tuple[list[Recording], float, float]:
    """The pieces with the expected rotor speeds.

    **Arguments:** `pieces`: of one recording. Commands have no noise.

    **Returns:** also the standard deviation of the noise [rad/s], and the share of its power in the changes from sample
    to sample.
    """
    if any(piece.commanded for piece in pieces):
        return list(pieces), 0.0, 0.0
    axes = np.linalg.qr(np.asarray(airframe.mixer, dtype=float).T)[0]
    power = _power([piece.omega @ axes for piece in pieces], pieces[0].dt)
    if power is None:
        return list(pieces), 0.0, 0.0
    noise = _noise(power)
    kept = 1 - noise[:, None] / np.maximum(power, noise[:, None] + np.finfo(float).tiny)
    share = float(noise.sum() / max(power.mean(axis=1).sum(), np.finfo(float).tiny))
    if share < _NEGLIGIBLE:
        return list(pieces), 0.0, 0.0
    speeds = [np.maximum(_filtered(piece.omega @ axes, kept) @ axes.T, 0.0) for piece in pieces]
    smooth = [piece._replace(omega=each) for piece, each in zip(pieces, speeds, strict=True)]
    return smooth, float(np.sqrt(noise.mean() / 2)), share


def _power(signals: Sequence[Float[np.ndarray, "samples 4"]], dt: float) -> Changes | None:
    """The mean power of the changes from sample to sample, by frequency; that of white changes is their variance."""
    length = 2 * (max(round(_WINDOW / dt), _FEWEST) // 2)
    weight, spectra = np.hanning(length + 1)[:-1, None], []
    for signal in signals:
        changes = np.diff(signal, axis=0)
        for first in range(0, len(changes) - length + 1, length // 2):
            part = changes[first : first + length]
            spectra.append(np.abs(np.fft.rfft(weight * (part - part.mean(axis=0)), axis=0)) ** 2)
    if not spectra:
        return None
    power = np.mean(spectra, axis=0) / np.square(weight).sum()
    around = np.pad(power, ((_NEIGHBOURS, _NEIGHBOURS), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(around, 2 * _NEIGHBOURS + 1, axis=0)
    return windows.mean(axis=-1)


def _noise(power: Changes) -> Float[np.ndarray, " frequencies"]:
    """The power of the noise in the changes of each direction.

    Motors follow their commands with a lag, so the power of the changes of true speeds does not grow with frequency: it
    is taken as a constant and a part that falls with the square, for each direction. That of white noise grows, and
    falls again near the highest frequency if the speeds were interpolated between packets.
    """
    from scipy.optimize import nnls  # slow to import

    frequency = np.linspace(0, 1, len(power))
    growth = 4 * np.sin(np.pi / 2 * frequency) ** 2
    some = slice(*(round(edge * (len(power) - 1)) for edge in _BAND))
    directions, wanted = np.eye(power.shape[1]), np.maximum(power[some].T.ravel(), np.finfo(float).tiny)
    motion = np.hstack([np.kron(directions, growth[some, None] ** order) for order in (0, -1)])

    def fitted(rate: float) -> tuple[float, Float[np.ndarray, " frequencies"]]:
        shape = growth * np.sinc(frequency / rate) ** 4
        columns, model = np.hstack([motion, np.tile(shape[some], len(directions))[:, None]]), wanted
        size = np.zeros(columns.shape[1])
        for _ in range(_PASSES):
            size, _ = nnls(columns / model[:, None], wanted / model)
            model = np.maximum(columns @ size, np.finfo(float).tiny)
        return float((np.log(model) + wanted / model).sum()), size[-1] * shape

    return min(map(fitted, _WRITTEN), key=lambda each: each[0])[1]


def _filtered(signal: Float[np.ndarray, "samples 4"], kept: Changes) -> Float[np.ndarray, "samples 4"]:
    """The signal times a share at each frequency. Its mirror images stand before and after it."""
    mirrored = np.concatenate([signal, signal[::-1]])
    frequencies = np.linspace(0, len(kept) - 1, len(mirrored) // 2 + 1)
    share = np.column_stack([np.interp(frequencies, np.arange(len(kept)), each) for each in kept.T])
    share[0] = 1.0
    return np.fft.irfft(share * np.fft.rfft(mirrored, axis=0), len(mirrored), axis=0)[: len(signal)]
