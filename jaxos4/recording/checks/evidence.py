"""The evidence of a log: its plausible values, its stretches in flight, how its channels agree; and a finding of it.

Each number of the evidence is computed once, when it is first used.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from ...airframe import GRAVITY, Airframe
from ...flight import RATES
from ...logs import Recording
from ...logs.sampling import held_regularly
from ...logs.values import Plausible, plausible
from ..motion import in_body_axes, torques_of
from ..richest import richest
from ..stretches import RULES, Stretch, cut, stretches
from .estimates import Measured, Turns, attitude_turns, tilt_slopes, velocity_slopes
from .response import Response, rotor_response


class Finding(msgspec.Struct, frozen=True):
    """A fault that a log shows.

    - `name`: for programs.
    - `cause`: what is wrong with the log. If several causes fit, all of them.
    - `size`: the figure behind it, with its unit.
    - `remedy`: what to do.
    - `quantities`: what the fault concerns: `Ix`, `Iy`, `Iz`, `thrust`, `motors`, `damping`, `attitude`.
    - `contradicted`: the log contradicts these quantities. Otherwise the finding is to be noted only.
    """

    name: str
    cause: str
    size: str
    remedy: str
    quantities: tuple[str, ...]
    contradicted: bool

    def __str__(self) -> str:
        return f"{self.cause} ({self.size}); {self.remedy}"

    def to_dict(self) -> dict[str, Any]:
        """Strings, a list and a bool, ready for JSON."""
        return msgspec.to_builtins(self)


class Limits(msgspec.Struct, frozen=True):
    """Limits of the checks. A difference is a finding if it exceeds chance, and if it is large enough to matter.

    - `standard_errors`: chance reaches this many of its standard errors in one of 2,000 comparisons, because these
      errors are those of a dozen batches of the flight.
    - `kinematics`: the same for the comparison of two causes, both of which are named if neither is clear.
    - `scale`: of attitude against gyro, relative. Inertias are wrong by the scale of the gyro.
    - `angle`: of a sensor about the vertical axis [rad]. 20 degrees change inertias by 8 %, 8 degrees by 1 %.
    - `tilt`: of the accelerometer against the thrust [rad]. Its errors and steady wind reach half of this.
    - `delay`: between two sensors [s] that is noted. Damping and inflow make errors of up to 8 ms.
    - `late`: between two sensors [s] that contradicts. 20 ms change inertias by 10 %. The filter of an accelerometer
      can be 10 ms later than that of the gyro.
    - `late_attitude`: of the attitude after the gyro [s]. Filters and cameras are late by up to 20 ms.
    - `velocity`: of the horizontal acceleration by the velocity against that by force and attitude, relative.
      Velocities that are averaged while the vehicle yaws differ by 5 %.
    - `gravity`: of the mean specific force, relative to gravity. It is up to 10 % larger in brisk flight.
    - `at_rest`: the same before take-off; accelerometers err by up to 3 %.
    - `rest`, `still`: a vehicle at rest has constant force and rates for this time [s], to this standard deviation
      [gravity, rad/s].
    - `thrust`, `commanded_thrust`: of the airframe's thrust, relative, by measured speeds and by commands. The fit
      measures the thrust by the accelerometer: errors of 20 % are harmless.
    - `vehicles`, `commanded_vehicles`: of the thrust between two logs of one vehicle, relative, by measured speeds and
      by commands. A battery that empties changes the thrust of a command by up to 30 %.
    - `clipped`: the share of clipped values above which a channel cannot be used.
    - `motions`: of roll and pitch, independent ones. Fewer do not show how large the noise is: the standard deviation
      of a mean square is 37 % for 15. Two seconds of flight have 5 to 12, four have 7 to 21.
    - `held`: the time for which motors keep their value [s]: half of the shortest lag of rotors.
    - `instants`: between rotor speeds at instants [s]. 16 ms make Ix 4 % too small and Iz 9 % too large for rotors with
      a lag of 25 ms, 8 ms less than 1 and 5 %.
    - `slow_gyro`: the longest time between samples of a gyro whose integral is compared with the attitude [s]: 50 Hz.
    - `follows`: the share of the attitude's turns that a gyro explains before their scale and delay count, and
      `unrelated`: with less, a gyro that moves is of another flight than the attitude.
    - `vague`, `same_angle`: of a rotation about the vertical axis by the rotors [rad]. A larger error is that of
      another airframe. A rotation turns roll and pitch by the same angle, up to the second.
    - `along_earth`: slope of the horizontal force on the tilt: 1 along the earth's axes, 0 or less along the body's.
    - `steady`: in a hand or in rolls, the mean vector of the force is shorter than this share of its mean size.
    - `moves`: standard deviation of the rates of a vehicle that moves [rad/s]. `thrust_moves`: of its thrust, relative.
    - `explained`: the shares of the errors of predicted rates, and of the vertical force, that the rotors explain
      before their delays count. The first one counts for the sum of roll and pitch before axes are judged.
    - `filters`, `damping`, `lags`: standard deviations of delays that are no error of a clock [s]: filters, damping
      that varies, and the lag and delay of rotors that follow commands, about `usual_lag`.
    - `answered`: the delay that a gyro seems to have if the rotors do nothing but answer gusts [s].
    - `likelier`: difference of chi^2: a clock 20 times less likely to be wrong than another is not named.
    """

    standard_errors: float = 5.0
    kinematics: float = 2.5
    scale: float = 0.1
    angle: float = 0.14
    tilt: float = 0.26
    delay: float = 0.01
    late: float = 0.015
    late_attitude: float = 0.025
    velocity: float = 0.15
    gravity: float = 0.3
    at_rest: float = 0.05
    rest: float = 0.25
    still: float = 0.1
    thrust: float = 0.35
    commanded_thrust: float = 1.0
    vehicles: float = 0.1
    commanded_vehicles: float = 0.4
    clipped: float = 0.1
    motions: float = 15.0
    held: float = 0.015
    instants: float = 0.0105
    slow_gyro: float = 0.0202
    follows: float = 0.2
    unrelated: float = 0.1
    vague: float = 0.2
    same_angle: float = 0.17
    along_earth: float = 0.6
    steady: float = 0.9
    moves: float = 0.05
    thrust_moves: float = 0.01
    explained: tuple[float, float] = (0.02, 0.03)
    filters: float = 0.003
    damping: float = 0.004
    lags: float = 0.025
    usual_lag: float = 0.05
    answered: float = 0.014
    likelier: float = 6.0


LIMITS = Limits()


class Evidence:
    """The facts that the checks of one recording share. `airframe`: `None` if it is not known.

    **Arguments:** of `self_checks`. `seconds`: how much of the flight is looked at [s], see `richest`.
    """

    def __init__(
        self, recording: Recording, airframe: Airframe | None, limits: Limits = LIMITS, *, seconds: float = math.inf
    ):
        self.logged, self.airframe, self.limits, self.seconds = recording, airframe, limits, seconds

    @functools.cached_property
    def plausible(self) -> Plausible:
        """The recording without faulty values, along the body's axes. Clipping is found along those of the sensors."""
        found = plausible(self.logged)
        return found._replace(recording=in_body_axes(found.recording, self.airframe))

    @functools.cached_property
    def every(self) -> tuple[Stretch, ...]:
        """Every stretch of the flight: usable ones, and others with the reason."""
        return stretches(self.plausible.recording, self.airframe)

    @property
    def usable(self) -> list[Stretch]:
        """The stretches of the flight that can be used."""
        return [each for each in self.every if not each.reason]

    def richest(self, parts: Sequence[Stretch]) -> list[Stretch]:
        """The pieces of some parts that tell the most, of at most `seconds`."""
        return richest(self.plausible.recording, parts, torques_of(self.airframe), self.seconds)

    @functools.cached_property
    def stretches(self) -> tuple[Recording, ...]:
        """The usable stretches of the flight; those that tell the most, if it is longer than `seconds`."""
        recording = self.plausible.recording
        if recording.stretch is not None:  # joined flights are usable
            edges = np.flatnonzero(np.diff(recording.stretch)) + 1
            ends = zip([0, *edges], [*edges, recording.time.size], strict=True)
            return tuple(recording.rows(slice(int(begin), int(end))) for begin, end in ends)
        parts = [each for each in self.usable if each.length >= RULES.shortest]
        return tuple(cut(recording, each) for each in self.richest(parts))

    @functools.cached_property
    def airborne(self) -> tuple[Recording, ...]:
        """The usable stretches; without any, the whole recording if its rotors carry the vehicle and it moves.

        A vehicle whose accelerometer is turned seems to lie on the ground.
        """
        whole = self.plausible.recording
        thrust = self.thrust(whole)
        if self.stretches or self.airframe is None or thrust is None:
            return self.stretches
        carried = float(np.median(thrust) / self.airframe.gravity)
        rates = whole.states[:, RATES]
        moves = max((np.std(x[np.isfinite(x)]) for x in rates.T if np.isfinite(x).any()), default=0.0)
        return (whole,) if moves > self.limits.moves and 0.5 < carried < 2 else ()

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
        recording = self.plausible.recording
        begin = min((each.begin for each in self.usable), default=0.0) if self.stretches else 0.0
        before = np.count_nonzero(recording.time < begin - RULES.margin)
        length = max(round(self.limits.rest / recording.dt), 4)
        if recording.specific_force is None or before < 4 * length:
            return None
        sensed = np.hstack([recording.specific_force[:before], GRAVITY * recording.states[:before, RATES]])
        blocks = sensed[before % length :].reshape(-1, length, 6)
        still = (blocks.std(axis=1) < self.limits.still * GRAVITY).all(axis=1)  # False for NaN
        means = blocks[still, :, :3].mean(axis=1)
        if len(means) < 4:
            return None
        alike = np.abs(means - np.median(means, axis=0)).max(axis=1) < self.limits.still * GRAVITY
        return means[alike].mean(axis=0) if alike.mean() > 0.75 else None  # or else in a hand

    @functools.cached_property
    def turns(self) -> Turns | None:
        """Attitude against gyro."""
        return attitude_turns(self.stretches)

    @functools.cached_property
    def velocity(self) -> Measured | None:
        """See `velocity_slopes`."""
        return velocity_slopes(self.stretches)

    @functools.cached_property
    def tilt(self) -> Measured | None:
        """See `tilt_slopes`."""
        return tilt_slopes(self.stretches)

    @functools.cached_property
    def response(self) -> Response | None:
        """Gyro and accelerometer against the rotors. `None`: not known, as if motors keep their values for long."""
        if self.airframe is None or not self.stretches or self.motor_step > self.limits.held:
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
