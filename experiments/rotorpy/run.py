"""Are the intervals right if the truth is RotorPy's, not ours?

Each flight: AscTec's Hummingbird as RotorPy simulates it, under RotorPy's SE3 controller, which knows the true state.
The references are sums of sines and steps. The airframe that is given has a thrust coefficient that is 20 % wrong and
moments of inertia that are 25 % wrong; its mass and arms are right. The log has a gyro, an accelerometer, the attitude
and measured rotor speeds. RotorPy's vehicle has effects that the model has otherwise or not at all: see `flights.py`.
"""

import functools
from pathlib import Path

import numpy as np

import jaxos4
from experiments.fits import INERTIAS, fit, given_airframe, print_summaries, whole
from experiments.monte_carlo import Row, check_names, print_table, product, study
from experiments.rotorpy.flights import GUSTS, VEHICLE, quad_params, recorded
from experiments.shared import Count, Estimators, Out, Seed
from jaxos4.estimators import ESTIMATORS

QUANTITIES = ("position", "velocity", "attitude", "rates")


def read(recordings: Path, settings: Row, kind: str, *, captured: bool = False) -> list[jaxos4.Flight]:
    """The flights of a kind; those that are missing are flown."""
    about = GUSTS[kind], settings["duration"], settings["seed"]
    paths = (recorded(recordings, i, *about, captured=captured) for i in range(settings["flights"]))
    return [jaxos4.read_flight(path) for path in paths]


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
    known |= {name: gain / moment for name, moment in zip(INERTIAS.values(), inertia, strict=True)}
    known |= dict(zip(("roll_damping", "pitch_damping", "yaw_damping"), damping, strict=True)) | {"thrust_gain": gain}
    drag = zip("xyz", ("k_d", "k_d", "k_z"), strict=True)
    known |= {f"{axis}_drag": speeds * quad_params[name] / float(VEHICLE.mass) for axis, name in drag}
    return np.array([float(known.get(name, 0.0)) for name in vehicle.model.parameter_names])


def prediction(flights: list[jaxos4.Flight], i: int, horizon: float = 0.5) -> Row:
    """Identify flight `i` and predict the next one. Errors and shares inside the 95 % band at the horizon."""
    flight, other = flights[i], flights[(i + 1) % len(flights)]
    found = jaxos4.identify(flight, given_airframe(VEHICLE, i), settings=whole(flight), estimator="filter-error")
    vehicle = jaxos4.forecast.vehicle_of(found)
    true = vehicle._replace(parameters=true_parameters(vehicle), covariance=0 * vehicle.covariance)
    own, best = (jaxos4.predict(each, other, horizon=horizon).quality for each in (vehicle, true))
    row: Row = {"result": found.result}
    for name in QUANTITIES:
        row[name] = {"error": own[name].error[-1], "true": best[name].error[-1], "held": own[name].coverage[-1]}
    return row


def main(
    recordings: Path,
    flights: Count = 20,
    kinds: list[str] = tuple(GUSTS),
    duration: float = 20.0,
    seed: Seed = 21,
    estimators: Estimators = ("filter-error", "ibss", "hybrid"),
    predict: bool = False,
    out: Out = None,
) -> None:
    """Fly and identify RotorPy's Hummingbird.

    - `recordings`: Folder of the flights. Those that are missing are flown.
    - `kinds`: calm, gusty.
    - `predict`: Identify each gusty flight, with motion capture, and predict the next 0.5 s ahead.
    """
    check_names("kinds", kinds, GUSTS)
    check_names("estimators", estimators, ESTIMATORS)
    settings = {"flights": flights, "duration": duration, "seed": seed}
    if predict:
        known, trials = read(recordings, settings, "gusty", captured=True), product(flight=range(flights))
        rows = study(out, settings, trials, lambda flight: prediction(known, flight), rows="predictions")
        headings = "", "error", "of the true parameters", "ratio", "inside the 95 % band [%]"
        means = {name: np.mean([list(row[name].values()) for row in rows], axis=0) for name in QUANTITIES}
        cells = [
            (name, f"{error:.3g}", f"{true:.3g}", f"{error / true:.2f}", f"{100 * held:.1f}")
            for name, (error, true, held) in means.items()
        ]
        print_table("0.5 s ahead", headings, cells)
        return

    flown = functools.cache(lambda kind: read(recordings, settings, kind))

    def row_of(kind: str, estimator: str, flight: int) -> Row:
        return fit(estimator, flown(kind)[flight], VEHICLE, flight)

    rows = study(out, settings, product(kind=kinds, estimator=estimators, flight=range(flights)), row_of)
    print_summaries(f"RotorPy's Hummingbird, flights of {duration:g} s", rows)
