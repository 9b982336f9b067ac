"""Verdicts of moments of inertia on real flights, each identified alone; and whether repeated flights agree.

The airframe of each vehicle has the rotors where their centres were measured. Motion capture is not shifted.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

import jaxos4
from experiments.monte_carlo import Row, continued, fill, interval, print_table
from experiments.public_flights.run import FITTED, PREDICTED
from experiments.real_flight.run import disagreements
from experiments.sample_times.run import VEHICLE as CINERAT
from experiments.shared import flight_files
from jaxos4.errors import InputError
from jaxos4.recording import read_recording
from jaxos4.results import NINETY_FIVE

CRAZYFLIE = jaxos4.load_airframe("crazyflie")
FLIGHTS = {f"arpl_crazyflie_{name}.csv": CRAZYFLIE for name in ("rollpitch", "yaw_a", "yaw_b", "hover")}
FLIGHTS |= {f"nanobench/{name}.csv": CRAZYFLIE for name in sorted((*FITTED, *PREDICTED))}
FLIGHTS |= {"cinerat/cinerat_281.csv": CINERAT}
JUDGED = "Ix", "Iy", "Iz"


def judged(path: Path, airframe: jaxos4.Airframe) -> Row:
    """Result, value, 95 % half-width, verdict and reasons of each quantity."""
    try:
        recording = read_recording(path, airframe=airframe)._replace(name=path.stem)
        found = jaxos4.identify(recording, airframe)
    except InputError as error:
        return {"result": "refused", "why": str(error)}
    row: Row = {"result": found.result}
    for name in JUDGED:
        value, verdict = found.rigid_body.constants.get(name), found.verdicts.get(name)
        status = found.result if verdict is None else verdict.status
        row[name] = {"status": status, "reasons": [] if verdict is None else list(verdict.reasons)}
        if value is not None:
            row[name] |= {"estimate": value.estimate, "std": value.std}
    return row


def flown_by(row: Row) -> str:
    """The vehicle that flew: that of the file's folder, or of the first words of its name."""
    return row["flight"].split("/")[0] if "/" in row["flight"] else "arpl_crazyflie"


def cells(rows: list[Row]) -> Iterator[tuple[str, ...]]:
    """One line for each flight and quantity."""
    for row in rows:
        for name in JUDGED:
            if name in row:
                one = row[name]
                value = interval(one if "estimate" in one else None, 1e5, "3g", "2g")
                yield row["flight"], name, value, one["status"], "; ".join(one["reasons"])
        if "why" in row:
            yield row["flight"], "", "", "refused", row["why"]


def pairs(rows: list[Row]) -> Iterator[tuple[str, ...]]:
    """Pairs of identified flights of one vehicle: how many differences lie inside their 95 %, and the largest."""
    for vehicle in dict.fromkeys(map(flown_by, rows)):
        flown = {row["flight"]: {"constants": identified(row)} for row in rows if flown_by(row) == vehicle}
        for name, apart in disagreements(flown).items():
            known = sum(name in each["constants"] for each in flown.values())
            inside = sum(z <= NINETY_FIVE for z in apart.values())
            yield vehicle, name, str(known), f"{inside} of {len(apart)}", f"{max(apart.values()):.2f}"


def identified(row: Row) -> Row:
    """The quantities of a flight that are identified, with or without a reservation."""
    known = {name: row[name] for name in JUDGED if "estimate" in row.get(name, {})}
    return {name: one for name, one in known.items() if one["status"].startswith("identified")}


def main(
    flights: Annotated[Path | None, typer.Option(help="Folder of the flights; $JAXOS4_FLIGHTS by default.")] = None,
    names: Annotated[list[str], typer.Option(help="Their files.")] = tuple(FLIGHTS),
    out: Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")] = None,
) -> None:
    """Judge real flights one by one, and compare those of one vehicle."""
    report = continued(out, {}, "rows")
    paths = dict(zip(names, flight_files(flights, names), strict=True))
    trials = ({"flight": name} for name in names)
    fill(out, report, report["rows"], trials, lambda flight: judged(paths[flight], FLIGHTS[flight]))
    headings = "flight", "", "1e-5 kg m^2, 95 %", "verdict", "reasons"
    print_table("verdicts of real flights", headings, cells(report["rows"]), width=200)
    headings = "vehicle", "", "identified", "differences inside their 95 %", "largest [std]"
    print_table("repeated flights of one vehicle", headings, pairs(report["rows"]))
