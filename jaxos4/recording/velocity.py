"""The velocity along the body's axes and the upright direction, measured or by dead reckoning."""

import math

import numpy as np
from jaxtyping import Float

from ..airframe import GRAVITY
from ..flight import STATE_NAMES
from .pieces import Recording

# Dead reckoning forgets its velocity with this time constant [s].
_FORGETS = 2.0
# The upright direction is drawn to the specific force with these time constants [s]: the first forgets errors of the
# gyro sooner, the second holds in longer turns.
_LEVELS = (2.0, 8.0)
_ANGLES, _VELOCITY, _RATES = ("phi", "theta", "psi"), ("vx", "vy", "vz"), ("p", "q", "r")


Ups = tuple[Float[np.ndarray, "_samples 3"], Float[np.ndarray, "_samples 3"]]


def velocity_of(recording: Recording) -> tuple[Float[np.ndarray, "samples 3"], Ups] | None:
    """How a vehicle moved through still air; `None` if the log does not say enough.

    A velocity that was not measured follows from gyro and accelerometer: v' = force - g up - rates x v. Slow errors of
    this sum are forgotten, and so are slow changes of the velocity. Torque and thrust answer a change of
    velocity faster than this.

    **Arguments:** a recording in one piece, without gaps.

    **Returns:** the velocity along the body's axes [m/s], and the upright direction in these axes by each time
    constant. They differ in long turns, and if the gyro errs. Both are the same if the attitude was measured.
    """
    angles, velocity = (_filled(recording, names) for names in (_ANGLES, _VELOCITY))
    to_body = None if angles is None else rotations_to_body(*angles.T)
    if to_body is not None and velocity is not None:
        return np.einsum("tij,tj->ti", to_body, velocity), (to_body[:, :, 2], to_body[:, :, 2])
    rates, force = _filled(recording, _RATES), recording.specific_force
    if rates is None or force is None or np.isnan(force).all(axis=0).any():
        return None
    force = _without_gaps(force)
    if to_body is None:
        up, slow = (_upright(rates, force, recording.dt, levels) for levels in _LEVELS)
    else:
        up = slow = to_body[:, :, 2]
    return _dead_reckoned(rates, force, up, recording.dt), (up, slow)


def measures_velocity(recording: Recording) -> bool:
    """Whether a recording has a velocity, and the attitude that turns it into the body's axes."""
    return _filled(recording, _ANGLES + _VELOCITY) is not None


def _filled(recording: Recording, names: tuple[str, ...]) -> Float[np.ndarray, "samples columns"] | None:
    values = recording.states[:, [STATE_NAMES.index(name) for name in names]]
    return None if np.isnan(values).all(axis=0).any() else _without_gaps(values)


def _without_gaps(values: Float[np.ndarray, "samples columns"]) -> Float[np.ndarray, "samples columns"]:
    """Each gap gets the value before it, or the first one."""
    measured, index = ~np.isnan(values), np.arange(len(values))[:, None]
    source = np.maximum(np.maximum.accumulate(np.where(measured, index, -1)), measured.argmax(axis=0))
    return np.take_along_axis(values, source, axis=0)


def rotations_to_body(phi: np.ndarray, theta: np.ndarray, psi: np.ndarray) -> Float[np.ndarray, "samples 3 3"]:
    """The rotations from the earth frame, the inverse of R_z(psi) R_y(theta) R_x(phi)."""
    (sx, cx), (sy, cy), (sz, cz) = ((np.sin(angle), np.cos(angle)) for angle in (phi, theta, psi))
    rows = (
        (cz * cy, sz * cy, -sy),
        (cz * sy * sx - sz * cx, sz * sy * sx + cz * cx, cy * sx),
        (cz * sy * cx + sz * sx, sz * sy * cx - cz * sx, cy * cx),
    )
    return np.moveaxis(np.array(rows), -1, 0)


def _dead_reckoned(
    rates: Float[np.ndarray, "samples 3"],
    force: Float[np.ndarray, "samples 3"],
    up: Float[np.ndarray, "samples 3"],
    dt: float,
) -> Float[np.ndarray, "samples 3"]:
    """The velocity; each sample uses measurements until then, and the accelerometer's mean error.

    Plain numbers: in a loop of few operations they are ten times faster than arrays.
    """
    push = force - GRAVITY * up
    push -= (push * up).sum(axis=1).mean() * up  # a flight does not climb for ever
    kept, (vx, vy, vz), velocities = math.exp(-dt / _FORGETS), (0.0, 0.0, 0.0), []
    for (p, q, r), (ax, ay, az) in zip(rates.tolist(), push.tolist(), strict=True):
        velocities.append((vx, vy, vz))
        vx, vy, vz = (
            kept * (vx + dt * (ax - q * vz + r * vy)),
            kept * (vy + dt * (ay - r * vx + p * vz)),
            kept * (vz + dt * (az - p * vy + q * vx)),
        )
    return np.array(velocities)


def _upright(
    rates: Float[np.ndarray, "samples 3"], force: Float[np.ndarray, "samples 3"], dt: float, levels: float
) -> Float[np.ndarray, "samples 3"]:
    """The upright direction: fixed in the earth, so it turns against the body; slowly drawn to the specific force.

    `levels`: the time constant of this [s].
    """
    x, y, z, turn, directions = 0.0, 0.0, 1.0, dt / levels, []
    drawn = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-3)
    for (p, q, r), (ax, ay, az) in zip(rates.tolist(), drawn.tolist(), strict=True):
        directions.append((x, y, z))
        x, y, z = (
            x + dt * (y * r - z * q) + turn * (ax - x),
            y + dt * (z * p - x * r) + turn * (ay - y),
            z + dt * (x * q - y * p) + turn * (az - z),
        )
        length = math.sqrt(x * x + y * y + z * z) or 1.0
        x, y, z = x / length, y / length, z / length
    return np.array(directions)
