"""The check of the velocity: its axes, its scale, and gravity."""

import math

from .clocks import sensor_clocks
from .evidence import Evidence
from .finding import Finding
from .mounting import earth_axes
from .turning import wrong_scale


def velocity_axes(evidence: Evidence) -> Finding | None:
    """The velocity changes in another direction, or by another amount, than force and attitude say."""
    slopes = evidence.velocity
    if slopes is None:
        return None
    (along, across), errors = slopes.value, evidence.limits.standard_errors * slopes.error
    angle, scale = math.atan2(across, along), math.hypot(along, across)
    turned = abs(angle) > evidence.limits.angle and abs(across) > errors[1] and scale > errors.max()
    scaled = abs(scale - 1) > max(evidence.limits.velocity, errors[0])
    if not turned and not scaled or any(check(evidence) for check in (wrong_scale, earth_axes, sensor_clocks)):
        return None
    cause = "the horizontal velocity does not follow from specific force and attitude"
    if turned:
        cause = (
            "velocity and attitude have other horizontal axes: one of them is turned about the vertical, or has z down"
        )
    elif scale > errors.max():
        cause = "the velocity does not change as much as specific force and attitude say: one of them has a wrong unit"
    return Finding(
        "velocity_axes",
        cause,
        f"{scale:.2f} times as much, turned by {math.degrees(angle):.0f} degrees",
        "give the velocity along the earth's axes that the attitude refers to, in m/s",
        ("thrust", "attitude", "damping"),
        True,
    )
