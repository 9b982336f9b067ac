"""Result files of `jaxos4 estimate` that nobody computed: an OS4's and a vehicle's, as dictionaries."""

import numpy as np
from helpers import CRAZYFLIE

from jaxos4.airframe import OS4, airframe_table, alpha_from_inertia

INERTIA = {"Ix": 7.7e-3, "Iy": 7.4e-3, "Iz": 1.29e-2, "J_R": 6.2e-5}
# A Crazyflie whose rotors do not stand symmetrically.
POSITIONS = [[0.028, -0.03], [-0.026, -0.03], [-0.028, 0.03], [0.028, 0.029]]
AIRFRAME = airframe_table(CRAZYFLIE) | {"rotor_positions": POSITIONS}
# Of the vehicle: the parameters, and their standard deviations as a share.
VALUES = {
    "alpha3": 6.1e4,
    "alpha6": 5.9e4,
    "alpha8": 3.5e4,
    "roll_offset": 0.9,
    "pitch_offset": -1.1,
    "yaw_offset": 0.3,
    "roll_thrust": -0.4,
    "pitch_thrust": 0.7,
    "roll_damping": 0.4,
    "pitch_damping": 0.5,
    "yaw_damping": 0.7,
    "rotor_lag": 0.05,
    "rotor_delay": 0.01,
    "rotor_reaction": 7e-4,
    "thrust_curve": 0.8,
    "thrust_gain": 1.1,
    "x_drag": 0.3,
    "y_drag": 0.4,
}
SHARE = 0.01


def os4_result(**changes):
    """A corrected OS4, identified from one flight. Every alpha has a standard deviation of 1 %."""
    *inertia, rotor = INERTIA.values()
    alpha = np.asarray(alpha_from_inertia(np.array(inertia), np.array(rotor)))
    std = SHARE * np.maximum(np.abs(alpha), 1e-3)
    names = [f"alpha{i}" for i in range(1, 9)]
    return {
        "estimator": "ibss",
        "model": "corrected",
        "result": "successful",
        "parameters": {name: {"estimate": a, "std": s} for name, a, s in zip(names, alpha, std, strict=True)},
        "constants": {name: {"estimate": value, "std": SHARE * value} for name, value in INERTIA.items()},
        "provenance": {"version": "0.5.0"},
        "airframe": airframe_table(OS4),
        "covariance": np.diag(std**2).tolist(),
    } | changes


def vehicle_result(values=VALUES, **changes):
    """A vehicle, identified by filter error. Every parameter has a standard deviation of 1 %."""
    std = SHARE * np.abs(list(values.values()))
    return {
        "estimator": "filter-error",
        "model": "flight",
        "result": "successful",
        "parameters": {name: {"estimate": v, "std": s} for (name, v), s in zip(values.items(), std, strict=True)},
        "held": {"alpha1": {"value": -0.7}},
        "constants": {},
        "provenance": {"version": "0.5.0"},
        "airframe": AIRFRAME,
        "covariance": np.diag(std**2).tolist(),
    } | changes
