"""Checks of the channels: each by itself (time, values, rate, length), and against others (scales, axes, clocks)."""

import math
from typing import NamedTuple

import numpy as np

from ...airframe import AXES, INERTIAS, MOTIONS
from ...errors import percent
from ...flight import FORCE_NAMES, RATES
from ...logs.table import counted
from ..motion import excitation
from .estimates import scaled_angles
from .evidence import Evidence, Finding
from .mounting import earth_axes, tilted_force

_ATTITUDE = (*INERTIAS, "attitude")
_CLOCKS = {  # how to say that it is wrong, and what it concerns
    "gyro": ("is", "lags", INERTIAS),
    "accelerometer": ("is", "lags", (*INERTIAS, "thrust", "motors")),
    "attitude": ("is", "lags", ("attitude",)),
    "motors": ("are", "lag", ("motors",)),
}
_UNITS: dict[str, str] = {**dict.fromkeys("pqr", "rad/s"), **dict.fromkeys(FORCE_NAMES, "m/s^2")}
# Clipped thrust seems weaker, and moments of inertia are proportional to it.
_CLIPPED = {axis.rate: (axis.inertia,) for axis in AXES} | {"az": ("thrust", *INERTIAS)}


def uneven_time(evidence: Evidence) -> Finding | None:
    """Samples that are not on a uniform grid, which a `Flight` from Python may have."""
    steps = np.diff(evidence.logged.time)
    step = float(np.median(steps))
    uneven = np.abs(steps - step) > 0.05 * step  # resampled logs are far below
    if not uneven.any():
        return None
    missing = 1 - (steps.size + 1) / (np.sum(steps) / step + 1)
    if missing > 0:
        size = f"{percent(missing)} of the samples are missing, in gaps of up to {1e3 * steps.max():.3g} ms"
    else:
        size = f"steps of {1e3 * steps.min():.3g} to {1e3 * steps.max():.3g} ms"
    return Finding(
        "uneven_time",
        "the time of the flight is not uniform",
        size,
        "write the flight to a CSV and read it with `jaxos4.recording.read_recording`, which resamples it",
        (*INERTIAS, "thrust", "motors", "damping", "attitude"),
        True,
    )


def impossible_values(evidence: Evidence) -> Finding | None:
    """Single values far from all others."""
    found = evidence.plausible.impossible
    if not found:
        return None
    return Finding(
        "impossible_values",
        "single values are impossible, and count as not measured",
        ", ".join(f"{name}: {counted(number, 'value')}, as {worst:.4g}" for name, (number, worst) in found.items()),
        "nothing is to be done if they are few",
        (*INERTIAS, "thrust"),
        False,
    )


def clipped_values(evidence: Evidence) -> Finding | None:
    """Values at the end of a sensor's range."""
    found = evidence.plausible.clipped
    if not found:
        return None
    each = [f"{n}: {count} ({percent(share)}) at {end:.4g} {_UNITS[n]}" for n, (count, share, end) in found.items()]
    many = bool(max(share for _, share, _ in found.values()) > evidence.limits.clipped)
    return Finding(
        "clipped_values",
        "a sensor is clipped at the end of its range; these values count as not measured",
        ", ".join(each),
        "fly more gently, or set a larger range of the sensor",
        tuple(dict.fromkeys(quantity for name in found for quantity in _CLIPPED.get(name, ()))),
        many,
    )


def constant_force(evidence: Evidence) -> Finding | None:
    """A vertical specific force that never changes, although the rotors do."""
    force = evidence.logged.specific_force
    measured = np.empty(0) if force is None else force[np.isfinite(force[:, 2]), 2]
    squares = np.square(evidence.logged.omega).sum(axis=1)
    if not measured.size or np.ptp(measured) > 0 or squares.std() < evidence.limits.thrust_moves * squares.mean():
        return None
    return Finding(
        "constant_force",
        "the vertical specific force never changes, although the rotors do",
        f"{measured[0]:.4g} m/s^2 in all {measured.size} samples",
        "log what the accelerometer measures, or leave its columns out",
        ("thrust", *INERTIAS),
        True,
    )


def rare_speeds(evidence: Evidence) -> Finding | None:
    """Rotor speeds at instants so far apart that what rotors do in between matters."""
    logged = evidence.logged
    if logged.commanded or logged.held or logged.dt <= evidence.limits.instants:
        return None
    return Finding(
        "rare_speeds",
        "rotor speeds were logged so rarely that what rotors did in between is not known",
        f"every {1e3 * logged.dt:.0f} ms",
        "log rotor speeds at 100 Hz or more, or their means",
        (*INERTIAS, "damping"),
        False,
    )


def rare_motors(evidence: Evidence) -> Finding | None:
    """Rotor speeds or commands that keep their value for longer than rotors take to answer."""
    if evidence.motor_step <= evidence.limits.held:
        return None
    return Finding(
        "rare_motors",
        "motors were logged more rarely than rotors answer, so that the damping comes out too large",
        f"new values every {1e3 * evidence.motor_step:.0f} ms",
        "log motors at 100 Hz or more, on board",
        ("damping",),
        True,
    )


def short_flight(evidence: Evidence) -> Finding | None:
    """Few independent motions of roll and pitch."""
    measured = [each for each in evidence.stretches if np.isfinite(each.states[:, RATES[:2]]).any(axis=0).all()]
    if not measured:
        return None
    lengths = [float(np.ptp(each.time)) for each in measured]
    longest, seconds = measured[int(np.argmax(lengths))], sum(lengths)
    lasting = float(np.mean([longest.dt * _correlated(column) for column in longest.states[:, RATES[:2]].T]))
    motions = seconds / (2 * lasting) if lasting > 0 else math.inf  # nothing moves
    if motions >= evidence.limits.motions:
        return None
    return Finding(
        "short_flight",
        "the flight is short, so that intervals may be too narrow",
        f"{seconds:.1f} s, or {motions:.0f} independent motions of {2 * lasting:.2g} s",
        f"fly for {5 * math.ceil(2 * evidence.limits.motions * 2 * lasting / 5)} s or longer",
        INERTIAS,
        False,
    )


def _correlated(values: np.ndarray) -> float:
    """The sum of the autocorrelation until it is first negative, in samples."""
    values = np.nan_to_num(values - np.nanmean(values))
    power = np.square(np.abs(np.fft.rfft(values, 1 << (2 * values.size - 1).bit_length())))
    products = np.fft.irfft(power)[: values.size]
    until = int(np.argmax(products < 0)) or values.size
    return float(products[:until].sum() / max(products[0], 1e-300))


def wrong_scale(evidence: Evidence) -> Finding | None:
    """The attitude turns more or less than the gyro says. A slow gyro misses turns between its samples."""
    turns, limits = evidence.turns, evidence.limits
    if turns is None or _gyro_step(evidence) > limits.slow_gyro:
        return None
    matrix, error = turns.matrix.value, np.diagonal(turns.matrix.error)
    clear = np.abs(matrix) > limits.standard_errors * turns.matrix.error  # others only add noise
    scale = np.linalg.norm(np.where(clear | np.eye(3, dtype=bool), matrix, 0.0), axis=1)
    judged = (error < 0.3 * scale) & (turns.explained > limits.follows)
    far = np.abs(np.log(np.where(judged, scale, 1.0))) > math.log1p(limits.scale)
    far &= np.abs(scale - 1) > limits.standard_errors * error
    if not far.any():
        return None
    mean = float(np.exp(np.log(scale[far]).mean()))
    kinematics = scaled_angles(evidence.stretches, turns)
    gyro, known = _gyro_or_time(evidence, mean), abs(kinematics) > limits.kinematics
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
    return Finding(name, cause, ", ".join(axes), remedy, quantities, True)


def _gyro_step(evidence: Evidence) -> float:
    """The longest median time between samples of p, q or r in flight [s]; 0 without any."""
    steps = [0.0]
    for flown in evidence.stretches:
        seen = np.isfinite(flown.states[:, RATES])
        steps += [float(np.median(np.diff(flown.time[one]))) for one in seen.T if np.count_nonzero(one) > 1]
    return max(steps)


def _gyro_or_time(evidence: Evidence, scale: float) -> str:
    """The channel that is wrong if it is not the attitude. A velocity shows whether it is the time."""
    if evidence.velocity is not None:
        slope, unlike = float(evidence.velocity.value[0]), evidence.limits.velocity
        if abs(slope / scale - 1) < unlike < abs(slope - 1):
            return "the time stamps are wrong, as the velocity changes by as much"
        if abs(slope - 1) < unlike < abs(slope / scale - 1):
            return "the gyro's scale is wrong"
    return "the gyro's scale or the time stamps are wrong"


def wrong_axes(evidence: Evidence) -> Finding | None:
    """Attitude and gyro turn about other axes, or in opposite directions, or not together."""
    turns, limits = evidence.turns, evidence.limits
    if turns is None:
        return None
    matrix, error = turns.matrix.value, limits.standard_errors * turns.matrix.error
    opposite = [axis for axis, m, e in zip(MOTIONS, np.diagonal(matrix), np.diagonal(error), strict=True) if m + e < 0]
    tilts = matrix[:2, :2]
    follows = float(turns.explained[:2].max())
    excited = (excitation(each)[axis].verdict for each in evidence.stretches for axis in MOTIONS[:2])
    unrelated = follows < limits.unrelated and "good" in excited
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
    return Finding("attitude_axes", cause, size, remedy, _ATTITUDE, True)


class _Delay(NamedTuple):
    """A delay [s] with its standard error, the share of each clock in it, and the part that no clock causes."""

    clocks: tuple[int, int, int, int]
    late: float
    error: float
    usual: float


def sensor_clocks(evidence: Evidence) -> Finding | None:
    """One clock that differs from the others.

    Each measured delay is a difference of two clocks. The clock that is named explains all delays best if the other
    clocks are right. Several are named if they explain them alike.
    """
    delays, differ = _delays(evidence)
    if not differ:
        return None
    clocks, late = np.array([each.clocks for each in delays]), np.array([each.late for each in delays])
    error = np.array([math.hypot(each.error, each.usual) for each in delays])
    weights = clocks / error[:, None]
    measured = np.abs(clocks).any(axis=0)
    squares = np.where(measured, np.square(weights).sum(axis=0), 1.0)
    wrong = weights.T @ (late / error) / squares
    misfit = np.where(measured, np.square((late / error)[:, None] - weights * wrong).sum(axis=0), np.inf)
    best = np.argsort(misfit)
    names, likely = [*_CLOCKS], misfit[best[0]] + evidence.limits.likelier
    named = {names[i]: i for i in best if misfit[i] < likely}
    off = wrong[best[0]]
    causes = [
        f"the {name} {_CLOCKS[name][0]} recorded {1e3 * abs(wrong[i]):.0f} ms {'late' if wrong[i] > 0 else 'early'}"
        for name, i in named.items()
    ]
    if len(named) == 2 and wrong[[*named.values()]].prod() < 0:  # one difference of two clocks, seen from either
        early, behind = sorted(named, key=lambda name: wrong[named[name]])
        causes, off = [f"the {behind} {_CLOCKS[behind][1]} the {early}"], abs(off)
    return Finding(
        "_or_".join(named) + "_clock",
        ", or ".join(causes),
        f"{1e3 * off:.1f} +- {2e3 / math.sqrt(squares[best[0]]):.2g} ms",
        "shift the time stamps, or log without a filter",
        tuple(dict.fromkeys(quantity for name in named for quantity in _CLOCKS[name][2])),
        # The delay of the motors is estimated with the other parameters.
        bool(abs(wrong[best[0]]) > evidence.limits.late and "motors" not in named),
    )


def _delays(evidence: Evidence) -> tuple[list[_Delay], bool]:
    """The delays that the log shows, and whether one of them is a finding."""
    turns, response, limits = evidence.turns, evidence.response, evidence.limits
    delays, differ = [], False
    if turns is not None and turns.explained[:2].max() > limits.follows:
        late, error = float(turns.delay.value), float(turns.delay.error)
        delays.append(_Delay((-1, 0, 1, 0), late, error, limits.filters))
        differ |= abs(late) > max(limits.late_attitude, limits.standard_errors * error)
    if response is not None and response.explained[:2].max() > limits.explained[0]:
        gyro, _, between = zip(response.delays.value.tolist(), response.delays.error.tolist(), strict=True)
        answered = limits.answered * (1 - float(response.explained[:2].mean()))
        late, usual = _beyond(gyro[0], answered), limits.damping
        if response.lag:  # commands: the rotors' own lag and delay are unknown
            late, usual = gyro[0] + response.lag - limits.usual_lag, limits.lags
        delays.append(_Delay((1, 0, 0, -1), late, gyro[1], usual))
        before = min(gyro[0] + response.lag, 0.0) if response.lag else late
        differ |= abs(before) > max(limits.late, limits.standard_errors * gyro[1])
        felt = response.explained[2] > limits.explained[1] and math.isfinite(between[1])
        if felt and not tilted_force(evidence):  # the force along another axis is not the thrust's
            late, error = _beyond(between[0], answered + limits.damping), between[1]
            delays.append(_Delay((1, -1, 0, 0), late, error, limits.damping))
            differ |= abs(late) > max(limits.delay, limits.standard_errors * error)
    return delays, differ


def _beyond(late: float, usual: float) -> float:
    """A delay; 0 if it is a usual one, which is 0 to `usual`."""
    return 0.0 if 0.0 < late < usual else late


def velocity_axes(evidence: Evidence) -> Finding | None:
    """The velocity changes in another direction, or by another amount, than force and attitude say.

    A fault of the attitude, the force or a clock makes the velocity differ too.
    """
    slopes = evidence.velocity
    if slopes is None:
        return None
    (along, across), errors = slopes.value, evidence.limits.standard_errors * slopes.error
    angle, scale = math.atan2(across, along), math.hypot(along, across)
    turned = abs(angle) > evidence.limits.angle and abs(across) > errors[1] and scale > errors.max()
    if not turned and abs(scale - 1) <= max(evidence.limits.velocity, errors[0]):
        return None
    if any(check(evidence) for check in (wrong_scale, earth_axes, sensor_clocks)):
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
