"""Which verdicts are right? Good flights with the effects of real ones, and flights that are spoiled as real logs are.

The good flights, and the airframe that is given, are those of `closed_loop/effects.py`, and those of `rotorpy`, which
needs RotorPy to be installed. Each fault spoils the flights `gusts` in three sizes, alone. Ix and Iy are judged. A
quantity is *identified* with or without a reservation. It is *wrong* if it is off by more than three standard
deviations, or, without a reservation, by more than 12 %. An answer is *right* if its 95 % interval holds the truth. A
cause is right if the faults of the table below are named as they are, wherever the answer says so.
"""

import functools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

import jaxos4
from experiments.closed_loop.effects import ALL, EFFECTS, flights_of
from experiments.closed_loop.run import VEHICLE
from experiments.fits import INERTIAS, given_airframe
from experiments.monte_carlo import Row, continued, fill, print_table
from jaxos4 import FrequencyResponse
from jaxos4.errors import InputError
from jaxos4.flight import ANGLES, RATES
from jaxos4.identification.verdict import IDENTIFIED
from jaxos4.recording import Recording
from jaxos4.recording.motion import rotations_to_body
from jaxos4.results import NINETY_FIVE

JUDGED = "Ix", "Iy"
SURE, FAR = 3.0, 0.12  # an answer beyond either is wrong: standard deviations, and share of the truth
FORCE = slice(12, 15)  # of the channels
LOST = "lost"  # the result of a vehicle that turns over


class Fault(NamedTuple):
    """`spoil`: makes spoiled recordings of a good one and a size. `cause`: words of the right cause; empty: none."""

    spoil: Callable[[Recording, float], Recording | list[Recording]]
    sizes: tuple[float, ...]
    cause: str


def changed(recording: Recording, channels: np.ndarray) -> Recording:
    """The recording with other states and specific force."""
    return recording._replace(states=channels[:, :12], specific_force=channels[:, FORCE])


def scaled(columns: np.ndarray) -> Callable[[Recording, float], Recording]:
    """Some channels have another scale."""

    def spoil(recording: Recording, size: float) -> Recording:
        channels = recording.channels.copy()
        channels[:, columns] *= size
        return changed(recording, channels)

    return spoil


def late(columns: np.ndarray) -> Callable[[Recording, float], Recording]:
    """Some channels are recorded late by `size` [s]; negative: early."""

    def spoil(recording: Recording, size: float) -> Recording:
        channels = recording.channels.copy()
        for i in columns:
            channels[:, i] = np.interp(recording.time - size, recording.time, channels[:, i])
        return changed(recording, channels)

    return spoil


def clipped(column: int) -> Callable[[Recording, float], Recording]:
    """The range of a sensor ends at this share of its largest value."""

    def spoil(recording: Recording, size: float) -> Recording:
        channels = recording.channels.copy()
        end = size * np.nanmax(np.abs(channels[:, column]))
        channels[:, column] = np.clip(channels[:, column], -end, end)
        return changed(recording, channels)

    return spoil


def turned(recording: Recording, degrees: float) -> Recording:
    """Gyro and accelerometer are mounted at an angle about z."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    channels = recording.channels.copy()
    for x, y in ((RATES[0], RATES[1]), (12, 13)):
        channels[:, [x, y]] = channels[:, [x, y]] @ np.array([[cos, -sin], [sin, cos]])
    return changed(recording, channels)


def along_the_earth(recording: Recording, size: float) -> Recording:
    """Specific force is along the axes of the earth; `size`: the share of the turn."""
    channels = recording.channels.copy()
    turns = rotations_to_body(*(size * channels[:, ANGLES]).T)
    channels[:, FORCE] = np.einsum("tji,tj->ti", turns, channels[:, FORCE])
    return changed(recording, channels)


def impossible(recording: Recording, size: float) -> Recording:
    """Two impossible rotor speeds: 60 and `size` times the mean."""
    omega = recording.omega.copy()
    omega[[len(omega) // 3, len(omega) // 2], 3] = np.array([60.0, size]) * omega[:, 3].mean()
    return recording._replace(omega=omega)


def noisy(recording: Recording, size: float) -> Recording:
    """White noise of the motors, as a share of their changes from sample to sample."""
    change = np.mean(np.median(np.abs(np.diff(recording.omega, axis=0)), axis=0))
    noise = np.random.default_rng(0).normal(0.0, size * change, recording.omega.shape)
    return recording._replace(omega=np.maximum(recording.omega + noise, 0.0))


def shortened(recording: Recording, seconds: float) -> Recording:
    """The first seconds of a flight."""
    return recording.rows(recording.time <= recording.time[0] + seconds)


def without_rows(recording: Recording, lost: float) -> Recording:
    """This share of the rows is missing, at random."""
    return recording.rows(np.random.default_rng(0).uniform(size=recording.time.size) >= lost)


def two_vehicles(recording: Recording, size: float) -> list[Recording]:
    """Two halves; the second is of a vehicle whose mass and moments of inertia are so many times smaller.

    With rotor speeds that are smaller by the root, it flies the same path.
    """
    first = recording.time <= (recording.time[0] + recording.time[-1]) / 2
    second = recording.rows(~first)
    return [recording.rows(first), second._replace(omega=second.omega / np.sqrt(size), name="second flight")]


def thinned(recording: Recording, every: float) -> Recording:
    """Motors are logged once in so many samples."""
    rows = np.arange(len(recording.omega)) // int(every) * int(every)
    return recording._replace(omega=recording.omega[rows])


FAULTS = {
    "gyro scale": Fault(scaled(RATES), (0.5, 0.8, 1.25), "the attitude turns"),
    "time scale": Fault(lambda r, size: r._replace(time=size * r.time), (2.0, 1.25, 0.8), "the attitude turns"),
    "attitude scale": Fault(scaled(ANGLES), (0.5, 0.8, 1.25), "the attitude turns"),
    "attitude late": Fault(late(ANGLES), (0.2, 0.1, 0.05), "attitude is recorded"),
    "gyro clipped": Fault(clipped(int(RATES[0])), (0.5, 0.65, 0.8), "is clipped"),
    "force clipped": Fault(clipped(14), (0.9, 0.85, 0.8), "is clipped"),
    "gyro early": Fault(late(RATES), (-0.05, -0.03, -0.02), "gyro is recorded"),
    "force late": Fault(late(np.array([12, 13, 14])), (0.05, 0.03, 0.02), "accelerometer is recorded"),
    "turned": Fault(turned, (30.0, 20.0, 10.0), "at an angle about the vertical axis"),
    "earth's axes": Fault(along_the_earth, (1.0,), "along the axes of the earth"),
    "impossible speeds": Fault(impossible, (40.0, 19.0, 5.0), "are impossible"),
    "noisy motors": Fault(noisy, (0.3, 1.0, 3.0), ""),
    "short": Fault(shortened, (2.0, 4.0, 6.0), "s were fitted"),
    "rows missing": Fault(without_rows, (0.1, 0.3, 0.5), "is not uniform"),
    "two vehicles": Fault(two_vehicles, (1.1, 1.2, 1.3), "of different mass or thrust"),
    "rare motors": Fault(thinned, (5.0, 10.0, 20.0), "more rarely"),
}
ROTORPY = {"RotorPy calm": 0.0, "RotorPy gusts": 1.5}  # [m/s]
CASES = {kind: (kind, None, 0.0) for kind in (*EFFECTS, ALL, *ROTORPY)}
CASES |= {f"{name} {size:g}": ("gusts", fault, size) for name, fault in FAULTS.items() for size in fault.sizes}


def good_flights(
    kind: str, count: int, duration: float, seed: int
) -> tuple[jaxos4.Airframe, Callable[[int], jaxos4.Flight | None]]:
    """The vehicle, and its flights with an effect by their number; `None`: one that turned over."""
    if kind not in ROTORPY:
        return VEHICLE, flights_of(kind, count, duration, seed).__getitem__
    from experiments.rotorpy import flights

    return flights.VEHICLE, lambda i: flights.fly(ROTORPY[kind], duration, 1000 * seed + i)


def judged(vehicle: jaxos4.Airframe, flight: jaxos4.Flight, i: int, fault: Fault | None, size: float) -> Row:
    """The row of one flight. Errors and standard deviations are shares of the truth."""
    begin, recording = time.perf_counter(), Recording.of(flight, "flight")
    row: Row = {"result": "refused"}
    try:
        found = jaxos4.identify(
            recording if fault is None else fault.spoil(recording, size), given_airframe(vehicle, i)
        )
    except InputError as error:
        causes = [str(error)]
    else:
        row["result"], constants = found.result, found.rigid_body.constants
        causes = [*map(str, found.doubts), *(r for v in found.verdicts.values() for r in v.reasons)]
        causes += found.provenance.notes
        for name, truth in zip(INERTIAS, np.asarray(vehicle.inertia).tolist(), strict=True):
            if name in constants:
                value = constants[name]
                row[name] = {"error": value.estimate / truth - 1, "std": value.std / truth}
                row[name]["status"] = found.verdicts[name].status
        if found.response is not None:
            row["response"] = agreements(found.response)
    named = None if fault is None or not fault.cause else any(fault.cause in cause for cause in causes)
    return row | {"named": named, "causes": causes, "seconds": time.perf_counter() - begin}


def agreements(response: FrequencyResponse) -> dict[str, list[float]]:
    """The mean gain of each axis with a clear response, and the standard deviation of its logarithm."""
    every = {axis: one.agreement() for axis, one in response._asdict().items()}
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
            trusted, unreserved, wide = (
                status.startswith("identified"),
                status == IDENTIFIED,
                off > SURE * row[name]["std"],
            )
            found["identified"] += trusted
            found["unreserved"] += unreserved
            found["far"] += unreserved and (wide or off > FAR)
            found["identified and wrong"] += trusted and wide
            found["refused and right"] += not trusted and off < NINETY_FIVE * row[name]["std"]
    return found


def share(part: int, whole: int) -> str:
    """A share with its Monte-Carlo error, of at least half an event [%]."""
    if not whole:
        return ""
    p = np.clip(part / whole, 0.5 / whole, 1 - 0.5 / whole)
    return f"{100 * part / whole:.3g} +- {100 * np.sqrt(p * (1 - p) / whole):.1f}"


def errors_of(groups: dict[str, list[Row]]) -> Iterator[tuple[str, ...]]:
    """For each group of good flights: mean errors, and shares of the 95 % intervals that hold the truth."""
    for name, some in groups.items():
        cells = []
        for inertia in INERTIAS:
            known = [row[inertia] for row in some if inertia in row]
            error, std = (np.array([each[key] for each in known]) for key in ("error", "std"))
            cells += ["", ""]
            if known:
                spread = 100 * error.std() / np.sqrt(len(known))
                held = int((np.abs(error) < NINETY_FIVE * std).sum())
                cells[-2:] = f"{100 * error.mean():.1f} +- {spread:.1f}", share(held, len(known))
        yield name, *cells


def print_responses(title: str, groups: dict[str, list[Row]]) -> None:
    """For each group of flights and axis: the mean logarithm of the gain, and how many intervals hold 1."""
    lines = []
    for name, rows in groups.items():
        for axis in FrequencyResponse._fields:
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
    print_table(
        "errors of good flights",
        ("case", *headings),
        errors_of(unspoiled),
        width=160,
    )
    print_responses("frequency response of good flights", {"good flights": good})


def main(
    flights: Annotated[int, typer.Option(help="Number of flights of each effect.")] = 100,
    spoiled: Annotated[int, typer.Option(help="Number of flights of each fault and size.")] = 20,
    rotorpy: Annotated[int, typer.Option(help="Number of flights of RotorPy, calm and in gusts.")] = 20,
    cases: Annotated[list[str], typer.Option(help="The cases.")] = tuple(CASES),
    duration: Annotated[float, typer.Option(help="Length of a flight [s].")] = 20.0,
    seed: Annotated[int, typer.Option(help="Random seed of references, gusts, noise and effects.")] = 48,
    out: Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")] = None,
) -> None:
    """Count right and wrong verdicts for each effect, and for each fault in three sizes."""
    report = continued(out, {"duration": duration, "seed": seed}, "rows")
    numbers = {name: spoiled if CASES[name][1] else rotorpy if name in ROTORPY else flights for name in cases}
    flown = functools.cache(lambda kind: good_flights(kind, max(numbers.values()), duration, seed))
    # An interrupted report has about as many flights of each case.
    trials = ({"case": name, "flight": i} for i in range(max(numbers.values())) for name in cases if i < numbers[name])

    def row_of(case: str, flight: int) -> Row:
        kind, fault, size = CASES[case]
        vehicle, flight_of = flown(kind)
        recorded = flight_of(flight)
        return {"result": LOST} if recorded is None else judged(vehicle, recorded, flight, fault, size)

    fill(out, report, report["rows"], trials, row_of)
    print_tables([row for row in report["rows"] if row["result"] != LOST])
