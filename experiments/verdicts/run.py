"""Which verdicts are right? Good flights with the effects of real ones, and flights that are spoiled as real logs are.

The good flights, and the airframe that is given, are those of `closed_loop/effects.py`, and those of `rotorpy`, which
needs RotorPy to be installed. Each fault spoils the flights `gusts` in three sizes, alone. Ix and Iy are judged. A
quantity is *identified* with or without a reservation. It is *wrong* if it is off by more than three standard
deviations, or, without a reservation, by more than 12 %. An answer is *right* if its 95 % interval holds the truth. A
cause is right if a fault of `faults.py` is named as it is, wherever the answer says so.
"""

import functools
from collections.abc import Callable

import numpy as np

import jaxos4
from experiments.closed_loop.effects import ALL, EFFECTS, VEHICLE, flights_of
from experiments.fits import INERTIAS, given_airframe, identified, shares_of_truth
from experiments.monte_carlo import LOST, Row, check_names, plus_minus, print_table, share, statistics, study
from experiments.shared import Count, Out, Seed
from experiments.verdicts.faults import FAULTS, Fault
from jaxos4 import FrequencyResponse
from jaxos4.airframe import MOTIONS
from jaxos4.identification.verdict import IDENTIFIED
from jaxos4.recording import Recording
from jaxos4.results import NINETY_FIVE

JUDGED = "Ix", "Iy"
SURE, FAR = 3.0, 0.12  # an answer beyond either is wrong: standard deviations, and share of the truth
ROTORPY = {"RotorPy calm": "calm", "RotorPy gusts": "gusty"}
CASES = {kind: (kind, None, 0.0) for kind in (*EFFECTS, ALL, *ROTORPY)}
CASES |= {f"{name} {size:g}": ("gusts", fault, size) for name, fault in FAULTS.items() for size in fault.sizes}


def good_flights(
    kind: str, count: int, duration: float, seed: int
) -> tuple[jaxos4.Airframe, Callable[[int], jaxos4.Flight | None]]:
    """The vehicle, and its flights with an effect by their number; `None`: one that turned over."""
    if kind not in ROTORPY:
        return VEHICLE, flights_of(kind, count, duration, seed).__getitem__
    from experiments.rotorpy import flights

    return flights.VEHICLE, lambda i: flights.fly(flights.GUSTS[ROTORPY[kind]], duration, seed, i)


def judged(vehicle: jaxos4.Airframe, flight: jaxos4.Flight, i: int, fault: Fault | None, size: float) -> Row:
    """The row of one flight. Errors and standard deviations are shares of the truth."""
    recording = Recording.of(flight, "flight")
    spoiled = recording if fault is None else fault.spoil(recording, size)
    row, found = identified(spoiled, given_airframe(vehicle, i))
    causes = row.pop("doubts")
    if found is not None:
        causes += [*(r for v in found.verdicts.values() for r in v.reasons), *found.provenance.notes]
        row |= {n: each | {"status": found.verdicts[n].status} for n, each in shares_of_truth(found, vehicle).items()}
        if found.response is not None:
            row["response"] = agreements(found.response)
    named = None if fault is None or not fault.cause else any(fault.cause in cause for cause in causes)
    return row | {"named": named, "causes": causes}


def agreements(response: FrequencyResponse) -> dict[str, list[float]]:
    """The mean gain of each axis with a clear response, and the standard deviation of its logarithm."""
    every = {axis: one.agreement() for axis, one in zip(MOTIONS, response, strict=True)}
    return {axis: [one.ratio, one.error] for axis, one in every.items() if np.isfinite(one.ratio)}


def counts(rows: list[Row]) -> dict[str, int]:
    """How many answers for Ix and Iy there are, and how many are right, or wrong, of each kind."""
    kinds = "answers", "identified", "unreserved", "far", "identified and wrong", "refused and right"
    found = dict.fromkeys(kinds, 0)
    for row in rows:
        for name in JUDGED:
            found["answers"] += 1
            if name not in row:
                continue
            off, status = abs(row[name]["error"]), row[name]["status"]
            trusted, unreserved = status.startswith("identified"), status == IDENTIFIED
            wide = off > SURE * row[name]["std"]
            found["identified"] += trusted
            found["unreserved"] += unreserved
            found["far"] += unreserved and (wide or off > FAR)
            found["identified and wrong"] += trusted and wide
            found["refused and right"] += not trusted and off < NINETY_FIVE * row[name]["std"]
    return found


def errors_of(rows: list[Row]) -> list[str]:
    """For each moment of inertia: the mean error, and the share of the 95 % intervals that hold the truth."""
    cells = []
    for inertia in INERTIAS:
        known = [row[inertia] for row in rows if inertia in row]
        cells += ["", ""]
        if known:
            found = statistics(*(np.array([each[key] for each in known]) for key in ("error", "std")))
            cells[-2:] = plus_minus(found), plus_minus(found, "covered")
    return cells


def print_responses(title: str, groups: dict[str, list[Row]]) -> None:
    """For each group of flights and axis: the mean logarithm of the gain, and how many intervals hold 1."""
    lines = []
    for name, rows in groups.items():
        for axis in MOTIONS:
            every = [row["response"][axis] for row in rows if axis in row.get("response", {})]
            logs, errors = np.log([ratio for ratio, _ in every]), np.array([error for _, error in every])
            if every:
                held = int((np.abs(logs) < NINETY_FIVE * errors).sum())
                mean = f"{logs.mean():.3f} +- {logs.std() / np.sqrt(len(every)):.3f}"
                lines.append((name, axis, str(len(every)), mean, f"{np.median(errors):.2f}", share(held, len(every))))
    headings = "case", "axis", "flights", "mean log gain", "median error", "interval holds 1 [%]"
    print_table(title, headings, lines, width=140)


def print_tables(rows: list[Row]) -> None:
    """A line for each case, and how often the intervals of the frequency response hold 1 in good flights.

    Unreserved: identified without a reservation; far: off by more than three standard deviations or 12 %.
    """
    good = [row for row in rows if CASES[row["case"]][1] is None]
    spoiled = [row for row in rows if CASES[row["case"]][1] is not None]
    groups = {name: [row for row in rows if row["case"] == name] for name in CASES}
    groups |= {"good flights": good, "spoiled flights": spoiled}
    groups = {name: some for name, some in groups.items() if some}
    unspoiled = {name: some for name, some in groups.items() if CASES[some[0]["case"]][1] is None}
    lines = []
    for name, some in groups.items():
        n, known = counts(some), [r["named"] for r in some if r["named"] is not None]
        shares = [share(n[each], n["answers"]) for each in ("identified", "unreserved", "identified and wrong")]
        shares += [share(n["far"], n["unreserved"]), share(n["refused and right"], n["answers"])]
        lines.append((name, str(len(some)), *shares, share(sum(known), len(known))))
    headings = "flights", "identified [%]", "unreserved [%]", "beyond 3 std [%]"
    headings += "of unreserved far [%]", "refused, right [%]", "named [%]"
    print_table("verdicts of Ix and Iy", ("case", *headings), lines, width=140)
    headings = (f"{name} {what} [%]" for name in INERTIAS for what in ("mean error", "intervals that hold"))
    errors = ((name, *errors_of(some)) for name, some in unspoiled.items())
    print_table("errors of good flights", ("case", *headings), errors, width=160)
    print_responses("frequency response of good flights", {"good flights": good})


def main(
    flights: Count = 100,
    spoiled: int = 20,
    rotorpy: int = 20,
    cases: list[str] = tuple(CASES),
    duration: float = 20.0,
    seed: Seed = 48,
    out: Out = None,
) -> None:
    """Count right and wrong verdicts for each effect, and for each fault in three sizes.

    - `spoiled`: Number of flights of each fault and size.
    - `rotorpy`: Number of flights of RotorPy, calm and in gusts.
    """
    check_names("cases", cases, CASES)
    numbers = {name: spoiled if CASES[name][1] else rotorpy if name in ROTORPY else flights for name in cases}
    flown = functools.cache(lambda kind: good_flights(kind, max(numbers.values()), duration, seed))
    # An interrupted report has about as many flights of each case.
    trials = ({"case": name, "flight": i} for i in range(max(numbers.values())) for name in cases if i < numbers[name])

    def row_of(case: str, flight: int) -> Row:
        kind, fault, size = CASES[case]
        vehicle, flight_of = flown(kind)
        recorded = flight_of(flight)
        return {"result": LOST} if recorded is None else judged(vehicle, recorded, flight, fault, size)

    rows = study(out, {"duration": duration, "seed": seed}, trials, row_of)
    print_tables([row for row in rows if row["result"] != LOST])
