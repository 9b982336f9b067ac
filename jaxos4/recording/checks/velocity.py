"""The velocity against specific force and attitude."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ...airframe import GRAVITY
from ...flight import ANGLES, VELOCITY
from ...logs.sampling import averages
from ..pieces import Recording
from ..velocity import rotations_to_body
from .finding import Measured

_SLOW = 0.2  # [s], samples whose accelerations are compared: velocities are noisy
_BLOCKS, _FEWEST = 12, 48  # of the jackknife; samples


def velocity_slopes(pieces: Sequence[Recording]) -> Measured | None:
    """The horizontal acceleration along and across that of force and attitude, relative to it. `None`: not measured."""
    products = [part for piece in pieces for part in _products(piece)]
    if len(products) < _FEWEST:
        return None
    blocks = np.array([np.sum(block, axis=0) for block in np.array_split(np.array(products), _BLOCKS)])
    whole = blocks.sum(axis=0)
    if whole[2] <= 0:
        return None
    without = (whole - blocks)[:, :2] / (whole - blocks)[:, 2:]
    return Measured.of(whole[:2] / whole[2], without)


def _products(piece: Recording) -> Float[np.ndarray, "samples 3"]:
    """For each sample: products along and across of the two horizontal accelerations, and the square of the second."""
    if piece.specific_force is None or not np.isfinite(piece.states[:, [*ANGLES, *VELOCITY]]).any(axis=0).all():
        return np.empty((0, 3))
    columns = np.hstack([piece.states[:, [*ANGLES, *VELOCITY]], piece.specific_force])
    _, _, means = averages(piece.time, piece.omega, columns, held=piece.held)(max(_SLOW, piece.dt))
    angles, velocity, force = means[:, :3], means[:, 3:6], means[:, 6:]
    felt = np.einsum("tji,tj->ti", rotations_to_body(*angles.T), force) - [0.0, 0.0, GRAVITY]
    gained = np.diff(velocity, axis=0) / max(_SLOW, piece.dt)
    felt = (felt[1:] + felt[:-1]) / 2
    known = np.isfinite(felt).all(axis=1) & np.isfinite(gained).all(axis=1)
    if not known.any():
        return np.empty((0, 3))
    (x, y), (u, v) = (each[known, :2].T - each[known, :2].mean(axis=0)[:, None] for each in (felt, gained))
    return np.column_stack([x * u + y * v, x * v - y * u, x * x + y * y])
