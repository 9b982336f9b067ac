"""Fits of simulated flights whose true vehicle is known: what a user would give, errors, and intervals."""

import time
from collections.abc import Iterator

import equinox as eqx
import numpy as np

import jaxos4
from experiments.monte_carlo import Row, print_table, results_of
from jaxos4.errors import InputError
from jaxos4.results import NINETY_FIVE

INERTIAS = ("Ix", "Iy", "Iz")
THRUST = "thrust"
# The errors of the airframe that is given, as shares. Flights have both signs in turn.
WRONG_THRUST, WRONG_INERTIA = 0.2, 0.25


def given_airframe(vehicle: jaxos4.Airframe, i: int) -> jaxos4.Airframe:
    """The airframe that a user gives for flight `i`. Mass, arms, and the ratio of drag to thrust are right."""
    sign = (-1) ** i
    return eqx.tree_at(
        lambda a: (a.inertia, a.thrust_coefficient, a.drag_coefficient),
        vehicle,
        (
            vehicle.inertia * (1 + sign * WRONG_INERTIA),
            vehicle.thrust_coefficient * (1 + sign * WRONG_THRUST),
            vehicle.drag_coefficient * (1 + sign * WRONG_THRUST),
        ),
    )


def whole(flight: jaxos4.Flight) -> jaxos4.VehicleSettings:
    """The settings that fit all samples, so that flights of one length have one program."""
    return jaxos4.VehicleSettings(begin=float(flight.time[0]), end=float(flight.time[-1]), holdout=0.0)


def shares_of_truth(found: jaxos4.Identification, vehicle: jaxos4.Airframe) -> dict[str, Row]:
    """Error and standard deviation of each moment of inertia that has an estimate, as shares of the truth."""
    constants, truths = found.rigid_body.constants, np.asarray(vehicle.inertia).tolist()
    return {
        name: {"error": constants[name].estimate / truth - 1, "std": constants[name].std / truth}
        for name, truth in zip(INERTIAS, truths, strict=True)
        if name in constants
    }


def fit(estimator: str, flight: jaxos4.Flight, vehicle: jaxos4.Airframe, i: int) -> Row:
    """The row of one flight. Errors and standard deviations are shares of the truth."""
    begin, given = time.perf_counter(), given_airframe(vehicle, i)
    try:
        found = jaxos4.identify(flight, given, settings=whole(flight), estimator=estimator)
    except InputError as error:
        return {"result": "refused", "why": str(error), "seconds": time.perf_counter() - begin}
    row: Row = {"result": found.result, "seconds": time.perf_counter() - begin}
    row["doubts"] = [str(issue) for issue in found.issues]
    row |= shares_of_truth(found, vehicle)
    gain = found.parameters.get("thrust_gain")
    if gain is not None and gain.estimate is not None and gain.std is not None:
        truth = float(vehicle.thrust_coefficient / given.thrust_coefficient)
        row[THRUST] = {"error": gain.estimate / truth - 1, "std": gain.std / truth}
    return row


def summary(rows: list[Row]) -> dict[str, Row]:
    """For each quantity, as shares: figures over the flights with an estimate, and over those that say successful.

    - `successful`: share of all flights. `covered`: of 95 % intervals that hold the truth. `covered_successful`: of
      those of successful flights; `None` if there are none. `mean`: mean error. `width`: median half-width.
    """
    found = {}
    successful = np.array([row["result"] == "successful" for row in rows])
    for name in (*INERTIAS, THRUST):
        has = np.array([name in row for row in rows])
        if not has.any():
            continue
        error, std = (np.array([row[name][key] for row in rows if name in row]) for key in ("error", "std"))
        covered, trusted = np.abs(error) <= NINETY_FIVE * std, successful[has]
        found[name] = {
            "flights": int(has.sum()),
            "successful": float(successful.mean()),
            "covered": float(covered.mean()),
            "covered_successful": float(covered[trusted].mean()) if trusted.any() else None,
            "mean": float(error.mean()),
            "width": float(NINETY_FIVE * np.median(std)),
        }
    return found


def print_summaries(title: str, report: Row) -> None:
    """One line for each case and quantity."""

    def rows() -> Iterator[tuple[str, ...]]:
        for case in report["cases"]:
            about, results = (case["kind"], case["estimator"]), results_of(case)
            for name, row in case["summary"].items():
                trusted = row["covered_successful"]
                yield (
                    *(*about, name, str(row["flights"]), f"{100 * row['covered']:.0f}"),
                    "" if trusted is None else f"{100 * trusted:.0f}",
                    *(f"{100 * row['mean']:.2g}", f"{100 * row['width']:.2g}", results),
                )
            if not case["summary"]:
                yield *about, *[""] * 6, results

    figures = "flights", "covered [%]", "covered if successful [%]", "mean error [%]", "half-width [%]", "results"
    print_table(title, ("flights are", "estimator", "", *figures), rows())
