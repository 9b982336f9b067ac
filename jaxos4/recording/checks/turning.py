"""Checks of the attitude against the integrated gyro: scales and axes."""

import math

import numpy as np

from ...excitation import AXES
from ..motion import excitation
from .attitude import scaled_angles
from .evidence import Evidence
from .finding import INERTIAS, Finding

_DEGREES, _ABOUT = math.degrees(1), 0.05  # a scale this close to that of degrees is that of degrees
_WELL = 0.3  # largest standard error of an axis that is judged, as a share of its scale
_FOLLOWS = 0.2  # the least share of the attitude's turns that a gyro explains
_UNRELATED = 0.1  # a gyro that moves, and explains less, is of another flight than the attitude
_ALL = (*INERTIAS, "attitude")


def wrong_scale(evidence: Evidence) -> Finding | None:
    """The attitude turns more or less than the gyro says."""
    turns, limits = evidence.turns, evidence.limits
    if turns is None:
        return None
    matrix, error = turns.matrix.value, np.diagonal(turns.matrix.error)
    clear = np.abs(matrix) > limits.standard_errors * turns.matrix.error  # others only add noise
    scale = np.linalg.norm(np.where(clear | np.eye(3, dtype=bool), matrix, 0.0), axis=1)
    judged = (error < _WELL * scale) & (turns.explained > _FOLLOWS)
    far = np.abs(np.log(np.where(judged, scale, 1.0))) > math.log1p(limits.scale)
    far &= np.abs(scale - 1) > limits.standard_errors * error
    if not far.any():
        return None
    mean = float(np.exp(np.log(scale[far]).mean()))
    kinematics = scaled_angles(evidence.pieces, turns)
    gyro, known = _gyro_or_time(evidence, mean), abs(kinematics) > limits.kinematics
    name, quantities = "attitude_or_gyro_or_time_scale", _ALL
    cause = f"{gyro}, or that of the attitude"
    remedy = "compare a turn by hand with the gyro's integral, and the length of the log with a clock"
    if known and kinematics > 0:
        name, quantities, cause = "attitude_scale", ("attitude",), "the scale of the attitude is wrong"
        remedy = "leave the attitude out, or correct it"
    elif known:
        name, quantities, cause = "gyro_or_time_scale", INERTIAS, gyro
    for factor, unit in ((_DEGREES, "the angles may be in degrees"), (1 / _DEGREES, "the gyro may be in degrees/s")):
        if abs(mean / factor - 1) < _ABOUT:
            cause += f"; {unit}"
    which = "" if far.sum() == judged.sum() else f" in {' and '.join(np.array(AXES)[far])}"
    axes = [f"{a} {s:.3f} +- {2 * e:.2g}" for a, s, e, j in zip(AXES, scale, error, judged, strict=True) if j]
    cause = f"the attitude turns {mean:.3g} times as much as the gyro says{which}; {cause}"
    return Finding(name, cause, ", ".join(axes), remedy, quantities, True)


def wrong_axes(evidence: Evidence) -> Finding | None:
    """Attitude and gyro turn about other axes, or in opposite directions, or not together."""
    turns, limits = evidence.turns, evidence.limits
    if turns is None:
        return None
    matrix, error = turns.matrix.value, limits.standard_errors * turns.matrix.error
    opposite = [axis for axis, m, e in zip(AXES, np.diagonal(matrix), np.diagonal(error), strict=True) if m + e < 0]
    tilts = matrix[:2, :2]
    sizes = np.hypot(*tilts)
    follows = 100 * turns.explained[:2].max()
    unrelated = follows < 100 * _UNRELATED and _moves(evidence)
    if not unrelated and (error[:2, :2] >= sizes).any():
        return None
    if np.linalg.det(tilts) > 0 and not unrelated and opposite in ([], ["roll", "pitch"]):
        return None
    if unrelated:
        cause, size = "the attitude does not turn as the gyro says", f"the gyro explains {follows:.0f} % of its turns"
    elif opposite:
        slope = np.diagonal(matrix)[AXES.index(opposite[0])]
        cause, size = f"attitude and gyro have opposite signs in {' and '.join(opposite)}", f"slope {slope:.2f}"
    else:
        cause, size = "roll and pitch of attitude and gyro are exchanged", f"slope {matrix[0, 1]:.2f}"
    return Finding(
        "attitude_axes",
        cause,
        size,
        "give both with x forward, y left, z up; angles in the order of docs/logs.md",
        _ALL,
        True,
    )


def _moves(evidence: Evidence) -> bool:
    """Whether roll or pitch are excited well."""
    return any(excitation(piece)[axis].verdict == "good" for piece in evidence.pieces for axis in AXES[:2])


def _gyro_or_time(evidence: Evidence, scale: float) -> str:
    """What else than the attitude is wrong. A velocity shows whether it is the time."""
    if evidence.velocity is not None:
        slope, unlike = float(evidence.velocity.value[0]), evidence.limits.velocity
        if abs(slope / scale - 1) < unlike < abs(slope - 1):
            return "the time stamps are wrong, as the velocity changes by as much"
        if abs(slope - 1) < unlike < abs(slope / scale - 1):
            return "the gyro's scale is wrong"
    return "the gyro's scale or the time stamps are wrong"
