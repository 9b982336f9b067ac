"""Inspection of a log: its stretches in flight, their excitation, and a draft of the airframe's file."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from .._files import templates
from ..airframe import GRAVITY, GUESS, Airframe
from ..errors import printable
from ..logs import Recording
from .checks import Evidence, Finding, findings, opposite_yaw
from .motion import Excitation, excitation, opposite_axes, refused_note, rotor_signs
from .prepared import finest
from .stretches import cut, stretches, unusable_note
from .windows import fair_share

ASSUMED_FULL_SCALE = 1000.0
"""Commands have no unit: a command of 1 counts as this rotor speed [rad/s], if nothing better is known."""


class Channel(msgspec.Struct, frozen=True):
    """A measured channel: samples a second, the longest time between samples [s], and the range in SI units."""

    rate: float
    longest_gap: float
    least: float
    most: float


class InspectedStretch(msgspec.Struct, frozen=True):
    """A stretch of the log [s]: whether it can be used, why not, and the excitation by axis if it can."""

    begin: float
    end: float
    usable: bool
    reason: str
    excitation: dict[str, Excitation]


class Inspection(msgspec.Struct, frozen=True):
    """The inspection of one log.

    - `log`, `format`: the file, and the `name` of its `LogFormat`.
    - `samples`, `begin`, `end`, `sample_time`: the uniform grid of the flight [s].
    - `channels`: by name. `rotor1` to `rotor4` are speeds [rad/s], or commands as a share of full scale. In JSON:
      `measured`.
    - `refusals`: why no vehicle can be identified, and what to do, most important first. In JSON: `findings`.
    - `findings`: faults that the log shows, see `jaxos4.recording.checks`. In JSON: `checks`.
    - `notes`: remarks from reading the log.
    - `stretches`: in order of time. In JSON: `parts`.
    """

    log: str
    format: str
    samples: int
    begin: float
    end: float
    sample_time: float
    channels: dict[str, Channel] = msgspec.field(name="measured")
    refusals: tuple[str, ...] = msgspec.field(name="findings")
    findings: tuple[Finding, ...] = msgspec.field(name="checks")
    notes: tuple[str, ...]
    stretches: tuple[InspectedStretch, ...] = msgspec.field(name="parts")

    def to_dict(self) -> dict[str, Any]:
        """Dictionaries, lists, numbers and strings, ready for JSON."""
        return msgspec.to_builtins(self)


def inspect_log(recording: Recording, airframe: Airframe | None = None) -> Inspection:
    """Describe a log that was read with this airframe and `full_scale=1.0`. Torques are unknown without an airframe."""
    seconds = fair_share([recording], finest(recording.dt, commands=recording.dt * recording.commanded))
    evidence, inspected = Evidence(recording, airframe, seconds=seconds), []
    for stretch in evidence.all_stretches:
        excited = {} if stretch.reason else excitation(cut(evidence.recording, stretch), airframe)
        inspected.append(InspectedStretch(stretch.begin, stretch.end, not stretch.reason, stretch.reason, excited))
    nothing = "" if evidence.usable else f"{unusable_note(evidence.all_stretches)}; give the log of a flight"
    opposite = {} if airframe is None else opposite_axes(evidence.stretches, airframe)
    refusals = tuple(filter(None, (nothing, recording.facts.too_slow_note, refused_note(opposite))))
    return Inspection(
        log=recording.name,
        format=recording.facts.format.name if recording.facts.format else "",
        samples=recording.time.size,
        begin=float(recording.time[0]),
        end=float(recording.time[-1]),
        sample_time=recording.dt,
        channels=_channels(recording),
        refusals=refusals,
        findings=tuple(filter(None, (*findings(evidence), opposite_yaw(opposite)))),
        notes=recording.notes,
        stretches=tuple(inspected),
    )


def _channels(recording: Recording) -> dict[str, Channel]:
    time, motors = recording.time, recording.facts.motors
    columns = recording.columns(inputs=False)
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


def airframe_draft(recording: Recording) -> tuple[str, tuple[str, ...]]:
    """Draft an airframe's file from a log: spins, hover speed, and the rotors' positions if the log has them.

    **Arguments:** `recording`: read without an airframe, and with `full_scale=1.0`.

    **Returns:** the text, with comments in place of values that must be weighed or measured, and the missing keys.
    """
    facts, full = recording.facts, ASSUMED_FULL_SCALE if recording.commanded else 1.0
    flown = [cut(recording, each) for each in stretches(recording) if not each.reason]
    signs, hover = None if facts.too_slow_note else rotor_signs(flown), _hover(flown)
    forward, left, spins = signs or ((), (), None)
    spins = facts.rotor_spins or spins
    text = (
        templates("jaxos4.recording", printable)
        .get_template("airframe.toml.j2")
        .render(
            name=Path(recording.name).name,
            facts=facts,
            corners=list(zip(forward, left, strict=True)),
            spins=None if spins is None else [int(spin) for spin in spins],
            hover=hover,
            full=full,
            seconds=sum(float(np.ptp(each.time)) for each in flown),
            commanded=recording.commanded,
            guess=GUESS,
            short=lambda value: np.vectorize(lambda x: float(f"{x:.4g}"))(value).tolist(),
        )
    )
    known = {"rotor_positions": facts.rotor_positions, "rotor_spins": spins, "hover_speed": hover}
    return text, ("mass", *(key for key, value in known.items() if value is None))


def _hover(flown: Sequence[Recording]) -> tuple[float, bool] | None:
    """The rotor speed that carries the weight, in the unit of the flight, and whether an accelerometer shows it.

    Without an accelerometer, or if its median is not half to twice gravity, the median thrust in flight counts as the
    weight.
    """
    if not flown:
        return None
    squares = np.concatenate([(each.omega**2).mean(axis=1) for each in flown])
    force = [each.specific_force[:, 2] for each in flown if each.specific_force is not None]
    vertical = np.concatenate(force) if len(force) == len(flown) else np.full(1, np.nan)
    share = float(np.median(vertical[np.isfinite(vertical)])) / GRAVITY if np.isfinite(vertical).any() else np.nan
    felt = bool(0.5 < share < 2)
    return float(np.sqrt(np.median(squares) / (share if felt else 1.0))), felt
