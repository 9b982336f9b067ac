"""Checks of how the sensors are mounted, by the rotors, the attitude and the thrust in hover; and of the thrust."""

import math

import numpy as np

from ...airframe import GRAVITY
from ...flight import ANGLES
from ...logs.sampling import averages
from .evidence import Evidence
from .finding import INERTIAS, Finding, Measured

_COHERENT = 0.1  # the least share of both angular accelerations that the rotors explain
_VAGUE = 0.2  # [rad]; a larger error of the angle by the rotors is that of another airframe
_ALONG = 0.17  # [rad]; a rotation turns roll and pitch by the same angle, up to this
_SLOW, _BLOCKS = 0.1, 12  # [s], samples whose tilt is compared; blocks of the jackknife
_EARTH = 0.6  # slope of the horizontal force on the tilt: 1 along the earth's axes, 0 or less along the body's
_STEADY = 0.9  # of the force in a hand or in rolls, the mean vector is shorter than this share of the mean size
_UNIT_G = (0.8, 1.25)  # mean force in units of g
_TURN = "turn p, q and ax, ay of the log"


def turned_about_vertical(evidence: Evidence) -> Finding | None:
    """Gyro turned about the vertical axis: roll torque pitches the vehicle, and the attitude turns about other axes."""
    rotors, attitude = _by_rotors(evidence), _by_attitude(evidence)
    limits = evidence.limits

    def turned(angle: tuple[float, float] | None) -> bool:
        return angle is not None and abs(angle[0]) > max(limits.angle, limits.standard_errors * angle[1])

    by_attitude, by_rotors = turned(attitude), turned(rotors)
    if not by_attitude and not by_rotors:
        return None
    quantities, angle = INERTIAS, attitude if by_attitude and attitude else rotors or (0.0, 0.0)
    if rotors is None:
        cause = "the gyro is mounted at an angle about the vertical axis, or the attitude is of other axes"
        quantities = (*INERTIAS, "attitude")
    elif not by_attitude or attitude is None:
        cause = "the gyro is mounted at an angle about the vertical axis, or `rotor_positions` are"
    elif abs(math.remainder(rotors[0] - attitude[0], math.tau)) < abs(rotors[0]):
        cause = "gyro and accelerometer are mounted at an angle about the vertical axis"
    else:
        cause, quantities = "the attitude is of axes at an angle about the vertical axis", ("attitude",)
    known = {name: each for name, each in (("attitude", attitude), ("rotors", rotors)) if each is not None}
    ways = " and ".join(
        f"{math.degrees(a):.1f} +- {math.degrees(2 * e):.2g} degrees by the {name}" for name, (a, e) in known.items()
    )
    remedy = "leave the attitude out, or correct it"
    if quantities != ("attitude",):
        remedy = f"{_TURN}: {math.degrees(angle[0]):.0f} degrees, counter-clockwise seen from above"
    return Finding("mounting", cause, ways, remedy, quantities, True)


def _by_rotors(evidence: Evidence) -> tuple[float, float] | None:
    """The angle of the gyro about z and its error [rad], by roll and pitch torque. `None`: unknown, or no rotation."""
    response = evidence.response
    if response is None or response.coherent[:2].sum() < 2 * _COHERENT:
        return None
    sizes = np.hypot(*response.turning.value)
    (a, b), (c, d) = response.turning.value / sizes
    errors = response.turning.error / sizes
    apart = abs(math.remainder(math.atan2(-c, a) - math.atan2(b, d), math.tau))
    across = math.hypot(errors[0, 1], errors[1, 0])
    if not apart < max(_ALONG, evidence.limits.standard_errors * across) or across > _VAGUE:
        return None
    return math.atan2(b - c, a + d), across / 2


def _by_attitude(evidence: Evidence) -> tuple[float, float] | None:
    """The angle of the gyro about z and its error [rad], by the attitude."""
    turns = evidence.turns
    if turns is None:
        return None
    (a, b), (c, d) = turns.matrix.value[:2, :2]
    size, error = math.sqrt(abs(a * d - b * c)), math.hypot(turns.matrix.error[0, 1], turns.matrix.error[1, 0])
    if a * d < b * c or error >= size:
        return None
    return math.atan2(c - b, a + d), error / (2 * size)


def earth_axes(evidence: Evidence) -> Finding | None:
    """Specific force along the axes of the earth: its horizontal part follows the tilt."""
    slope = _on_tilt(evidence)
    if slope is None or slope.value < max(_EARTH, evidence.limits.standard_errors * slope.error):
        return None
    return Finding(
        "earth_axes",
        "the specific force is along the axes of the earth, and not of the body",
        f"its horizontal part follows the tilt with a slope of {slope.value:.2f} +- {2 * slope.error:.2g}: 1 along the "
        "axes of the earth, 0 or less along those of the body",
        "log the accelerometer along the body's axes, or turn it by the attitude",
        ("thrust", *INERTIAS),
        True,
    )


def _on_tilt(evidence: Evidence) -> Measured | None:
    """The slope of ax and ay on what they are if the thrust, along the body's z axis, is given along the earth's."""
    every = []
    for piece in evidence.pieces:
        if piece.specific_force is None or np.isnan(piece.states[:, ANGLES]).all(axis=0).any():
            continue
        columns = np.hstack([piece.states[:, ANGLES], piece.specific_force])
        _, _, means = averages(piece.time, piece.omega, columns, held=piece.held)(max(_SLOW, piece.dt))
        roll, pitch, yaw, ax, ay, az = means[np.isfinite(means).all(axis=1)].T
        tilt_x = np.cos(yaw) * np.tan(pitch) + np.sin(yaw) * np.tan(roll) / np.cos(pitch)
        tilt_y = np.sin(yaw) * np.tan(pitch) - np.cos(yaw) * np.tan(roll) / np.cos(pitch)
        every.append(np.concatenate([np.stack([az * tilt_x, az * tilt_y]), np.stack([ax, ay])]))
    tilts, forces = np.split(np.concatenate(every, axis=1), 2) if every else (np.empty((2, 0)),) * 2
    if tilts.shape[1] < 4 * _BLOCKS:
        return None
    tilts, forces = (x - x.mean(axis=1, keepdims=True) for x in (tilts, forces))
    products, squares = ((tilts * x).sum(axis=0) for x in (forces, tilts))
    blocks = [(products[part].sum(), squares[part].sum()) for part in np.array_split(np.arange(products.size), _BLOCKS)]
    product, square = np.array(blocks).T
    if square.sum() <= 0:
        return None
    without = (product.sum() - product) / (square.sum() - square)
    return Measured.of(np.asarray(product.sum() / square.sum()), without)


def thrust_direction(evidence: Evidence) -> Finding | None:
    """The mean specific force in flight is not along z, or not as large as gravity."""
    force, limits = evidence.force, evidence.limits
    if not force.size:
        return None
    mean, sizes = force.mean(axis=0), np.linalg.norm(force, axis=1).mean()
    size = float(np.linalg.norm(mean))
    gravity = GRAVITY if evidence.airframe is None else float(evidence.airframe.gravity)
    share = f"mean specific force {size:.3g} m/s^2"
    if abs(size / gravity - 1) > limits.gravity:
        if _UNIT_G[0] < size < _UNIT_G[1]:
            cause, remedy = "the accelerometer is in units of g", "multiply by 9.80665"
        elif size < _UNIT_G[0]:
            cause, remedy = "gravity was subtracted from the accelerometer", "log what the accelerometer measures"
        else:
            cause, remedy = "the scale of the accelerometer is wrong", "give m/s^2: it measures gravity in hover"
        return Finding("force_scale", cause, share, remedy, ("thrust",), True)
    tilt = math.acos(min(max(mean[2] / max(size, 1e-300), -1.0), 1.0))
    if tilt < limits.tilt or size < _STEADY * sizes:
        return None
    along = ", ".join(f"{x:.2f}" for x in mean / size)
    return Finding(
        "force_direction",
        "the accelerometer is mounted at an angle, or has other axes: the thrust in flight is not along its z axis",
        f"{math.degrees(tilt):.0f} degrees, along {along}",
        f"{_TURN}, or give x forward, y left, z up",
        ("thrust", *INERTIAS),
        True,
    )


def wrong_thrust(evidence: Evidence) -> Finding | None:
    """The airframe's thrust does not carry the vehicle, by the accelerometer or by its weight."""
    every = [thrust for piece in evidence.pieces if (thrust := evidence.thrust(piece)) is not None]
    if not every or evidence.airframe is None:
        return None
    force, limits = evidence.force, evidence.limits
    felt = float(np.linalg.norm(force.mean(axis=0))) if force.size else float(evidence.airframe.gravity)
    ratio = float(np.concatenate(every).mean()) / max(felt, 1e-3)
    limit = limits.commanded_thrust if evidence.logged.commanded else limits.thrust
    if 1 / (1 + limit) < ratio < 1 + limit:
        return None
    return Finding(
        "wrong_thrust",
        "`thrust_coefficient`, `mass` or the unit of the motors is wrong: the thrust is not that of the vehicle",
        f"{ratio:.2f} times {'the specific force' if force.size else 'the weight'}",
        "weigh the vehicle, and give `hover_speed` as `jaxos4 inspect --airframe-out` writes it",
        ("thrust",),
        False,
    )
