"""Predictions of RotorPy's flights by the vehicle that was identified in another flight, beside the true parameters."""

from collections.abc import Sequence

import numpy as np

import jaxos4
from experiments.fits import given_airframe, whole
from experiments.rotorpy.flights import VEHICLE, quad_params

QUANTITIES = ("position", "velocity", "attitude", "rates")


def true_parameters(vehicle: jaxos4.forecast.Vehicle) -> np.ndarray:
    """RotorPy's vehicle as parameters of the model: all but its drag of second order and its translational lift."""
    gain = float(VEHICLE.thrust_coefficient / vehicle.model.airframe.thrust_coefficient)
    inertia, places = np.asarray(VEHICLE.inertia), np.asarray(VEHICLE.rotor_positions)
    speeds = 4 * float(VEHICLE.hover_speed)
    x, y = np.square(places).mean(axis=0)
    # The axial drag of the rotors damps roll and pitch, and that in their plane damps yaw.
    damping = (
        speeds * np.array([quad_params["k_z"] * y, quad_params["k_z"] * x, quad_params["k_d"] * (x + y)]) / inertia
    )
    known = dict(zip([f"alpha{i}" for i in range(1, 9)], np.asarray(jaxos4.CorrectedOS4(VEHICLE).alpha), strict=True))
    known |= {name: gain / moment for name, moment in zip(("alpha3", "alpha6", "alpha8"), inertia, strict=True)}
    known |= dict(zip(("roll_damping", "pitch_damping", "yaw_damping"), damping, strict=True)) | {"thrust_gain": gain}
    drag = zip("xyz", ("k_d", "k_d", "k_z"), strict=True)
    known |= {f"{axis}_drag": speeds * quad_params[name] / float(VEHICLE.mass) for axis, name in drag}
    return np.array([float(known.get(name, 0.0)) for name in vehicle.model.parameter_names])


def prediction(flights: Sequence[jaxos4.Flight], i: int, horizon: float = 0.5) -> dict:
    """Identify flight `i` and predict the next one. Errors and shares inside the 95 % band at the horizon."""
    flight, other = flights[i], flights[(i + 1) % len(flights)]
    found = jaxos4.identify(flight, given_airframe(VEHICLE, i), settings=whole(flight), estimator="filter-error")
    vehicle = jaxos4.forecast.vehicle_of(found)
    true = vehicle._replace(parameters=true_parameters(vehicle), covariance=0 * vehicle.covariance)
    own, best = (jaxos4.predict(each, other, horizon=horizon).quality for each in (vehicle, true))
    row: dict = {"result": found.result}
    for name in QUANTITIES:
        row[name] = {"error": own[name].error[-1], "true": best[name].error[-1], "held": own[name].coverage[-1]}
    return row
