"""How much a flight excites each axis, and how noisy the gyro is."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..airframe import Airframe
from ..flight import STATE_NAMES, Flight

RATE_COLUMNS = tuple(STATE_NAMES.index(name) for name in ("p", "q", "r"))
_ANGLE_COLUMNS = tuple(STATE_NAMES.index(name) for name in ("phi", "theta", "psi"))
_GOOD, WEAK = 0.3, 0.1  # [rad/s], standard deviation of a body rate
_OVER_NOISE = 5.0  # a rate below this many times the gyro's noise is not excited


class Excitation(NamedTuple):
    """How much a flight excites one axis.

    - `axis`: roll, pitch or yaw.
    - `torque`: standard deviation of the rotors' torque [N m]; NaN without an airframe.
    - `rate`: standard deviation of the body rate [rad/s]; NaN if neither it nor its angle was measured.
    - `noise`: standard deviation of the gyro's white noise [rad/s], see `gyro_noise`.
    - `verdict`: "good", "weak", "none" or "not measured".
    """

    axis: str
    torque: float
    rate: float
    noise: float
    verdict: str


def excitation(flight: Flight, airframe: Airframe | None = None) -> tuple[Excitation, Excitation, Excitation]:
    """The excitation of roll, pitch and yaw over the whole flight; the torque needs an airframe."""
    omega, states = np.asarray(flight.omega, dtype=float), np.asarray(flight.states, dtype=float)
    torque = np.full(3, math.nan)
    if airframe is not None:
        torque = (omega[:-1] ** 2 @ np.asarray(airframe.mixer, dtype=float).T)[:, :3].std(axis=0)
    found = []
    for i, axis in enumerate(("roll", "pitch", "yaw")):
        rate = states[:, RATE_COLUMNS[i]]
        noise = gyro_noise(rate)
        if np.count_nonzero(np.isfinite(rate)) < 3:
            rate = _slope(np.asarray(flight.time, dtype=float), states[:, _ANGLE_COLUMNS[i]])
        size = float(np.nanstd(rate)) if np.isfinite(rate).any() else math.nan
        found.append(Excitation(axis, float(torque[i]), size, noise, _verdict(size, noise)))
    return found[0], found[1], found[2]


def gyro_noise(rate: Float[np.ndarray, " samples"]) -> float:
    """The standard deviation of the white noise on a body rate [rad/s]; NaN if too little was measured.

    It follows from the median size of second differences: motion is smooth from sample to sample, noise is not.
    """
    second = np.diff(rate, 2)
    second = np.abs(second[np.isfinite(second)])
    return float(np.median(second)) / 0.6745 / math.sqrt(6) if second.size else math.nan


def _verdict(size: float, noise: float) -> str:
    if math.isnan(size):
        return "not measured"
    if size < WEAK or (not math.isnan(noise) and size < _OVER_NOISE * noise):
        return "none"
    return "good" if size >= _GOOD else "weak"


def _slope(time: np.ndarray, angle: np.ndarray) -> np.ndarray:
    measured = np.isfinite(angle)
    if np.count_nonzero(measured) < 3:
        return np.full(1, math.nan)
    return np.gradient(angle[measured], time[measured])
