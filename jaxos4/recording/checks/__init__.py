"""A log is checked against itself: faults that it shows, with cause, size and remedy."""

from collections.abc import Callable, Sequence

import numpy as np

from ...airframe import Airframe
from ...logs import Recording
from .agreement import sensor_clocks, velocity_axes, wrong_axes, wrong_scale
from .channels import (
    clipped_values,
    constant_force,
    impossible_values,
    rare_motors,
    rare_speeds,
    short_flight,
    uneven_time,
)
from .evidence import Evidence as Evidence, Finding as Finding
from .mounting import (
    different_thrust as different_thrust,
    earth_axes,
    opposite_yaw as opposite_yaw,
    thrust_direction,
    turned_about_vertical,
    wrong_thrust,
)

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
    constant_force,
    rare_motors,
    rare_speeds,
    impossible_values,
    short_flight,
    wrong_thrust,
)
"""Each check looks for one fault in one log. A new check is one function, and one line here.

Two checks are called where a fit or an inspection is prepared: `different_thrust` compares several logs, and
`opposite_yaw` needs to know which stretches are used.
"""

KINEMATIC: tuple[Check, ...] = (wrong_scale, wrong_axes)
"""The checks that also hold for a flight without a controller, which may turn far and drift away."""


def self_checks(
    recording: Recording,
    airframe: Airframe | None = None,
    *,
    checks: Sequence[Check] = CHECKS,
) -> tuple[Finding, ...]:
    """Check a log against itself, before anything is fitted.

    **Arguments:**

    - `recording`: as it was logged, of one vehicle.
    - `airframe`: without it, gyro and accelerometer are not compared with the rotors.
    - `checks`: the checks to make, from `CHECKS`.

    **Returns:** the findings; those that contradict quantities come first.
    """
    return findings(Evidence(recording, airframe), checks)


def findings(evidence: Evidence, checks: Sequence[Check] = CHECKS) -> tuple[Finding, ...]:
    """The findings of all checks in the evidence of a log, see `self_checks`."""
    with np.errstate(all="ignore"):  # numbers that no vehicle has may overflow
        found = [finding for check in checks if (finding := check(evidence)) is not None]
    return tuple(sorted(found, key=lambda finding: not finding.contradicted))


def different_vehicles(recordings: Sequence[Recording], airframe: Airframe) -> Finding | None:
    """Check whether recordings are of one vehicle: compare the measured force with the thrust of the rotor speeds.

    Without an accelerometer, thrust is compared with the weight.
    """
    return different_thrust([Evidence(recording, airframe) for recording in recordings])
