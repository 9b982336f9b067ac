"""The constant error of the accelerometer along z, from flight and from rest before take-off."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..logs import Recording
from .motion import Ups

KEEPS = 0.2  # m/s^2; standard deviation of the error's change from rest to flight, as sensors warm up and vibrate
AGREE = 3.0  # standard deviations; if flight and rest differ by more, drag or manoeuvres have misled the flight


def force_level(
    fitted: Recording,
    ups: Sequence[Ups],
    rests: Sequence[Float[np.ndarray, "3"]],
    gravity: float,
) -> tuple[float, float] | None:
    """The constant error of the accelerometer along z, and its standard deviation [m/s^2]. `None`: unknown.

    **Arguments:**

    - `fitted`, `ups`: a flight, and the upright direction in its stretches, see `velocity_of`.
    - `rests`: the specific force before take-off, where it is known [m/s^2].
    """
    flown = _by_flight(fitted, ups, gravity)
    if not rests:
        return flown
    rest = float(np.mean([np.linalg.norm(force) for force in rests])) - gravity
    if flown is None or abs(flown[0] - rest) > AGREE * math.hypot(flown[1], KEEPS):
        return rest, KEEPS
    weights = np.array([flown[1], KEEPS]) ** -2.0
    return float(weights @ [flown[0], rest] / weights.sum()), float(weights.sum() ** -0.5)


GAINED = 1.0  # m/s; the most velocity that a vehicle gains over a stretch
UNCARRIED = 0.003  # share of the weight that the mean force may miss
UPRIGHT = 0.5  # smallest mean cosine of the tilt


def _by_flight(
    fitted: Recording,
    every: Sequence[Ups],
    gravity: float,
) -> tuple[float, float] | None:
    """The mean vertical component of the specific force minus gravity, and its standard deviation [m/s^2].

    A vehicle gains little velocity over a stretch, so on average the force carries its weight.
    """
    force = fitted.specific_force
    if not every or force is None or not (known := np.isfinite(force).all(axis=1)).any():
        return None
    ups = [np.concatenate(each)[known] for each in zip(*every, strict=True)]
    other, along = ((force[known] * up).sum(axis=1).mean() for up in ups)
    cosine = ups[-1][:, 2].mean()
    if cosine < UPRIGHT or force[known, 2].mean() < 0:  # the second: the z axis points down
        return None
    drift = GAINED * math.sqrt(len(every)) / (np.count_nonzero(known) * fitted.dt)
    return (along - gravity) / cosine, math.hypot(drift, UNCARRIED * gravity, along - other) / cosine
