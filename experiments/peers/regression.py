"""Regression of torque and angular acceleration from filtered signals, as data-driven-dynamics and sysid.tools do.

The gyro is low-pass filtered forward and backward and differentiated, and all other signals pass the same filter. Each
axis is linear least squares with an offset, a damping and the gyroscopic torque. Lag and delay of the rotors are those
with the smallest residuals in roll and pitch. The accelerometer gives the thrust coefficient. Which side has the error
is a setting: the acceleration (as in data-driven-dynamics), or the torque.
"""

import itertools

import numpy as np
from scipy.optimize import minimize
from scipy.signal import butter, sosfiltfilt

from experiments.peers.log import Fit, Log

SETTINGS = tuple(
    {"cutoff": cutoff, "response": response}
    for cutoff, response in itertools.product((2.0, 4.0, 8.0, 16.0, 30.0), ("acceleration", "torque"))
)


def _least_squares(columns: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solution, its standard deviations by white residuals, and the residuals."""
    found = np.linalg.lstsq(columns, value, rcond=None)[0]
    left = value - columns @ found
    variance = left @ left / (len(value) - columns.shape[1])
    return found, np.sqrt(variance * np.diagonal(np.linalg.inv(columns.T @ columns))), left


def fit(log: Log, cutoff: float, response: str) -> Fit:
    """Moments of inertia with the filter's `cutoff` [Hz]."""
    filtering = butter(2, min(cutoff, 0.45 / log.dt), fs=1 / log.dt, output="sos")
    edge = int(1 / (cutoff * log.dt))  # samples of the filter's transient

    def smooth(x: np.ndarray) -> np.ndarray:
        return sosfiltfilt(filtering, x, axis=0)[edge:-edge]

    rates = smooth(log.rates)
    p, q, r = rates.T
    turning = smooth(np.gradient(log.rates, log.dt, axis=0))
    mixer, rotor = np.asarray(log.airframe.mixer), float(log.airframe.rotor_inertia)
    spins, given = np.asarray(log.airframe.rotor_spins), np.asarray(log.airframe.inertia)

    def forces(lag: float, delay: float) -> tuple[np.ndarray, np.ndarray]:
        """Torques and thrust of the given airframe, and torques of the rotors' own inertia."""
        speeds = log.speeds(lag, delay)
        total, spin_up = smooth(speeds @ spins), smooth(np.gradient(speeds, log.dt, axis=0) @ spins)
        return smooth(speeds**2 @ mixer.T), rotor * np.column_stack([-q * total, p * total, -spin_up])

    def axes(lag: float, delay: float, gain: float, response: str):
        """Each moment of inertia, its standard deviation, and the residuals."""
        torques, spinning = forces(lag, delay)
        for i, crossed in enumerate((q * r, p * r, p * q)):
            torque = gain * torques[:, i] + spinning[:, i]
            shared = [crossed, np.ones_like(p), rates[:, i]]
            if response == "acceleration":
                found, std, left = _least_squares(np.column_stack([torque / given[i], *shared]), turning[:, i])
                yield given[i] / found[0], given[i] * std[0] / found[0] ** 2, left
            else:
                found, std, left = _least_squares(np.column_stack([turning[:, i], *shared]), torque / given[i])
                yield given[i] * found[0], given[i] * std[0], left

    def cost(unknowns: np.ndarray) -> float:
        # With the torque as response, a long lag would make all residuals small.
        return sum(
            np.log(left @ left)
            for _, _, left in itertools.islice(axes(unknowns[0], unknowns[1], 1.0, "acceleration"), 2)
        )

    limits = (0.0, 0.15 if log.commands else 0.0), (-0.01, 0.05)
    starts = itertools.product((0.02, 0.05) if log.commands else (0.0,), (0.0, 0.01))
    best = min(starts, key=lambda start: cost(np.array(start)))
    simplex = np.array(best) + [[0, 0], [0.01 * log.commands, 0], [0, 0.005]]
    settings = {"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-4, "maxiter": 80}
    lag, delay = minimize(cost, best, method="Nelder-Mead", bounds=limits, options=settings).x
    thrust = forces(lag, delay)[0][:, 3:] / float(log.airframe.mass)
    (gain,), (gain_std,), _ = _least_squares(thrust, smooth(log.force))
    inertia, std, _ = zip(*axes(lag, delay, gain, response), strict=True)
    share = np.hypot(np.array(std) / inertia, gain_std / gain)
    return Fit(np.array(inertia), np.abs(inertia) * share, [])
