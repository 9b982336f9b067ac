"""A finding about a log, and the limits beyond which a difference is one."""

from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

INERTIAS = ("Ix", "Iy", "Iz")


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

    - `standard_errors`: chance reaches so many of its standard errors in one of 2,000 comparisons, because the standard
      errors are those of a dozen blocks of the flight.
    - `kinematics`: the same for the comparison of two causes, both of which are named if neither is clear.
    - `scale`: of attitude against gyro, relative. Inertias are wrong by the scale of the gyro.
    - `angle`: of a sensor about the vertical axis [rad]. 20 degrees change inertias by 8 %, 8 degrees by 1 %.
    - `tilt`: of the accelerometer against the thrust [rad]. Its errors and steady wind reach half of this.
    - `delay`: between two sensors [s] that is noted. Gusts that a controller answers make errors of up to 8 ms.
    - `late`: between two sensors [s] that contradicts. 20 ms change inertias by 10 %. The filter of an accelerometer
      can be 10 ms later than that of the gyro.
    - `late_attitude`: of the attitude after the gyro [s]. Filters and cameras are late by up to 20 ms.
    - `velocity`: of the horizontal acceleration by the velocity against that by force and attitude, relative.
      Velocities that are averaged while the vehicle yaws differ by 5 %.
    - `gravity`: of the mean specific force, relative to gravity. It is up to 10 % larger in brisk flight.
    - `thrust`, `commanded_thrust`: of the airframe's thrust, relative, by measured speeds and by commands. The fit
      measures the thrust by the accelerometer: errors of 20 % are harmless.
    - `vehicles`, `commanded_vehicles`: of the thrust between two logs of one vehicle, relative, by measured speeds and
      by commands. A battery that empties changes the thrust of a command by up to 30 %.
    - `clipped`: the share of clipped values above which a channel cannot be used.
    - `motions`: of roll and pitch, independent ones. Fewer do not show how large the noise is: the standard deviation
      of a mean square is 37 % for 15. Two seconds of flight have 5 to 12, four have 7 to 21.
    - `held`: the time for which motors keep their value [s]: half of the shortest lag of rotors.
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
    thrust: float = 0.35
    commanded_thrust: float = 1.0
    vehicles: float = 0.1
    commanded_vehicles: float = 0.4
    clipped: float = 0.1
    motions: float = 15.0
    held: float = 0.015


LIMITS = Limits()


class Measured(msgspec.Struct, frozen=True):
    """Numbers that follow from the log, and their standard errors, of the same shape."""

    value: Float[np.ndarray, "..."]
    error: Float[np.ndarray, "..."]

    @classmethod
    def of(cls, whole: Float[np.ndarray, "..."], without: Float[np.ndarray, "blocks ..."]) -> "Measured":
        """Numbers of the whole flight, with the errors of the jackknife: from numbers `without` each of its blocks."""
        share = (len(without) - 1) / len(without)
        return cls(whole, np.sqrt(share * np.square(without - without.mean(axis=0)).sum(axis=0)))
