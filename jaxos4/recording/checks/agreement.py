"""Checks of channels against each other: scales, axes and clocks of gyro, accelerometer, attitude and velocity."""

import math

import numpy as np

from ...airframe import INERTIAS, MOTIONS
from ...flight import RATES
from ..motion import excitation
from .estimates import scaled_angles
from .evidence import EXPLAINED, STANDARD_ERRORS, Evidence, Finding
from .mounting import ANGLE, earth_axes, tilted_force

# Shares of the attitude's turns that the gyro explains. Above the first, scale and delay are judged. Below the second,
# gyro and attitude are of different flights.
FOLLOWS, UNRELATED = 0.2, 0.1
# Relative difference between the horizontal accelerations from velocity and from force and attitude. Velocities that
# are averaged while the vehicle yaws differ by 5 %.
VELOCITY_ERROR = 0.15
_ATTITUDE = (*INERTIAS, "attitude")
_CLOCKS = {  # the verbs of its message, and the quantities that it concerns
    "gyro": ("is", "lags", INERTIAS),
    "accelerometer": ("is", "lags", (*INERTIAS, "thrust", "motors")),
    "attitude": ("is", "lags", ("attitude",)),
    "motors": ("are", "lag", ("motors",)),
}

SCALE = 0.1  # largest relative difference of attitude and gyro; inertias are wrong by the scale of the gyro
KINEMATICS = 2.5  # standard errors that separate two causes; with fewer, both are named
SLOW_GYRO = 0.0202  # s; the longest sample of a gyro whose integral is compared with the attitude: 50 Hz


def wrong_scale(evidence: Evidence) -> Finding | None:
    """The attitude turns more or less than the gyro says. A slow gyro misses turns between its samples."""
    turns, steps = evidence.turns, [0.0]
    for rates, time in ((each.states[:, RATES], each.time) for each in evidence.stretches):
        measured = (time[np.isfinite(rate)] for rate in rates.T)
        steps += [float(np.median(np.diff(each))) for each in measured if each.size > 1]
    if turns is None or max(steps) > SLOW_GYRO:
        return None
    matrix, errors = turns.matrix
    clear, error = np.abs(matrix) > STANDARD_ERRORS * errors, np.diagonal(errors)  # others only add noise
    scale = np.linalg.norm(np.where(clear | np.eye(3, dtype=bool), matrix, 0.0), axis=1)
    judged = (error < 0.3 * scale) & (turns.explained > FOLLOWS)
    far = np.abs(np.log(np.where(judged, scale, 1.0))) > math.log1p(SCALE)
    far &= np.abs(scale - 1) > STANDARD_ERRORS * error
    if not far.any():
        return None
    mean = float(np.exp(np.log(scale[far]).mean()))
    kinematics = scaled_angles(evidence.stretches, turns)
    gyro, known = _gyro_or_time(evidence, mean), abs(kinematics) > KINEMATICS
    name, quantities = "attitude_or_gyro_or_time_scale", _ATTITUDE
    cause = f"{gyro}, or that of the attitude"
    remedy = "compare a turn by hand with the gyro's integral, and the length of the log with a clock"
    if known and kinematics > 0:
        name, quantities, cause = "attitude_scale", ("attitude",), "the scale of the attitude is wrong"
        remedy = "leave the attitude out, or correct it"
    elif known:
        name, quantities, cause = "gyro_or_time_scale", INERTIAS, gyro
    degrees = math.degrees(1)
    for factor, unit in ((degrees, "the angles may be in degrees"), (1 / degrees, "the gyro may be in degrees/s")):
        if abs(mean / factor - 1) < 0.05:
            cause += f"; {unit}"
    which = "" if far.sum() == judged.sum() else f" in {' and '.join(np.array(MOTIONS)[far])}"
    axes = [f"{a} {s:.3f} +- {2 * e:.2g}" for a, s, e, j in zip(MOTIONS, scale, error, judged, strict=True) if j]
    cause = f"the attitude turns {mean:.3g} times as much as the gyro says{which}; {cause}"
    return Finding(name, cause, ", ".join(axes), remedy, quantities)


def _gyro_or_time(evidence: Evidence, scale: float) -> str:
    """The cause if the attitude is right: the gyro or the time stamps. A measured velocity tells them apart."""
    if evidence.velocity is not None:
        (slope, _), _ = evidence.velocity
        if abs(slope / scale - 1) < VELOCITY_ERROR < abs(slope - 1):
            return "the time stamps are wrong, as the velocity changes by as much"
        if abs(slope - 1) < VELOCITY_ERROR < abs(slope / scale - 1):
            return "the gyro's scale is wrong"
    return "the gyro's scale or the time stamps are wrong"


def wrong_axes(evidence: Evidence) -> Finding | None:
    """Attitude and gyro turn about other axes, or in opposite directions, or not together."""
    turns = evidence.turns
    if turns is None:
        return None
    matrix, errors = turns.matrix
    error = STANDARD_ERRORS * errors
    opposite = [axis for axis, m, e in zip(MOTIONS, np.diagonal(matrix), np.diagonal(error), strict=True) if m + e < 0]
    tilts = matrix[:2, :2]
    follows = float(turns.explained[:2].max())
    excited = (excitation(each)[axis].verdict for each in evidence.stretches for axis in MOTIONS[:2])
    unrelated = follows < UNRELATED and "good" in excited
    if not unrelated and (error[:2, :2] >= np.hypot(*tilts)).any():
        return None
    if np.linalg.det(tilts) > 0 and not unrelated and opposite in ([], [*MOTIONS[:2]]):
        return None
    if unrelated:
        cause = "the attitude does not turn as the gyro says"
        size = f"the gyro explains {100 * follows:.0f} % of its turns"
    elif opposite:
        slope = np.diagonal(matrix)[MOTIONS.index(opposite[0])]
        cause, size = f"attitude and gyro have opposite signs in {' and '.join(opposite)}", f"slope {slope:.2f}"
    else:
        cause, size = "roll and pitch of attitude and gyro are exchanged", f"slope {matrix[0, 1]:.2f}"
    remedy = "give both with x forward, y left, z up; angles in the order of docs/logs.md"
    return Finding("attitude_axes", cause, size, remedy, _ATTITUDE)


LIKELIER = 6.0  # of chi^2: a clock 20 times less likely to be wrong than another is not named


def sensor_clocks(evidence: Evidence) -> Finding | None:
    """One clock that differs from the others.

    Each measured delay is a difference of two clocks. The clock that is named explains all delays best if the other
    clocks are right. If several explain them equally well, all are named.
    """
    delays, differ = _delays(evidence)
    if not differ:
        return None
    clocks, late, error = (np.array(each) for each in zip(*delays, strict=True))
    weights = clocks / error[:, None]
    measured = np.abs(clocks).any(axis=0)
    squares = np.where(measured, np.square(weights).sum(axis=0), 1.0)
    wrong = weights.T @ (late / error) / squares
    misfit = np.where(measured, np.square((late / error)[:, None] - weights * wrong).sum(axis=0), np.inf)
    best = np.argsort(misfit)
    names, likely = [*_CLOCKS], misfit[best[0]] + LIKELIER
    named = {names[i]: i for i in best if misfit[i] < likely}
    causes = [
        f"the {name} {_CLOCKS[name][0]} recorded {1e3 * abs(wrong[i]):.0f} ms {'late' if wrong[i] > 0 else 'early'}"
        for name, i in named.items()
    ]
    off = wrong[best[0]]
    if len(named) == 2 and wrong[[*named.values()]].prod() < 0:  # one difference between two clocks
        early, behind = sorted(named, key=lambda name: wrong[named[name]])
        causes, off = [f"the {behind} {_CLOCKS[behind][1]} the {early}"], abs(off)
    return Finding(
        "_or_".join(named) + "_clock",
        ", or ".join(causes),
        f"{1e3 * off:.1f} +- {2e3 / math.sqrt(squares[best[0]]):.2g} ms",
        "shift the time stamps, or log without a filter",
        tuple(dict.fromkeys(quantity for name in named for quantity in _CLOCKS[name][2])),
        # The delay of the motors is estimated with the other parameters.
        bool(abs(wrong[best[0]]) > LATE and "motors" not in named),
    )


DELAY = 0.01  # s; a longer delay between two sensors is noted; damping and inflow make errors of up to 8 ms
# s; a longer delay between two sensors contradicts the quantities: 20 ms change inertias by 10 %. The filter of an
# accelerometer can be 10 ms later than the gyro's.
LATE = 0.015
LATE_ATTITUDE = 0.025  # s after the gyro; filters and cameras are late by up to 20 ms
# Standard deviations of delays that are no clock errors [s]: by filters, by varying damping, and by the rotors' lag and
# delay if they follow commands; then the mean of the last.
FILTERS, DAMPING, LAGS, USUAL_LAG = 0.003, 0.004, 0.025, 0.05
ANSWERED = 0.014  # s; the delay that a gyro seems to have if the rotors do nothing but answer gusts


def _delays(evidence: Evidence) -> tuple[list[tuple[tuple[int, int, int, int], float, float]], bool]:
    """The delays that the log shows, and whether one of them is a finding.

    Each has the share of each clock, the delay [s], and its standard error with that of delays that no clock causes.
    """
    turns, response = evidence.turns, evidence.response
    delays, differ = [], False
    if turns is not None and turns.explained[:2].max() > FOLLOWS:
        late, error = turns.delay.tolist()
        delays.append(((-1, 0, 1, 0), late, math.hypot(error, FILTERS)))
        differ |= abs(late) > max(LATE_ATTITUDE, STANDARD_ERRORS * error)
    if response is not None and response.explained[:2].max() > EXPLAINED[0]:
        (gyro, gyro_error), _, (between, between_error) = response.delays.T.tolist()
        answered = ANSWERED * (1 - float(response.explained[:2].mean()))
        late, usual = _beyond(gyro, answered), DAMPING
        if response.lag:  # commands: the rotors' own lag and delay are unknown
            late, usual = gyro + response.lag - USUAL_LAG, LAGS
        delays.append(((1, 0, 0, -1), late, math.hypot(gyro_error, usual)))
        before = min(gyro + response.lag, 0.0) if response.lag else late
        differ |= abs(before) > max(LATE, STANDARD_ERRORS * gyro_error)
        felt = response.explained[2] > EXPLAINED[1] and math.isfinite(between_error)
        if felt and not tilted_force(evidence):  # the force along another axis is not the thrust's
            late = _beyond(between, answered + DAMPING)
            delays.append(((1, -1, 0, 0), late, math.hypot(between_error, DAMPING)))
            differ |= abs(late) > max(DELAY, STANDARD_ERRORS * between_error)
    return delays, differ


def _beyond(late: float, usual: float) -> float:
    """The delay, or 0 if it is in the usual range of 0 to `usual`."""
    return 0.0 if 0.0 < late < usual else late


def velocity_axes(evidence: Evidence) -> Finding | None:
    """The velocity changes in another direction, or by another amount, than force and attitude say.

    A fault of the attitude, the force or a clock makes the velocity differ too.
    """
    if evidence.velocity is None:
        return None
    (along, across), errors = evidence.velocity
    limits = STANDARD_ERRORS * errors
    angle, scale = math.atan2(across, along), math.hypot(along, across)
    turned = abs(angle) > ANGLE and abs(across) > limits[1] and scale > limits.max()
    if not turned and abs(scale - 1) <= max(VELOCITY_ERROR, limits[0]):
        return None
    if any(check(evidence) for check in (wrong_scale, earth_axes, sensor_clocks)):
        return None
    cause = "the horizontal velocity does not follow from specific force and attitude"
    if turned:
        cause = (
            "velocity and attitude have other horizontal axes: one of them is turned about the vertical, or has z down"
        )
    elif scale > limits.max():
        cause = "the velocity does not change as much as specific force and attitude say: one of them has a wrong unit"
    return Finding(
        "velocity_axes",
        cause,
        f"{scale:.2f} times as much, turned by {math.degrees(angle):.0f} degrees",
        "give the velocity along the earth's axes that the attitude refers to, in m/s",
        ("thrust", "attitude", "damping"),
    )
