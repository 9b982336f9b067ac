"""Checks of the sensors' mounting by the rotors, the attitude and the thrust in hover; and checks of the thrust."""

import math
import operator
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ..._custom_types import Numeric
from ...airframe import GRAVITY, INERTIAS, YAW
from ...rotations import angles_of, rotation
from .estimates import BATCHES, Measured, batched, jackknife
from .evidence import EXPLAINED, STANDARD_ERRORS, Evidence, Finding

ANGLE = 0.14  # rad about the vertical axis; 20 degrees change inertias by 8 %, 8 degrees by 1 %


def turned_about_vertical(evidence: Evidence) -> Finding | None:
    """Gyro turned about the vertical axis: roll torque pitches the vehicle, and the attitude turns about other axes."""
    rotors, attitude = _by_rotors(evidence), _by_attitude(evidence)
    if tilted_force(evidence):
        return None  # the angle about z is known only after this is corrected

    def turned(angle: tuple[float, float] | None) -> bool:
        return angle is not None and abs(angle[0]) > max(ANGLE, STANDARD_ERRORS * angle[1])

    by_attitude, by_rotors = turned(attitude), turned(rotors)
    if not by_attitude and not by_rotors:
        return None
    quantities, angle = INERTIAS, attitude if by_attitude and attitude else rotors or (0.0, 0.0)
    if rotors is None:
        cause = "the gyro is mounted at an angle about the vertical axis, or the attitude has other axes"
        quantities = (*INERTIAS, "attitude")
    elif not by_attitude or attitude is None:
        cause = "the gyro is mounted at an angle about the vertical axis, or `rotor_positions` are"
    elif abs(math.remainder(rotors[0] - attitude[0], math.tau)) < abs(rotors[0]):
        cause = "gyro and accelerometer are mounted at an angle about the vertical axis"
    else:
        cause, quantities = "the attitude has axes turned about the vertical axis", ("attitude",)
    known = {name: each for name, each in (("attitude", attitude), ("rotors", rotors)) if each is not None}
    ways = " and ".join(
        f"{math.degrees(a):.1f} +- {math.degrees(2 * e):.2g} degrees by the {name}" for name, (a, e) in known.items()
    )
    remedy = "leave the attitude out, or correct it"
    if quantities != ("attitude",):
        turn = rotation(np.array([0.0, 0.0, angle[0]]))
        remedy = f"{_rotation_for(evidence, turn)}: counter-clockwise seen from above"
    return Finding("mounting", cause, ways, remedy, quantities)


def _rotation_for(evidence: Evidence, turn: Float[Numeric, "3 3"]) -> str:
    """The advice to give the rotation that turns the sensors further by the matrix `turn`."""
    axes = np.asarray(turn)
    if evidence.airframe is not None:
        axes = axes @ np.asarray(evidence.airframe.sensor_axes)
    degrees = ", ".join(f"{round(math.degrees(angle)) + 0}" for angle in angles_of(axes))
    return f"give `sensor_rotation = [{degrees}]` [deg] in the airframe's file"


def opposite_yaw(axes: Mapping[str, float]) -> Finding | None:
    """A vehicle that yaws against the torque. `axes`: of `jaxos4.recording.motion.opposite_axes`."""
    if "yaw" not in axes:
        return None
    return Finding(
        "yaw_sign",
        "yaw answers the rotors with the opposite sign",
        f"torque and angular acceleration correlate by {-axes['yaw']:.2f}",
        "the rotors may turn the other way than `rotor_spins` of the airframe say (props in or out): change "
        "all four signs",
        (YAW.inertia,),
    )


UNCERTAIN = 0.2  # rad; a rotation from the rotors with a larger error comes from a wrong airframe
SAME_ANGLE = 0.17  # rad; a rotation turns roll and pitch by the same angle to within this


def _by_rotors(evidence: Evidence) -> tuple[float, float] | None:
    """The angle of the gyro about z and its error [rad], by roll and pitch torque. `None`: unknown, or no rotation."""
    response = evidence.response
    if response is None or response.explained[:2].sum() < EXPLAINED[0]:
        return None
    turning, errors = response.turning
    sizes = np.hypot(*turning)
    (a, b), (c, d) = turning / sizes
    errors = errors / sizes
    apart = abs(math.remainder(math.atan2(-c, a) - math.atan2(b, d), math.tau))
    across = math.hypot(errors[0, 1], errors[1, 0])
    if not apart < max(SAME_ANGLE, STANDARD_ERRORS * across) or across > UNCERTAIN:
        return None
    return math.atan2(b - c, a + d), across / 2


def _by_attitude(evidence: Evidence) -> tuple[float, float] | None:
    """The angle of the gyro about z and its error [rad], by the attitude."""
    turns = evidence.turns
    if turns is None:
        return None
    matrix, errors = turns.matrix[:, :2, :2]
    (a, b), (c, d) = matrix
    size, error = math.sqrt(abs(a * d - b * c)), math.hypot(errors[0, 1], errors[1, 0])
    if a * d < b * c or error >= size:
        return None
    return math.atan2(c - b, a + d), error / (2 * size)


ALONG_EARTH = 0.6  # slope of the horizontal force on the tilt: 1 along the earth's axes, 0 or less along the body's


def earth_axes(evidence: Evidence) -> Finding | None:
    """Specific force along the axes of the earth: its horizontal part follows the tilt."""
    if evidence.tilt is None:
        return None
    (slope, _), (error, _) = evidence.tilt
    if slope < max(ALONG_EARTH, STANDARD_ERRORS * error):
        return None
    return Finding(
        "earth_axes",
        "the specific force is along the axes of the earth, and not of the body",
        f"its horizontal part follows the tilt with a slope of {slope:.2f} +- {2 * error:.2g}: 1 along the "
        "axes of the earth, 0 or less along those of the body",
        "log the accelerometer along the body's axes, or turn it by the attitude",
        ("thrust", *INERTIAS),
    )


TILT = 0.26  # rad; of the accelerometer against the thrust; sensor errors and steady wind reach half of this
STEADY = 0.9  # in a hand or in rolls, the mean vector of the force is shorter than this share of its mean size


def thrust_direction(evidence: Evidence) -> Finding | None:
    """The specific force is not along z, or not as large as gravity: at rest before take-off, or else in flight.

    The mean in flight includes drag and manoeuvres. A vehicle that rests on a slope is not tilted in flight.
    """
    flown, rest = evidence.force, evidence.rest
    if not flown.size and rest is None:
        return None
    mean = flown.mean(axis=0) if rest is None else rest
    size = float(np.linalg.norm(mean))
    if scale := _force_scale(evidence, size):
        return scale
    tilt, steady = _tilt(mean), STEADY * np.linalg.norm(flown, axis=1).mean() if flown.size else math.inf
    if tilt < TILT:
        return None
    if rest is None:
        if size < steady:
            return None
    elif not flown.size or _tilt(flown.mean(axis=0)) < TILT:
        return None
    roll = math.atan2(mean[1], mean[2])
    pitch = -math.atan2(mean[0], math.hypot(mean[1], mean[2]))
    level = rotation(np.array([roll, pitch, 0.0]))
    along = ", ".join(f"{x:.2f}" for x in mean / size)
    return Finding(
        "force_direction",
        "the accelerometer is mounted at an angle, or has other axes: the thrust in flight is not along its z axis",
        f"{math.degrees(tilt):.0f} degrees, along {along}" + ("" if rest is None else ", at rest before take-off"),
        f"log x forward, y left, z up, or {_rotation_for(evidence, level)}: the angle about z is not known",
        ("thrust", *INERTIAS),
    )


def _tilt(force: Float[np.ndarray, "3"]) -> float:
    """The angle between a force and the z axis [rad]."""
    return math.acos(min(max(float(force[2]) / max(float(np.linalg.norm(force)), 1e-300), -1.0), 1.0))


AT_REST = 0.05  # of the specific force before take-off, relative to gravity; accelerometers err by up to 3 %
GRAVITY_ERROR = 0.3  # of the mean specific force in flight, which is up to 10 % larger in brisk flight


def _force_scale(evidence: Evidence, size: float) -> Finding | None:
    """A specific force whose `size` [m/s^2], at rest or else the mean in flight, is not gravity."""
    resting = evidence.rest is not None
    gravity = GRAVITY if evidence.airframe is None else float(evidence.airframe.gravity)
    off = abs(size / gravity - 1)
    if off <= (AT_REST if resting else GRAVITY_ERROR):
        return None
    share = f"{size:.3g} m/s^2 at rest before take-off" if resting else f"mean specific force {size:.3g} m/s^2"
    if 0.8 < size < 1.25:
        cause, remedy = "the accelerometer is in units of g", "multiply by 9.80665"
    elif size <= 0.8:
        cause, remedy = "gravity was subtracted from the accelerometer", "log what the accelerometer measures"
    elif off <= GRAVITY_ERROR:
        cause, remedy = f"the accelerometer has an error of {100 * off:.0f} %", "calibrate it"
    else:
        cause, remedy = "the scale of the accelerometer is wrong", "give m/s^2: it measures gravity in hover"
    return Finding("force_scale", cause, share, remedy, ("thrust",), off > GRAVITY_ERROR)


def tilted_force(evidence: Evidence) -> bool:
    """Whether the accelerometer has other axes than the thrust."""
    tilted = thrust_direction(evidence)
    return tilted is not None and tilted.name == "force_direction"


# Largest relative errors of the airframe's thrust, for measured speeds and for commands. The fit measures the thrust by
# the accelerometer, so errors of 20 % are harmless.
THRUST, COMMANDED_THRUST = 0.35, 1.0


def wrong_thrust(evidence: Evidence) -> Finding | None:
    """The airframe's thrust does not carry the vehicle, by the accelerometer or by its weight."""
    every = [thrust for each in evidence.stretches if (thrust := evidence.thrust(each)) is not None]
    if not every or evidence.airframe is None:
        return None
    force = evidence.force
    felt = float(np.linalg.norm(force.mean(axis=0))) if force.size else float(evidence.airframe.gravity)
    ratio = float(np.concatenate(every).mean()) / max(felt, 1e-3)
    limit = COMMANDED_THRUST if evidence.logged.commanded else THRUST
    if 1 / (1 + limit) < ratio < 1 + limit:
        return None
    return Finding(
        "wrong_thrust",
        "`thrust_coefficient`, `mass` or the unit of the motors is wrong: the thrust does not fit the vehicle",
        f"{ratio:.2f} times {'the specific force' if force.size else 'the weight'}",
        "weigh the vehicle, and give `hover_speed` as `jaxos4 inspect --airframe-out` writes it",
        ("thrust",),
        False,
    )


# Largest relative differences of the thrust between two logs of one vehicle, for measured speeds and for commands. A
# battery that empties changes the thrust of a command by up to 30 %.
VEHICLES, COMMANDED_VEHICLES = 0.1, 0.4


def different_thrust(every: Sequence[Evidence]) -> Finding | None:
    """Recordings that are not of one vehicle, by the measured force for the rotor speeds.

    Without an accelerometer, thrust is compared with the weight.
    """
    with np.errstate(all="ignore"):  # numbers that no vehicle has may overflow
        ratios = [ratio for evidence in every if (ratio := _thrust_ratio(evidence)) is not None]
    if len(ratios) < 2:
        return None
    (least, least_error), (most, most_error) = (choose(ratios, key=operator.itemgetter(0)) for choose in (min, max))
    apart = float(most / least) - 1
    error = STANDARD_ERRORS * np.hypot(least_error / least, most_error / most)
    commanded = any(evidence.logged.commanded for evidence in every)
    if apart < max(VEHICLES, error):
        return None
    return Finding(
        "different_vehicles",
        "the logs are of vehicles of different mass or thrust" + (", or of different batteries" if commanded else ""),
        f"the same rotors lift {100 * apart:.0f} % more in one log than in another",
        "fit them separately, each with its own mass" + ("; log the battery's voltage" if commanded else ""),
        ("thrust", *INERTIAS),
        bool(not commanded or apart > COMMANDED_VEHICLES),
    )


def _thrust_ratio(evidence: Evidence) -> Measured | None:
    """The mean vertical specific force over the thrust per mass of the airframe."""
    every = [np.empty((0, 2))]
    for each in evidence.stretches:
        thrust = evidence.thrust(each)
        if thrust is None or evidence.airframe is None:
            return None
        weight = np.full(thrust.size, float(evidence.airframe.gravity))
        force = weight if each.specific_force is None else each.specific_force[:, 2]
        every.append(np.column_stack([force, thrust])[np.isfinite(force)])
    both = np.concatenate(every)
    if len(both) < BATCHES or both.mean(axis=0).min() <= 0:
        return None
    return jackknife(batched(both), lambda sums: sums[0] / sums[1])
