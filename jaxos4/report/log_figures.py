"""The figures of a log's page: its signals, how much the motors are used, and vibration."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from ..airframe import MOTIONS
from ..flight import ANGLE_NAMES, FORCE_NAMES, RATE_NAMES, RATES, filled
from ..logs import Recording
from ..recording.inspection import Inspection
from . import timeline
from .panels import BOUND_DASHES, EVERYWHERE, Band, Figure, Line, Panel, Scale, style

_SAMPLES = 5000  # of each signal at most; a page then has less than 600 kB
_SEGMENT = 1.0  # s; spectra are means of segments of this length
_SLOWEST = 1.0  # Hz; the lowest frequency of a spectrum
_BINS = 60  # of the motors' speeds
_MOTOR = "motor [rad/s]"
# The columns in each panel of signals, and the names of those that are not called as in a log.
_SIGNALS: dict[str, tuple[str, ...]] = {
    "rate [rad/s]": RATE_NAMES,
    _MOTOR: ("1", "2", "3", "4"),
    "force [m/s²]": FORCE_NAMES,
    "attitude [rad]": ANGLE_NAMES,
    "velocity [m/s]": ("vx", "vy", "vz"),
    "position [m]": ("x", "y", "z"),
    "battery [V]": ("voltage",),
}
_CALLED = dict(zip(ANGLE_NAMES, MOTIONS, strict=True)) | {"voltage": "battery"}


def is_share(recording: Recording) -> bool:
    """Whether the motors are commands as a share of full scale."""
    return recording.commanded and float(np.nanmax(recording.omega, initial=0.0)) <= 1.0


def logged(recording: Recording, found: Inspection) -> tuple[str, int]:
    """All signals of a log for the time axis, grey where it is not usable, and the `thinned` samples of a block."""
    columns = recording.columns() | {f"{i + 1}": speeds for i, speeds in enumerate(recording.omega.T)}
    panels, time, block = [], recording.time, 1
    for title, names in _SIGNALS.items():
        lines = []
        for i, name in enumerate(names):
            if name in columns and np.isfinite(columns[name]).any():
                values = bridged(recording.time, columns[name])[:, None]
                time, values, block = timeline.thinned(recording.time, values, _SAMPLES)
                lines.append(timeline.line(_CALLED.get(name, name), values[:, 0], style(i)))
        if lines:
            panels.append(timeline.panel("command" if title == _MOTOR and is_share(recording) else title, lines))
    axis = timeline.TimeAxis.of(recording.time[[0, -1]], np.zeros(2, int), longest=np.inf)
    begin = recording.time[0]
    shaded = [(part.begin - begin, part.end - begin) for part in found.stretches if not part.usable]
    return timeline.signals(axis, [timeline.view("", time - begin, panels)], shaded=shaded), block


def bridged(
    time: Float[np.ndarray, " samples"], values: Float[np.ndarray, " samples"]
) -> Float[np.ndarray, " samples"]:
    """A signal with straight lines between its samples, unless they are apart by more than three usual steps."""
    at = np.flatnonzero(np.isfinite(values))
    if at.size < 2 or at.size == values.size:
        return values
    apart = np.diff(time[at])
    place = np.clip(np.searchsorted(time[at], time, side="right") - 1, 0, at.size - 2)
    near = (apart[place] <= 3 * np.median(apart)) & (time >= time[at[0]]) & (time <= time[at[-1]])
    return np.where(near | np.isfinite(values), np.interp(time, time[at], values[at]), np.nan)


def motors(flown: Sequence[Recording], full: float) -> Figure:
    """The share of the time that each motor spends at each speed; dashed: full speed."""
    omega = np.concatenate([each.omega for each in flown])
    largest = float(omega.max())
    top = full if np.isfinite(full) and full < 3 * largest else largest
    edges = np.linspace(0.0, max(top, largest, 1e-9), _BINS + 1)
    shares = [100 * np.histogram(column, edges)[0] / len(omega) for column in omega.T]
    x = Scale(ends=(0.0, 1.02 * float(edges[-1])), label="command" if full == 1.0 else "speed [rad/s]")
    y, panels = Scale(ends=(0.0, 1.05 * max(float(each.max()) for each in shares))), []
    for i, share in enumerate(shares):
        at, steps, color = np.repeat(edges, 2)[1:-1], np.repeat(share, 2), style(i).color
        marks = [Band(at, np.zeros(at.size), steps, color), Line(at, steps, color, 1.4)]
        if top == full:
            marks.append(Line((full, full), EVERYWHERE, dash=BOUND_DASHES[2], name="full speed"))
        panels.append(Panel(f"motor {i + 1}: time [%]", marks, x, y, 270, 190))
    return Figure("motors", panels, columns=4)


def spectra(flown: Sequence[Recording], band: tuple[float, float] | None) -> Figure | None:
    """Amplitude spectral densities of gyro and accelerometer; band: how often the rotors turn."""
    gyro = (each.states[:, RATES] for each in flown)
    force = (each.specific_force for each in flown if each.specific_force is not None)
    rotors = [] if band is None else [Band(band, 2 * [-np.inf], 2 * [np.inf], opacity=0.25, name="rotors turn")]
    panels = []
    for title, parts in (("gyro [rad/s/√Hz]", gyro), ("accelerometer [m/s²/√Hz]", force)):
        frequency, density = amplitude_density(parts, flown[0].dt)
        if not np.isfinite(density).any():
            continue
        lines = [
            Line(frequency, column, style(k).color, 1.4, BOUND_DASHES[dash], name=name)
            for k, (column, dash, name) in enumerate(zip(density.T, (0, 2, 1), "xyz", strict=True))
        ]
        x = Scale("log", (_SLOWEST, float(frequency[-1])), label="frequency [Hz]")
        panels.append(Panel(title, [*rotors, *lines], x, Scale("log"), 430, 260))
    return Figure("spectra", panels, columns=2) if panels else None


def amplitude_density(
    parts: Iterable[Float[np.ndarray, "_ channels"]], dt: float
) -> tuple[Float[np.ndarray, " frequencies"], Float[np.ndarray, "frequencies channels"]]:
    """Frequencies [Hz] and the amplitude spectral density of signals, by Welch's means of overlapping segments.

    A channel has the mean over the segments in which it was measured, or NaN. Reference: Welch 1967, IEEE
    Trans. Audio Electroacoustics 15.
    """
    size = max(round(_SEGMENT / dt), 8)
    taper, frequency = np.hanning(size)[:, None], np.fft.rfftfreq(size, dt)
    total = measured = np.zeros((frequency.size, 1))
    for part in parts:
        total, measured = (np.broadcast_to(each, (frequency.size, part.shape[1])).copy() for each in (total, measured))
        for begin in range(0, len(part) - size + 1, size // 2):
            piece = filled(part[begin : begin + size])
            power = np.abs(np.fft.rfft(taper * (piece - piece.mean(axis=0)), axis=0)) ** 2
            measured += np.isfinite(power)
            total += np.nan_to_num(power)
    mean = np.where(measured, total / np.maximum(measured, 1), np.nan)
    density, kept = 2 * dt * mean / np.square(taper).sum(), frequency >= _SLOWEST
    return frequency[kept], np.sqrt(density[kept])
