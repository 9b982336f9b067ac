"""Inspection of a log: its contents, the stretches in flight, their excitation, and the identifiable parameters."""

import math
from typing import Any, SupportsFloat

import msgspec
import numpy as np

from ..airframe import Airframe
from ..analysis.identifiability import identifiability
from ..bracket import Bracket
from ..flight import CHANNEL_NAMES
from ..logs import log_format
from ..models.os4 import CorrectedOS4
from ..noise import SENSOR_SIGMA
from ..shooting import ShootingProblem
from .motion import RATE_COLUMNS, WEAK, excitation, opposite_axes, refused_note, yaw_doubt
from .pieces import cut
from .reading import Recording
from .usable import Stretch, nothing_usable, stretches

# The identifiability is computed from this much of a stretch [s], in windows of this length [s].
_LONGEST, _WINDOW = 20.0, 0.5


class Channel(msgspec.Struct, frozen=True):
    """A measured channel: samples a second, the longest time between samples [s], and the range in SI units."""

    rate: float
    longest_gap: float
    least: float
    most: float


class AxisExcitation(msgspec.Struct, frozen=True):
    """Excitation about one axis, see `jaxos4.recording.Excitation`; `None`: not known."""

    torque: float | None
    rate: float | None
    noise: float | None
    verdict: str


class Part(msgspec.Struct, frozen=True):
    """A stretch of the log [s]: whether it can be used, why not, and the excitation by axis if it can."""

    begin: float
    end: float
    usable: bool
    reason: str
    excitation: dict[str, AxisExcitation]


class IdentifiableParameter(msgspec.Struct, frozen=True):
    """Whether one alpha is identifiable, and why not."""

    identifiable: bool
    note: str


class IdentifiableParameters(msgspec.Struct, frozen=True):
    """Which of alpha_1..8 are identifiable from the body rates of one stretch [s], at the gyro's noise.

    How well depends on what the vehicle does beside the model, which only a fit shows.
    """

    begin: float
    end: float
    parameters: dict[str, IdentifiableParameter]


class Inspection(msgspec.Struct, frozen=True):
    """The inspection of one log.

    - `log`, `format`: the file, and "CSV", "ULog", "blackbox" or "Crazyflie".
    - `samples`, `begin`, `end`, `sample_time`: the uniform grid of the flight [s].
    - `measured`: by channel. `rotor1` to `rotor4` are speeds [rad/s], or commands as a share of full scale.
    - `findings`: why no vehicle can be identified from the log, and what to do, most important first.
    - `notes`: remarks of the reader.
    - `parts`: the stretches in order of time.
    - `identifiable`: `None` without an airframe, without p, q and r, or if a finding excludes it.
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
    identifiable: IdentifiableParameters | None

    def to_dict(self) -> dict[str, Any]:
        """Dictionaries, lists, numbers and strings, ready for JSON."""
        return msgspec.to_builtins(self)


def inspect_log(recording: Recording, airframe: Airframe | None = None) -> Inspection:
    """Describe a log. Without an airframe, torques and parameters are unknown.

    **Arguments:**

    - `recording`: of a file, read with the same `airframe`, and with `full_scale=1.0`.
    """
    facts = recording.facts
    found = stretches(recording, airframe, landed=facts.landed)
    longest = max((part for part in found if not part.reason), key=lambda part: part.length, default=None)
    rates_measured = not np.isnan(recording.states[:, RATE_COLUMNS]).all(axis=0).any()
    parts = tuple(_part(recording, stretch, airframe) for stretch in found)
    nothing = "" if longest is not None else f"{nothing_usable(found)}; give the log of a flight"
    usable = [cut(recording, part) for part in found if not part.reason]
    opposite = {} if airframe is None else opposite_axes(usable, airframe)
    doubt = yaw_doubt(opposite)
    findings = tuple(filter(None, (nothing, facts.too_slow, _too_little(parts), refused_note(opposite))))
    identifiable = None
    if longest is not None and not facts.too_slow and airframe is not None and rates_measured:
        identifiable = _identifiable(recording, longest, airframe)
    return Inspection(
        log=recording.name,
        format=log_format(recording.name).name,
        samples=recording.time.size,
        begin=float(recording.time[0]),
        end=float(recording.time[-1]),
        sample_time=recording.dt,
        measured=_measured(recording),
        findings=findings,
        notes=(*recording.notes, *(["; ".join(doubt)] if doubt else [])),
        parts=parts,
        identifiable=identifiable,
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


def _too_little(parts: tuple[Part, ...]) -> str:
    """A finding, if the vehicle hardly turns in its usable parts."""
    usable = [part for part in parts if part.usable]
    rates = [axis.rate for part in usable for axis in part.excitation.values() if axis.rate is not None]
    if not rates or max(rates) >= WEAK:
        return ""
    seconds = sum(part.end - part.begin for part in usable)
    return (
        f"too little flight: in the {seconds:.1f} s that can be used, the vehicle turns with at most {max(rates):.2g} "
        "rad/s (standard deviation); fly rolls, pitches and turns"
    )


def _part(recording: Recording, stretch: Stretch, airframe: Airframe | None) -> Part:
    axes = () if stretch.reason else excitation(cut(recording, stretch), airframe)
    excited = {a.axis: AxisExcitation(_finite(a.torque), _finite(a.rate), _finite(a.noise), a.verdict) for a in axes}
    return Part(stretch.begin, stretch.end, not stretch.reason, stretch.reason, excited)


def _identifiable(recording: Recording, stretch: Stretch, airframe: Airframe) -> IdentifiableParameters:
    stretch = Stretch(stretch.begin, min(stretch.end, stretch.begin + _LONGEST))
    part, model = cut(recording, stretch), CorrectedOS4(airframe)
    sigma = np.asarray(SENSOR_SIGMA, dtype=float).copy()
    for axis, column in zip(excitation(part), RATE_COLUMNS, strict=True):
        sigma[column] = max(float(np.nan_to_num(axis.noise)), sigma[column])
    windows = min(max(round(stretch.length / _WINDOW), 1), part.time.size // 2)
    problem = ShootingProblem(model, part.flight, sigma=sigma, channels="rates", windows=windows)
    known = identifiability(problem, Bracket.default(model), model.alpha)
    notes = known.notes(model.parameter_names)
    parameters = {
        name: IdentifiableParameter(name not in notes and math.isfinite(known.std[i]), notes.get(name, ""))
        for i, name in enumerate(model.parameter_names)
    }
    return IdentifiableParameters(stretch.begin, stretch.end, parameters)


def _finite(x: SupportsFloat) -> float | None:
    return float(x) if math.isfinite(float(x)) else None
