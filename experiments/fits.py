"""Fits of simulated flights whose true vehicle is known: what a user would give, errors, and intervals."""

import json
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import equinox as eqx
import numpy as np
from rich.console import Console
from shared import count_results, in_words, table_of

import jaxos4
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


def fit(estimator: str, flight: jaxos4.Flight, vehicle: jaxos4.Airframe, i: int) -> dict:
    """The row of one flight. Errors and standard deviations are shares of the truth."""
    begin, given = time.perf_counter(), given_airframe(vehicle, i)
    # One length of all flights: one program.
    whole = jaxos4.VehicleSettings(begin=float(flight.time[0]), end=float(flight.time[-1]), holdout=0.0)
    try:
        found = jaxos4.identify(flight, given, settings=whole, estimator=estimator)
    except InputError as error:
        return {"flight": i, "result": "refused", "why": str(error), "seconds": time.perf_counter() - begin}
    row: dict = {"flight": i, "result": found.result, "seconds": time.perf_counter() - begin}
    row["doubts"] = [str(doubt) for doubt in found.doubts]
    for name, truth in zip(INERTIAS, np.asarray(vehicle.inertia).tolist(), strict=True):
        if name in found.rigid_body.constants:
            value = found.rigid_body.constants[name]
            row[name] = {"error": value.estimate / truth - 1, "std": value.std / truth}
    gain = found.parameters.get("thrust_gain")
    if gain is not None and gain.estimate is not None and gain.std is not None:
        truth = float(vehicle.thrust_coefficient / given.thrust_coefficient)
        row[THRUST] = {"error": gain.estimate / truth - 1, "std": gain.std / truth}
    return row


def summary(rows: list[dict]) -> dict[str, dict]:
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


def run_cases(
    out: Path | None,
    settings: dict,
    cases: Iterable[tuple[str, str]],
    vehicle: jaxos4.Airframe,
    flights_of: Callable[[str], Sequence[jaxos4.Flight | None]],
) -> dict:
    """The report of all cases, each a kind of flights and an estimator; continued if `out` exists.

    `flights_of`: the flights of a kind; `None`: one that was lost.
    """
    report = continued(out, settings, "cases")
    for kind, estimator in cases:
        if any((case["kind"], case["estimator"]) == (kind, estimator) for case in report["cases"]):
            continue
        flown = [(i, flight) for i, flight in enumerate(flights_of(kind)) if flight is not None]
        rows = [fit(estimator, flight, vehicle, i) for i, flight in flown]
        report["cases"].append({"kind": kind, "estimator": estimator, "flights": rows, "summary": summary(rows)})
        write_report(out, report)
    return report


def continued(out: Path | None, settings: dict, rows: str) -> dict:
    """A report with these settings and a list of `rows`: that of the file `out` if it exists, or a new one."""
    settings = settings | {"version": jaxos4.__version__, "precision": "float64"}
    if out is None or not out.exists():
        return {**settings, rows: []}
    report = json.loads(out.read_text())
    if rows not in report or {name: report.get(name) for name in settings} != settings:
        raise SystemExit(f"{out}: has other settings; give --out another name.")
    return report


def write_report(out: Path | None, report: dict) -> None:
    """Write what there is of a report, if it has a file."""
    if out is not None:
        out.write_text(json.dumps(report, indent=1) + "\n")


def print_table(title: str, report: dict) -> None:
    """One line for each case and quantity."""
    figures = "flights", "covered [%]", "covered if successful [%]", "mean error [%]", "half-width [%]", "results"
    table = table_of(title, ("flights are", "estimator", "", *figures))
    for case in report["cases"]:
        results = in_words(count_results(np.array([row["result"] for row in case["flights"]])))
        for name, row in case["summary"].items():
            trusted = row["covered_successful"]
            table.add_row(
                *(case["kind"], case["estimator"], name, str(row["flights"]), f"{100 * row['covered']:.0f}"),
                "" if trusted is None else f"{100 * trusted:.0f}",
                *(f"{100 * row['mean']:.2g}", f"{100 * row['width']:.2g}", results),
            )
        if not case["summary"]:
            table.add_row(case["kind"], case["estimator"], *[""] * 6, results)
    Console(width=150).print(table)
