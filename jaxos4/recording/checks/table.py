"""The table of checks."""

from collections.abc import Callable, Sequence

import numpy as np

from ...airframe import Airframe
from ..pieces import Recording
from .clocks import sensor_clocks
from .evidence import Evidence
from .finding import LIMITS, Finding, Limits
from .log import clipped_values, impossible_values, rare_motors, short_flight, uneven_time
from .mounting import earth_axes, thrust_direction, turned_about_vertical, wrong_thrust
from .turning import wrong_axes, wrong_scale
from .velocity_check import velocity_axes

Check = Callable[[Evidence], Finding | None]

CHECKS: tuple[Check, ...] = (
    uneven_time,
    wrong_scale,
    wrong_axes,
    sensor_clocks,
    turned_about_vertical,
    earth_axes,
    thrust_direction,
    velocity_axes,
    clipped_values,
    rare_motors,
    impossible_values,
    short_flight,
    wrong_thrust,
)
"""Each check looks for one fault. A new check is one function, and one line here."""

KINEMATIC: tuple[Check, ...] = (wrong_scale, wrong_axes)
"""The checks that hold for a flight without a controller too, which may turn far and drift away."""


def self_checks(
    recording: Recording,
    airframe: Airframe | None = None,
    *,
    limits: Limits = LIMITS,
    checks: Sequence[Check] = CHECKS,
) -> tuple[Finding, ...]:
    """Check a log against itself, before anything is fitted.

    **Arguments:**

    - `recording`: as it was logged, of one vehicle.
    - `airframe`: without it, gyro and accelerometer are not compared with the rotors.
    - `limits`: what counts as a finding.
    - `checks`: of the table.

    **Returns:** the findings; those that contradict quantities come first.
    """
    evidence = Evidence(recording, airframe, limits)
    with np.errstate(all="ignore"):  # numbers that no vehicle has may overflow
        found = [finding for check in checks if (finding := check(evidence)) is not None]
    return tuple(sorted(found, key=lambda finding: not finding.contradicted))
