"""A real Crazyflie: do its flights agree on the moments of inertia, and how well is what was not fitted predicted?

Each flight is identified alone, and all of them together, by filter error and by IBSS on the same likelihood. The last
quarter of each flight is not fitted but predicted. Commands are not rotor speeds: thrust as a function of the command
is fitted to the accelerometer (`thrust_curve`, `thrust_gain`), and torques, and therefore inertias, are proportional to
this thrust.

The moments of inertia of two flights should differ by chance alone. `z` is their difference over its standard
deviation; 99 % of such figures should be below 2.58.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

import jaxos4
from experiments.monte_carlo import Row, interval, print_table, write_report
from experiments.shared import flight_files
from jaxos4.recording import Recording, read_recording

AIRFRAME = jaxos4.load_airframe(Path(__file__).with_name("crazyflie.toml"))
AUTHORS = {"Ix": 1.03e-5, "Iy": 1.11e-5}
FLIGHTS = ("rollpitch", "yaw_a", "yaw_b", "hover")
TOGETHER = "all"
INERTIAS = "Ix", "Iy"
AHEAD = 0.25  # [s]


def skill_ahead(skill: dict[str, Any] | None) -> dict[str, tuple[float, float]]:
    """The skill of predictions of roll and pitch rate next to `AHEAD`, and its standard deviation."""
    if skill is None:
        return {}
    place = min(range(len(skill["horizons"])), key=lambda place: abs(skill["horizons"][place] - AHEAD))
    table = {rate: (skill[rate]["skill"][place], skill[rate]["std"][place]) for rate in "pq"}
    return {rate: (value, std) for rate, (value, std) in table.items() if value is not None and std is not None}


def identified(recordings: list[Recording], estimator: str, *, end: float | None) -> dict[str, Any]:
    """The JSON of `jaxos4 estimate`, and the skill `AHEAD`."""
    found = jaxos4.identify(recordings, AIRFRAME, settings=jaxos4.VehicleSettings(end=end), estimator=estimator)
    print(f"{estimator}, {', '.join(one.name for one in recordings)}: {found.seconds:.0f} s", flush=True)
    row = found.to_dict()
    return row | {"ahead": skill_ahead(row["skill"])}


def disagreements(rows: dict[str, dict[str, Any]]) -> dict[str, dict[str, float]]:
    """|z| of each pair of flights, for each moment of inertia that both have."""
    table: dict[str, dict[str, float]] = {}
    for (one, first), (other, second) in itertools.combinations(rows.items(), 2):
        for name in INERTIAS:
            if name in first["constants"] and name in second["constants"]:
                a, b = first["constants"][name], second["constants"][name]
                z = abs(a["estimate"] - b["estimate"]) / (a["std"] ** 2 + b["std"] ** 2) ** 0.5
                table.setdefault(name, {})[f"{one}, {other}"] = z
    return table


def print_report(report: Row) -> None:
    """One line for each estimator and flight, and the largest disagreement of two flights."""

    def rows() -> Iterator[tuple[str, ...]]:
        for estimator, found in report["estimators"].items():
            for flight, row in found["flights"].items():
                skills = [row["ahead"].get(rate) for rate in "pq"]
                yield (
                    *(estimator, flight, row["result"]),
                    *(interval(row["constants"].get(name), 1e5, "3g", "2g") for name in INERTIAS),
                    *(f"{x[0]:.2f} +- {x[1]:.2f}" if x else "" for x in skills),
                )

    headings = "estimator", "flight", "result", *(f"{name} [1e-5 kg m^2]" for name in INERTIAS), "skill p", "skill q"
    print_table(f"moments of inertia with 95 % intervals, and the skill {AHEAD:g} s ahead", headings, rows())
    for estimator, found in report["estimators"].items():
        worst = ", ".join(f"{name} {max(pairs.values()):.2g}" for name, pairs in found["z"].items())
        print(f"{estimator}: the largest disagreement of two flights (z): {worst or 'no pair'}")


def main(
    out: Annotated[Path, typer.Option(help="JSON file for the results.")],
    flights: Annotated[Path | None, typer.Option(help="Folder of the flights; $JAXOS4_FLIGHTS by default.")] = None,
    end: Annotated[float | None, typer.Option(help="Use the flights up to this time [s].")] = None,
    names: Annotated[list[str], typer.Option(help="The flights.")] = FLIGHTS,
    estimators: Annotated[list[str], typer.Option(help="Names of the estimators.")] = ("filter-error", "ibss"),
) -> None:
    """Identify each flight alone, and all together."""
    paths = flight_files(flights, [f"arpl_crazyflie_{name}.csv" for name in names])
    recordings = {name: read_recording(path, AIRFRAME) for name, path in zip(names, paths, strict=True)}
    groups = {name: [recording] for name, recording in recordings.items()}
    if len(groups) > 1:
        groups[TOGETHER] = list(recordings.values())
    report: Row = {"version": jaxos4.__version__, "authors": AUTHORS, "estimators": {}}
    for estimator in estimators:
        rows = {name: identified(group, estimator, end=end) for name, group in groups.items()}
        report["estimators"][estimator] = {"flights": rows, "z": disagreements(rows)}
        write_report(out, report)
    print_report(report)
