"""Errors of sensors: white noise and vibration, the accelerometer's constant error, and the sag that a voltage lacks.

A noisy input makes the slope of a regression too small, so moments of inertia come out too large. The expectation of
the speeds given all measurements, by a Wiener filter without delay, has no such bias: its error does not correlate with
it, and acts as a disturbance. Thrust and torques are filtered separately, because their power differs and the noise
is the same in all.

Reference: Carroll, Ruppert, Stefanski and Crainiceanu 2006, Measurement Error in Nonlinear Models, ch. 4.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex, Float

from ..airframe import AXES, Airframe
from ..flight import RATES
from ..logs import Recording

Changes = Float[np.ndarray, "frequencies 4"]


def white_noise(values: Float[np.ndarray, " samples"], order: int) -> float:
    """The standard deviation of white noise, from the median size of differences of this order; NaN without any.

    Motion is smooth from sample to sample, noise is not. A higher order tolerates faster motion. The median ignores
    jumps between stretches, and jumps of angles by a whole turn.
    """
    size = np.diff(values, order)
    size = np.abs(size[np.isfinite(size)])
    return float(np.median(size)) / 0.6745 / math.sqrt(math.comb(2 * order, order)) if size.size else math.nan


LEAST_NOISE = 0.5  # share of the noise from second differences


def force_noise(recording: Recording) -> Float[np.ndarray, "3"]:
    """A lower limit of the white noise of means over a second [m/s^2], by second differences and the resolution.

    Vibration is not smooth from row to row. Without this limit, a fit may take it for a disturbance.
    """
    least, force = np.zeros(3), recording.specific_force
    for axis, values in enumerate([] if force is None else force.T):
        size = np.abs(np.diff(values))
        rounding = 1e-6 * np.nanmax(np.abs(values), initial=1.0)
        count = np.min(size[size > rounding], initial=np.inf)
        noise = max(LEAST_NOISE * white_noise(values, 2), count if np.isfinite(count) else 0.0)
        least[axis] = np.nan_to_num(noise) * math.sqrt(recording.dt)
    return least


SPECTRUM = 1.0  # s; duration of the samples of one spectrum


def spectra(
    signals: Float[np.ndarray, "samples *signals"], length: int
) -> Complex[np.ndarray, "segments *signals frequencies"]:
    """Spectra of segments of `length` samples that overlap by half, of each signal without its mean, in a Hann window.

    A segment with NaN is NaN. The mean square of white noise is its variance. Reference: Welch 1967, IEEE Trans. Audio
    Electroacoustics 15.
    """
    window = np.hanning(length + 1)[:-1]
    window /= np.linalg.norm(window)
    if len(signals) < length:
        return np.empty((0, *signals.shape[1:], length // 2 + 1), dtype=complex)
    segments = np.lib.stride_tricks.sliding_window_view(signals, length, axis=0)[:: max(length // 2, 1)]
    return np.fft.rfft(window * (segments - segments.mean(axis=-1, keepdims=True)))


NEGLIGIBLE = 1e-3  # share of the power of the changes; less noise changes no answer


def without_noise(stretches: Sequence[Recording], airframe: Airframe) -> tuple[list[Recording], float, float]:
    """The stretches of one recording with rotor speeds without their noise. Commands have no noise.

    **Returns:** the stretches, the noise's standard deviation [rad/s], and its share of the power of changes between
    samples.
    """
    unchanged = list(stretches), 0.0, 0.0
    axes = np.linalg.qr(np.asarray(airframe.mixer, dtype=float).T)[0]
    commanded = any(each.commanded for each in stretches)
    power = None if commanded else _power([each.omega @ axes for each in stretches], stretches[0].dt)
    if power is None:
        return unchanged
    noise = _noise(power)
    kept = 1 - noise[:, None] / np.maximum(power, noise[:, None] + np.finfo(float).tiny)
    share = float(noise.sum() / max(power.mean(axis=1).sum(), np.finfo(float).tiny))
    if share < NEGLIGIBLE:
        return unchanged
    speeds = [np.maximum(_filtered(each.omega @ axes, kept) @ axes.T, 0.0) for each in stretches]
    smooth = [each._replace(omega=speed) for each, speed in zip(stretches, speeds, strict=True)]
    return smooth, float(np.sqrt(noise.mean() / 2)), share


NOISY = 0.1  # a larger share of noise in the changes of rotor speeds is noted


def smoothed(
    recordings: Sequence[Recording], pieces: Sequence[Sequence[Recording]], airframe: Airframe
) -> tuple[list[int], list[Recording], list[str]]:
    """The number of the recording of each stretch, the stretches without noise of the rotor speeds, and notes.

    `pieces`: the stretches of each recording.
    """
    numbers, stretched, notes = [], [], []
    for number, (recording, stretches) in enumerate(zip(recordings, pieces, strict=True)):
        smooth, noise, share = without_noise(stretches, airframe)
        numbers += [number] * len(smooth)
        stretched += smooth
        if share > NOISY:
            how = f"{noise:.2g} rad/s, {100 * share:.0f} % of their changes from sample to sample"
            notes.append(f"{recording.name}: rotor speeds are noisy ({how}) and were smoothed")
    return numbers, stretched, notes


MIN_SAMPLES = 32  # of one spectrum
NEIGHBOURS = 2  # frequencies to either side over which spectra are averaged


def _power(signals: Sequence[Float[np.ndarray, "_ 4"]], dt: float) -> Changes | None:
    """The mean power of the changes from sample to sample, by frequency. For white changes, it is their variance."""
    length = 2 * (max(round(SPECTRUM / dt), MIN_SAMPLES) // 2)
    found = np.concatenate([spectra(np.diff(signal, axis=0), length) for signal in signals])
    if not len(found):
        return None
    power = np.square(np.abs(found)).mean(axis=0).T
    around = np.pad(power, ((NEIGHBOURS, NEIGHBOURS), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(around, 2 * NEIGHBOURS + 1, axis=0)
    return windows.mean(axis=-1)


# The band in which changes of speeds are divided into motion and noise, as shares of the highest frequency.
BAND = 0.25, 0.9
# Rates at which the speeds may have been written before they were interpolated, in units of the highest frequency.
WRITTEN = np.inf, 4.0, 2.8, 2.0, 1.7, 1.4, 1.2, 1.0
PASSES = 20  # of the weighted fit


def _noise(power: Changes) -> Float[np.ndarray, " frequencies"]:
    """The power of the noise in the changes of each direction, by frequency.

    Because of the motors' lag, the changes of true speeds do not grow with frequency: they have a constant part, and a
    part that falls with its square. The changes of white noise grow with frequency, and fall again if the speeds were
    interpolated between packets.
    """
    from scipy.optimize import nnls  # slow to import

    frequency = np.linspace(0, 1, len(power))
    growth = 4 * np.sin(np.pi / 2 * frequency) ** 2
    some = slice(*(round(edge * (len(power) - 1)) for edge in BAND))
    directions, wanted = np.eye(power.shape[1]), np.maximum(power[some].T.ravel(), np.finfo(float).tiny)
    motion = np.hstack([np.kron(directions, growth[some, None] ** order) for order in (0, -1)])

    def fitted(rate: float) -> tuple[float, Float[np.ndarray, " frequencies"]]:
        shape = growth * np.sinc(frequency / rate) ** 4
        columns, model = np.hstack([motion, np.tile(shape[some], len(directions))[:, None]]), wanted
        size = np.zeros(columns.shape[1])
        for _ in range(PASSES):
            size, _ = nnls(columns / model[:, None], wanted / model)
            model = np.maximum(columns @ size, np.finfo(float).tiny)
        return float((np.log(model) + wanted / model).sum()), size[-1] * shape

    return min(map(fitted, WRITTEN), key=lambda each: each[0])[1]


def _filtered(signal: Float[np.ndarray, "samples 4"], kept: Changes) -> Float[np.ndarray, "samples 4"]:
    """The signal times a share at each frequency. It is continued by its mirror image, so that its ends do not jump."""
    mirrored = np.concatenate([signal, signal[::-1]])
    frequencies = np.linspace(0, len(kept) - 1, len(mirrored) // 2 + 1)
    share = np.column_stack([np.interp(frequencies, np.arange(len(kept)), each) for each in kept.T])
    share[0] = 1.0
    return np.fft.irfft(share * np.fft.rfft(mirrored, axis=0), len(mirrored), axis=0)[: len(signal)]


ABOVE = 25.0  # Hz; rotors move a rigid body only below this frequency
TIMES = 5.0  # a line has this many times the power of its surroundings: the median within an octave to both sides
OCTAVE = 2.0
MIN_SPECTRA = 5  # fewest spectra that are averaged


def vibrating_rates(stretches: Sequence[Recording]) -> dict[str, float]:
    """The body rates (`p`, `q`, `r`) whose spectrum shows a line, with its frequency [Hz].

    Rotors that turn at nearly one speed shake a gyro at this frequency, or at its alias for the log's rate. Filtered
    white noise and the motion of a rigid body have no line.

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


Ups = tuple[Float[np.ndarray, "_samples 3"], Float[np.ndarray, "_samples 3"]]
"""The upright direction along the body's axes in a stretch, by two time constants, see `velocity_of`."""

KEEPS = 0.2  # m/s^2; standard deviation of the error's change from rest to flight, as sensors warm up and vibrate
AGREE = 3.0  # standard deviations; if flight and rest differ by more, drag or manoeuvres have misled the flight


def force_level(
    fitted: Recording, ups: Sequence[Ups], rests: Sequence[Float[np.ndarray, "3"]], gravity: float
) -> tuple[float, float] | None:
    """The constant error of the accelerometer along z, and its standard deviation [m/s^2]. `None`: unknown.

    It follows from flight and from rest before take-off.

    **Arguments:**

    - `fitted`, `ups`: a flight, and the upright direction in its stretches, see `velocity_of`.
    - `rests`: the specific force before take-off, where it is known [m/s^2].
    """
    flown = _by_flight(fitted, ups, gravity)
    if not rests:
        return flown
    rest = float(np.mean([np.linalg.norm(force) for force in rests])) - gravity
    if flown is None or abs(flown[0] - rest) > AGREE * math.hypot(flown[1], KEEPS):
        return rest, KEEPS
    weights = np.array([flown[1], KEEPS]) ** -2.0
    return float(weights @ [flown[0], rest] / weights.sum()), float(weights.sum() ** -0.5)


GAINED = 1.0  # m/s; the most velocity that a vehicle gains over a stretch
UNCARRIED = 0.003  # share of the weight that the mean force may miss
UPRIGHT = 0.5  # smallest mean cosine of the tilt


def _by_flight(fitted: Recording, every: Sequence[Ups], gravity: float) -> tuple[float, float] | None:
    """The mean vertical component of the specific force minus gravity, and its standard deviation [m/s^2].

    A vehicle gains little velocity over a stretch, so on average the force carries its weight.
    """
    force = fitted.specific_force
    if not every or force is None or not (known := np.isfinite(force).all(axis=1)).any():
        return None
    ups = [np.concatenate(each)[known] for each in zip(*every, strict=True)]
    other, along = ((force[known] * up).sum(axis=1).mean() for up in ups)
    cosine = ups[-1][:, 2].mean()
    if cosine < UPRIGHT or force[known, 2].mean() < 0:  # the second: the z axis points down
        return None
    drift = GAINED * math.sqrt(len(every)) / (np.count_nonzero(known) * fitted.dt)
    return (along - gravity) / cosine, math.hypot(drift, UNCARRIED * gravity, along - other) / cosine


MANOEUVRE = 0.2  # s; the load of the rotors changes within about this time
SAG = 0.04  # the share of the voltage that a load takes: a coarser voltage does not show it
LEAST_UNSEEN = 0.1  # even a voltage in each row has noise, and is measured before or after the load


def unseen_sag(recording: Recording) -> float:
    """The share of the sag that the logged voltage does not show, 0 to 1, from its rate and its resolution.

    A slowly logged voltage is held or interpolated between its measurements. The measurements are counted by the steps
    of a held voltage, or by the changes of slope of an interpolated one.
    """
    voltage = np.empty(0) if recording.voltage is None else recording.voltage[recording.voltage > 0]
    if voltage.size < 3:
        return 1.0
    steps, usual = np.diff(voltage), float(np.median(voltage))
    changes = np.abs(np.diff(steps)) > 1e-9 * usual
    is_held = np.count_nonzero(steps) <= np.count_nonzero(changes) / 2 + 1
    measured = np.count_nonzero(steps if is_held else changes)
    if not measured:
        return 1.0
    period = float(recording.time[-1] - recording.time[0]) / measured
    resolution = float(np.abs(steps[steps != 0]).min()) / usual
    return float(np.clip(max(1 - math.exp(-period / MANOEUVRE), resolution / SAG), LEAST_UNSEEN, 1.0))
