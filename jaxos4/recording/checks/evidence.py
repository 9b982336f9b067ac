"""`Evidence`: plausible values, stretches in flight and comparisons of channels, which checks share; and `Finding`.

Each fact is computed once, when it is first used.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from ...airframe import GRAVITY, INERTIAS, Airframe
from ...flight import RATES
from ...logs import Recording
from ...logs.sampling import held_regularly
from ...logs.values import Plausible, plausible
from ..motion import PAIRS, in_body_axes
from ..stretches import MARGIN, MIN_STRETCH, Stretch, cut, stretches
from ..windows import richest
from .estimates import Measured, Turns, attitude_turns, tilt_slopes, velocity_slopes
from .response import Response, rotor_response


class Finding(msgspec.Struct, frozen=True):
    """A fault that a log shows.

    - `name`: an identifier for programs.
    - `cause`: the fault of the log. If several causes are possible, it names all of them.
    - `size`: the figure behind it, with its unit.
    - `remedy`: what to do.
    - `quantities`: the quantities that the fault concerns: `Ix`, `Iy`, `Iz`, `thrust`, `motors`, `damping`, `attitude`.
    - `contradicted`: whether the log contradicts these quantities.
    """

    name: str
    cause: str
    size: str
    remedy: str
    quantities: tuple[str, ...]
    contradicted: bool = True

    @property
    def of_attitude_alone(self) -> bool:
        """Whether it concerns the attitude alone, on which the body rates do not depend."""
        return self.quantities == ("attitude",)

    @property
    def counts_for_vehicles(self) -> bool:
        """Whether a vehicle's answer gets an issue from it, a contradiction or a reservation; if not, a note."""
        return bool({*self.quantities} & {*INERTIAS}) or (self.contradicted and not self.of_attitude_alone)

    def __str__(self) -> str:
        return f"{self.cause} ({self.size}); {self.remedy}"

    def to_dict(self) -> dict[str, Any]:
        """Strings, a list and a bool, ready for JSON."""
        return msgspec.to_builtins(self)


# Chance reaches this many standard errors in one of 2,000 comparisons, because the errors are estimated from a dozen
# batches of the flight.
STANDARD_ERRORS = 5.0
# Shares of the errors of predicted rates, and of the vertical force, that the rotors must explain before delays are
# judged. Axes are judged if the sum for roll and pitch reaches the first.
EXPLAINED = 0.02, 0.03
MOVES = 0.05  # rad/s; standard deviation of the rates of a vehicle that moves
REST = 0.25  # s; a vehicle at rest is still for this long
STILL = 0.1  # the largest standard deviation at rest, of force [gravity] and of rates [rad/s]
HELD = 0.015  # s; motors may keep their value for half of the shortest lag of rotors


class Evidence:
    """The facts of one recording that its checks share. `airframe`: `None` if it is not known.

    **Arguments:** as in `self_checks`. `seconds`: the longest duration that is examined [s], see `richest`.

    `turns`, `velocity` and `tilt` are the comparisons of channels in `jaxos4.recording.checks.estimates`.
    """

    def __init__(self, recording: Recording, airframe: Airframe | None, *, seconds: float = math.inf):
        self.logged, self.airframe, self.seconds = recording, airframe, seconds

    @functools.cached_property
    def plausible(self) -> Plausible:
        """The recording without faulty values, along the sensors' axes, and these values."""
        return plausible(self.logged)

    @functools.cached_property
    def recording(self) -> Recording:
        """The recording without faulty values, along the body's axes."""
        return in_body_axes(self.plausible.recording, self.airframe)

    @functools.cached_property
    def all_stretches(self) -> tuple[Stretch, ...]:
        """Every stretch of the flight: usable ones, and others with the reason."""
        return stretches(self.recording, self.airframe)

    @property
    def usable(self) -> list[Stretch]:
        """The stretches of the flight that can be used."""
        return [each for each in self.all_stretches if not each.reason]

    def richest(self, parts: Sequence[Stretch]) -> list[Stretch]:
        """The most informative pieces of some parts, of at most `seconds` together."""
        torques = PAIRS if self.airframe is None else np.asarray(self.airframe.mixer, dtype=float)[:3]
        return richest(self.recording, parts, torques, self.seconds)

    @functools.cached_property
    def stretches(self) -> tuple[Recording, ...]:
        """The usable stretches of the flight; only the most informative pieces if it is longer than `seconds`."""
        recording = self.recording
        if recording.stretch is not None:  # concatenated flights are usable
            edges = np.flatnonzero(np.diff(recording.stretch)) + 1
            ends = zip([0, *edges], [*edges, recording.time.size], strict=True)
            return tuple(recording.rows(slice(int(begin), int(end))) for begin, end in ends)
        parts = [each for each in self.usable if each.length >= MIN_STRETCH]
        return tuple(cut(recording, each) for each in self.richest(parts))

    @functools.cached_property
    def airborne(self) -> tuple[Recording, ...]:
        """The usable stretches; without any, the whole recording if its rotors carry the vehicle and it moves.

        A vehicle whose accelerometer is turned seems to lie on the ground.
        """
        whole = self.recording
        thrust = self.thrust(whole)
        if self.stretches or self.airframe is None or thrust is None:
            return self.stretches
        carried = float(np.median(thrust) / self.airframe.gravity)
        rates = whole.states[:, RATES]
        moves = max((np.std(x[np.isfinite(x)]) for x in rates.T if np.isfinite(x).any()), default=0.0)
        return (whole,) if moves > MOVES and 0.5 < carried < 2 else ()

    def thrust(self, flown: Recording) -> Float[np.ndarray, " samples"] | None:
        """The thrust per mass that the airframe gives to the rotors [m/s^2]. `None`: the airframe does not know it."""
        if self.airframe is None or (flown.commanded and not self.airframe.has_full_scale):
            return None
        return float(self.airframe.thrust_coefficient / self.airframe.mass) * np.square(flown.omega).sum(axis=1)

    @functools.cached_property
    def force(self) -> Float[np.ndarray, "samples 3"]:
        """The specific force in flight [m/s^2]: measured samples only."""
        every = [each.specific_force for each in self.airborne if each.specific_force is not None]
        force = np.concatenate(every) if every else np.empty((0, 3))
        return force[np.isfinite(force).all(axis=1)]

    @functools.cached_property
    def rest(self) -> Float[np.ndarray, "3"] | None:
        """The specific force at rest before the first stretch in flight [m/s^2]. `None`: never at rest, or moved."""
        recording = self.recording
        begin = min((each.begin for each in self.usable), default=0.0) if self.stretches else 0.0
        before = np.count_nonzero(recording.time < begin - MARGIN)
        length = max(round(REST / recording.dt), 4)
        if recording.specific_force is None or before < 4 * length:
            return None
        sensed = np.hstack([recording.specific_force[:before], GRAVITY * recording.states[:before, RATES]])
        blocks = sensed[before % length :].reshape(-1, length, 6)
        still = (blocks.std(axis=1) < STILL * GRAVITY).all(axis=1)  # False for NaN
        means = blocks[still, :, :3].mean(axis=1)
        if len(means) < 4:
            return None
        alike = np.abs(means - np.median(means, axis=0)).max(axis=1) < STILL * GRAVITY
        return means[alike].mean(axis=0) if alike.mean() > 0.75 else None  # otherwise it was in a hand

    turns = functools.cached_property[Turns | None](lambda self: attitude_turns(self.stretches))
    velocity = functools.cached_property[Measured | None](lambda self: velocity_slopes(self.stretches))
    tilt = functools.cached_property[Measured | None](lambda self: tilt_slopes(self.stretches))

    @functools.cached_property
    def response(self) -> Response | None:
        """Gyro and accelerometer against the rotors. `None`: unknown, for example if motors were logged too rarely."""
        if self.airframe is None or not self.stretches or self.motor_step > HELD:
            return None
        return rotor_response(self.stretches, self.airframe)

    @functools.cached_property
    def motor_step(self) -> float:
        """The time between new motor values in flight [s]; 0 if they change in each sample, or at no fixed rate."""
        steps = [0.0]
        for each in self.stretches:
            changes = each.time[1:][(np.diff(each.omega, axis=0) != 0).any(axis=1)]
            if held_regularly(changes):
                steps.append(float(np.median(np.diff(changes))))
        return max(steps) if max(steps) > 1.5 * self.logged.dt else 0.0
