"""Inspection of a log: its contents, the stretches in flight, and their excitation."""

from typing import Any

import msgspec
import numpy as np

from ..airframe import Airframe
from ..flight import CHANNEL_NAMES
from ..logs import log_format
from .motion import Excitation, excitation, motor_clock_note, opposite_axes, refused_note, yaw_doubt
from .pieces import cut
from .reading import Recording
from .usable import Stretch, nothing_usable, stretches


class Channel(msgspec.Struct, frozen=True):
    """A measured channel: samples a second, the longest time between samples [s], and the range in SI units."""

    rate: float
    longest_gap: float
    least: float
    most: float


class Part(msgspec.Struct, frozen=True):
    """A stretch of the log [s]: whether it can be used, why not, and the excitation by axis if it can."""

    begin: float
    end: float
    usable: bool
    reason: str
    excitation: dict[str, Excitation]


class Inspection(msgspec.Struct, frozen=True):
    """The inspection of one log.

    - `log`, `format`: the file, and "CSV", "ULog", "blackbox" or "Crazyflie".
    - `samples`, `begin`, `end`, `sample_time`: the uniform grid of the flight [s].
    - `measured`: by channel. `rotor1` to `rotor4` are speeds [rad/s], or commands as a share of full scale.
    - `findings`: why no vehicle can be identified from the log, and what to do, most important first.
    - `notes`: remarks of the reader.
    - `parts`: the stretches in order of time.
    """

    log: str
    format: str
    samples: int
    begin: float
    end: float
    sample_time: float
    measured: dict[str, Channel]
    findings: tuple[str, ...]
    notes: tuple[str, ...]
    parts: tuple[Part, ...]

    def to_dict(self) -> dict[str, Any]:
        """Dictionaries, lists, numbers and strings, ready for JSON."""
        return msgspec.to_builtins(self)


def inspect_log(recording: Recording, airframe: Airframe | None = None) -> Inspection:
    """Describe a log. Without an airframe, torques are unknown.

    **Arguments:**

    - `recording`: of a file, read with the same `airframe`, and with `full_scale=1.0`.
    """
    found, usable, parts = stretches(recording, airframe), [], []
    for begin, end, reason in found:
        if not reason:
            usable.append(cut(recording, Stretch(begin, end)))
        parts.append(Part(begin, end, not reason, reason, {} if reason else excitation(usable[-1], airframe)))
    nothing = "" if usable else f"{nothing_usable(found)}; give the log of a flight"
    opposite = {} if airframe is None else opposite_axes(usable, airframe)
    doubt = yaw_doubt(opposite)
    clock = "" if airframe is None else motor_clock_note(usable, airframe)
    findings = tuple(filter(None, (nothing, recording.facts.too_slow, refused_note(opposite))))
    return Inspection(
        log=recording.name,
        format=log_format(recording.name).name,
        samples=recording.time.size,
        begin=float(recording.time[0]),
        end=float(recording.time[-1]),
        sample_time=recording.dt,
        measured=_measured(recording),
        findings=findings,
        notes=(*recording.notes, *filter(None, ("; ".join(doubt or ()), clock))),
        parts=tuple(parts),
    )


def _measured(recording: Recording) -> dict[str, Channel]:
    time, motors = recording.time, recording.facts.motors
    columns = dict(zip(CHANNEL_NAMES, recording.channels.T, strict=True))
    columns |= {f"rotor{i + 1}": speed for i, speed in enumerate(recording.omega.T)}
    channels = {}
    for name, values in columns.items():
        at = np.flatnonzero(np.isfinite(values))
        if at.size:
            rate = at.size / float(time[-1] - time[0])
            if name.startswith("rotor") and motors is not None:
                rate = motors.rate  # each sample of the flight has a speed, measured or held
            gaps = np.diff(np.concatenate([time[:1], time[at], time[-1:]]))
            channels[name] = Channel(rate, float(gaps.max()), float(values[at].min()), float(values[at].max()))
    return channels
