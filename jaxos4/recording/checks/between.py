"""The check of several recordings against each other: whether they are of one vehicle."""

from collections.abc import Sequence

import numpy as np

from ...airframe import Airframe
from ..pieces import Recording
from .evidence import Evidence
from .finding import INERTIAS, LIMITS, Finding, Limits

_BLOCKS = 12  # of the jackknife
_NOTED = 0.1  # relative difference of the thrust by commands


def different_vehicles(
    recordings: Sequence[Recording], airframe: Airframe, *, limits: Limits = LIMITS
) -> Finding | None:
    """Compare the thrust of recordings that should be of one vehicle: the force that each felt for its rotor speeds.

    Without an accelerometer, thrust is compared with the weight.
    """
    with np.errstate(all="ignore"):  # numbers that no vehicle has may overflow
        every = [_thrust_ratio(Evidence(recording, airframe, limits)) for recording in recordings]
    ratios = [ratio for ratio in every if ratio is not None]
    if len(ratios) < 2:
        return None
    (least, first), (most, second) = min(ratios), max(ratios)
    error = limits.standard_errors * np.hypot(first / least, second / most)
    commanded = any(each.commanded for each in recordings)
    apart = most / least - 1
    if apart < max(_NOTED if commanded else limits.vehicles, error):
        return None
    return Finding(
        "different_vehicles",
        "the logs are of vehicles of different mass or thrust" + (", or of different batteries" if commanded else ""),
        f"the same rotors lift {apart:.0%} more in one log than in another",
        "fit them separately, each with its own mass" + ("; log the battery's voltage" if commanded else ""),
        ("thrust", *INERTIAS),
        bool(not commanded or apart > limits.commanded_vehicles),
    )


def _thrust_ratio(evidence: Evidence) -> tuple[float, float] | None:
    """The mean vertical specific force over the thrust per mass of the airframe, and its standard error."""
    thrusts, forces = [], []
    for piece in evidence.pieces:
        thrust = evidence.thrust(piece)
        if thrust is None or evidence.airframe is None:
            return None
        weight = np.full(thrust.size, float(evidence.airframe.gravity))
        force = weight if piece.specific_force is None else piece.specific_force[:, 2]
        known = np.isfinite(force)
        thrusts.append(thrust[known])
        forces.append(force[known])
    thrust, force = np.concatenate([*thrusts, []]), np.concatenate([*forces, []])
    if thrust.size < _BLOCKS or min(thrust.mean(), force.mean()) <= 0:
        return None
    parts = np.array(
        [x.mean() / y.mean() for x, y in zip(*(np.array_split(z, _BLOCKS) for z in (force, thrust)), strict=True)]
    )
    return float(force.mean() / thrust.mean()), float(parts.std(ddof=1) / np.sqrt(_BLOCKS))
