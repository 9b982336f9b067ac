"""Identifications of flights by experiments: their rows, errors of simulated vehicles, and the tables of these."""

import time
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

import jaxos4
from experiments.monte_carlo import LOST, Row, groups, print_table, results_of, statistics
from jaxos4.airframe import AXES
from jaxos4.errors import InputError
from jaxos4.recording import read_recording

INERTIAS = {axis.inertia: axis.inverse for axis in AXES}  # with the parameters that are their inverses
THRUST = "thrust"
# The errors of the airframe that is given, as shares. Flights have both signs in turn.
WRONG_THRUST, WRONG_INERTIA = 0.2, 0.25


def given_airframe(
    vehicle: jaxos4.Airframe, i: int, thrust: float = WRONG_THRUST, inertia: float = WRONG_INERTIA
) -> jaxos4.Airframe:
    """The airframe that a user gives for flight `i`. Mass, arms, and the ratio of drag to thrust are right."""
    sign = (-1) ** i
    return eqx.tree_at(
        lambda a: (a.inertia, a.thrust_coefficient, a.drag_coefficient),
        vehicle,
        (
            vehicle.inertia * (1 + sign * inertia),
            vehicle.thrust_coefficient * (1 + sign * thrust),
            vehicle.drag_coefficient * (1 + sign * thrust),
        ),
    )


def whole(flight: jaxos4.Flight) -> jaxos4.VehicleSettings:
    """The settings that fit all samples, so that flights of one length have one program."""
    return jaxos4.VehicleSettings(begin=float(flight.time[0]), end=float(flight.time[-1]), holdout=0.0)


def identified(flights: Any, airframe: jaxos4.Airframe, **options: Any) -> tuple[Row, jaxos4.Identification | None]:
    """The begin of a row: result, doubts and seconds; and what `jaxos4.identify` found, or `None` if it refused.

    `flights`: as `jaxos4.identify` takes them, or the path of a log.
    """
    begin = time.perf_counter()
    try:
        if isinstance(flights, Path):
            flights = read_recording(flights, airframe)
        found = jaxos4.identify(flights, airframe, **options)
    except InputError as error:
        return {"result": "refused", "doubts": [str(error)], "seconds": time.perf_counter() - begin}, None
    doubts = [str(issue) for issue in found.issues]
    return {"result": found.result, "doubts": doubts, "seconds": time.perf_counter() - begin}, found


def constants(found: jaxos4.Identification) -> dict[str, Row]:
    """Estimate and standard deviation of each moment of inertia that has an estimate [kg m^2]."""
    known = found.rigid_body.constants
    return {name: {"estimate": known[name].estimate, "std": known[name].std} for name in INERTIAS if name in known}


def shares_of_truth(found: jaxos4.Identification, vehicle: jaxos4.Airframe) -> dict[str, Row]:
    """Error and standard deviation of each moment of inertia that has an estimate, as shares of the truth."""
    truths = dict(zip(INERTIAS, np.asarray(vehicle.inertia).tolist(), strict=True))
    return {
        name: {"error": one["estimate"] / truths[name] - 1, "std": one["std"] / truths[name]}
        for name, one in constants(found).items()
    }


def fit(estimator: str, flight: jaxos4.Flight | None, vehicle: jaxos4.Airframe, i: int) -> Row:
    """The row of one flight; `None`: it was lost. Errors and standard deviations are shares of the truth."""
    if flight is None:
        return {"result": LOST}
    given = given_airframe(vehicle, i)
    row, found = identified(flight, given, settings=whole(flight), estimator=estimator)
    if found is None:
        return row
    row |= shares_of_truth(found, vehicle)
    gain = found.parameters.get("thrust_gain")
    if gain is not None and gain.estimate is not None and gain.std is not None:
        truth = float(vehicle.thrust_coefficient / given.thrust_coefficient)
        row[THRUST] = {"error": gain.estimate / truth - 1, "std": gain.std / truth}
    return row


def summary(rows: list[Row]) -> dict[str, Row]:
    """For each quantity, as shares: the `statistics` of the flights with an estimate.

    `covered_successful`: the share of 95 % intervals that hold the truth, of flights that say successful; `None` if
    there are none. `bound`: root mean square of the Cramer-Rao bounds, if rows have them; `efficiency`: RMSE / bound.
    """
    found = {}
    for name in (*INERTIAS, THRUST):
        some = [row for row in rows if name in row]
        if not some:
            continue
        error, std = (np.array([row[name][key] for row in some]) for key in ("error", "std"))
        trusted = np.array([row["result"] == "successful" for row in some])
        sure = statistics(error[trusted], std[trusted])["covered"] if trusted.any() else None
        found[name] = statistics(error, std) | {"covered_successful": sure}
        if all("bound" in row[name] for row in some):
            bound = float(np.sqrt(np.mean([row[name]["bound"] ** 2 for row in some])))
            ratio = found[name]["rmse"] / bound
            found[name] |= {"bound": bound, "efficiency": ratio, "efficiency_error": ratio / np.sqrt(2 * len(some))}
    return found


def print_summaries(title: str, rows: list[Row]) -> None:
    """One line for each kind of flights, estimator and quantity."""
    lines = []
    for about, some in groups(rows, "kind", "estimator").items():
        results = results_of(some)
        for name, row in summary(some).items():
            shares = (row["covered"], row["covered_successful"])
            covered = ("" if share is None else f"{100 * share:.0f}" for share in shares)
            sizes = f"{100 * row['mean']:.2g}", f"{100 * row['width']:.2g}"
            lines.append((*about, name, str(row["flights"]), *covered, *sizes, results))
        if not any(name in row for row in some for name in (*INERTIAS, THRUST)):
            lines.append((*about, *[""] * 6, results))
    figures = "flights", "covered [%]", "covered if successful [%]", "mean error [%]", "half-width [%]", "results"
    print_table(title, ("flights are", "estimator", "", *figures), lines)
