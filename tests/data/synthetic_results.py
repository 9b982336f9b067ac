"""Result files of `jaxos4 estimate` that nobody computed, as dictionaries."""

import numpy as np
from helpers import CRAZYFLIE

from jaxos4.airframe import airframe_table

# A Crazyflie whose rotors do not stand symmetrically.
POSITIONS = [[0.028, -0.03], [-0.026, -0.03], [-0.028, 0.03], [0.028, 0.029]]
AIRFRAME = airframe_table(CRAZYFLIE) | {"rotor_positions": POSITIONS}
# The parameters of the vehicle, and the standard deviations of all parameters as a share.
VALUES = {"alpha3": 6.1e4, "alpha6": 5.9e4, "alpha8": 3.5e4}
VALUES |= {"roll_offset": 0.9, "pitch_offset": -1.1, "yaw_offset": 0.3, "roll_thrust": -0.4, "pitch_thrust": 0.7}
VALUES |= {"roll_damping": 0.4, "pitch_damping": 0.5, "yaw_damping": 0.7, "rotor_lag": 0.05, "rotor_delay": 0.01}
VALUES |= {"rotor_reaction": 7e-4, "thrust_curve": 0.8, "thrust_gain": 1.1, "x_drag": 0.3, "y_drag": 0.4, "z_drag": 0.6}
VALUES |= {"roll_velocity": 0.2, "pitch_velocity": -0.1}
SHARE = 0.01


def row(estimate, std):
    """A parameter of a result."""
    return {"estimate": estimate, "std": std, "bound": std, "ci95": None, "unit": "", "note": ""}


def held(value):
    """A parameter that was not estimated."""
    return {"value": value, "unit": "", "note": ""}


def provenance(**fields):
    """Where a result is from."""
    versions = {"version": "0.6.0", "jax": "0.10.0", "device": "cpu", "precision": "float64"}
    return {"airframe": "custom", "terms": [], "sample_time": 0.01, "fitted_seconds": 60.0, **versions, **fields}


def vehicle_result(values=VALUES, **changes):
    """A vehicle, identified by filter error. Every parameter has a standard deviation of 1 %."""
    fixed = {"estimator": "filter-error", "model": "flight", "constants": {}, "airframe": AIRFRAME}
    std = {name: SHARE * abs(value) for name, value in values.items()}
    return {
        "result": "successful",
        "parameters": {name: row(value, std[name]) for name, value in values.items()},
        "provenance": provenance(),
        "covariance": np.diag(np.square(list(std.values()))).tolist(),
        "held": {"alpha1": held(-0.7)},
        **fixed,
        **changes,
    }


def predicting_result():
    """A vehicle with all that predictions need: fixed parameters, offsets, damping, disturbances of the rates."""
    level = {"strength": 1.0, "unit": "", "time_constant": 0.2, "sensor": 0.01, "correlation": 0.0}
    values = {"alpha3": 6e4, "alpha6": 5.9e4, "alpha8": 3.5e4}
    values |= {f"{axis}_{kind}": 0.1 for kind in ("offset", "damping") for axis in ("roll", "pitch", "yaw")}
    fixed = {f"alpha{i}": held(0.1) for i in (1, 2, 4, 5, 7)}
    about = provenance(terms=["offset", "damping"])
    return vehicle_result(values, disturbances=dict.fromkeys("pqr", level), provenance=about, held=fixed)
