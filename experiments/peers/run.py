"""What do the tools that people use say of the same flights? jaxos4, `mujoco.sysid`, regression, shooting in CasADi.

All tools know the mass, the places and spins of the rotors, the ratio of their torque to their thrust and their
inertia, and get commands or rotor speeds, gyro and accelerometer. Thrust coefficient and moments of inertia are given
20 % and 25 % wrong. Each peer has a setting for calm flights and one for gusty ones: that with the smallest error of Ix
and Iy in flights that are not reported.
"""

import functools
import importlib
import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import jaxos4
from experiments.fits import INERTIAS, constants, fit, given_airframe, identified
from experiments.monte_carlo import (
    LOST,
    Row,
    check_names,
    continued,
    covered_error,
    fill,
    interval,
    plus_minus,
    print_table,
    product,
    statistics,
)
from experiments.peers.flights import REAL, Case, cases, real
from experiments.peers.log import Fit, Log
from experiments.shared import Count, Out, Seed
from jaxos4.recording import Recording
from jaxos4.results import NINETY_FIVE

OURS = "jaxos4"
PEERS = {"mujoco.sysid": "mujoco_sysid", "regression": "regression", "CasADi": "shooting"}
# Flights by which the settings are chosen, of numbers that are not reported.
TUNED_ON = {"calm": ("Crazyflie, 0",), "gusts": ("Crazyflie, 2",)}
UNREPORTED = 1000


def installed(names: list[str]) -> dict[str, Any]:
    """The modules of the peers; one that lacks its library is skipped with a line."""
    found = {}
    for name in names:
        try:
            found[name] = importlib.import_module(f"experiments.peers.{PEERS[name]}")
        except ImportError as error:
            print(f"{name}: skipped: {error}; pip install 'casadi' 'mujoco[sysid]'")
    return found


def fitted(peer: Any, log: Log, setting: Row) -> tuple[Row, Fit | None]:
    """The begin of a row: warnings and seconds; and the fit, or `None` if the tool failed."""
    begin = time.perf_counter()
    try:
        found = peer.fit(log, **setting)
    except (ValueError, np.linalg.LinAlgError) as error:
        return {"warnings": [f"failed: {error}"], "seconds": time.perf_counter() - begin}, None
    return {"warnings": found.warnings, "seconds": time.perf_counter() - begin}, found


def simulated(case: Case, flight: jaxos4.Flight | None, i: int, peer: Any, setting: Row) -> Row:
    """The row of one simulated flight by one tool, in shares of the truth; `peer` is `None`: jaxos4."""
    if flight is None:
        return {"result": LOST}
    if peer is None:
        row = fit("filter-error", flight, case.vehicle, i)
        return row | {"warnings": row.pop("doubts") + [row["result"]] * (row["result"] != "successful")}
    log = Log.of(Recording.of(flight, "flight"), given_airframe(case.vehicle, i), commands=case.commands)
    row, found = fitted(peer, log, setting)
    if found is None:
        return row
    truth = np.asarray(case.vehicle.inertia)
    pairs = zip(INERTIAS, (found.inertia / truth - 1).tolist(), (found.std / truth).tolist(), strict=True)
    return row | {name: {"error": error, "std": std} for name, error, std in pairs}


def measured(folder: Path | None, name: str, peer: Any, setting: Row) -> Row:
    """The row of one real flight by one tool: estimates and standard deviations [kg m^2]."""
    recording, (_, airframe, _, logged, _) = real(folder, name), REAL[name]
    if peer is None:
        row, found = identified(recording, airframe, settings=jaxos4.VehicleSettings(holdout=0.0))
        return row | {"warnings": row.pop("doubts")} | ({} if found is None else constants(found))
    row, found = fitted(peer, Log.of(recording, airframe, commands=logged == "commands"), setting)
    if found is None:
        return row
    pairs = zip(INERTIAS, found.inertia.tolist(), found.std.tolist(), strict=True)
    return row | {name: {"estimate": value, "std": std} for name, value, std in pairs}


def best(rows: list[Row], tool: str, settings: tuple[Row, ...], air: str) -> int:
    """The number of the setting with the smallest root mean square of the errors of Ix and Iy."""

    def score(k: int) -> float:
        own = [row for row in rows if (row["tool"], row["setting"], row["air"]) == (tool, k, air) and "Ix" in row]
        errors = np.array([row[name]["error"] for row in own for name in ("Ix", "Iy")])
        return float(np.sqrt(np.mean(errors**2))) if errors.size and np.isfinite(errors).all() else np.inf

    return min(range(len(settings)), key=score)


def figures(rows: list[Row]) -> Iterator[str]:
    """The cells of one kind of flight and tool: mean errors, root mean squares, coverage, warnings, seconds."""
    covered = []
    for name in INERTIAS:
        error, std = (np.array([row[name][key] for row in rows if name in row]) for key in ("error", "std"))
        covered += (np.abs(error) <= NINETY_FIVE * std).tolist()
        known = statistics(error, std) if error.size else None
        yield from (plus_minus(known), f"{100 * known['rmse']:.2g}") if known else ("", "")
    share = float(np.mean(covered)) if covered else 0.0
    yield f"{100 * share:.0f} +- {100 * covered_error(share, len(rows)):.0f}" if covered else ""
    yield f"{100 * np.mean([bool(row['warnings']) for row in rows]):.0f}"
    yield f"{np.median([row['seconds'] for row in rows]):.1f}"


def print_report(
    report: Row, every: dict[str, Case], tools: dict[str, Any], duration: float, chosen: Callable[[str, str], Row]
) -> None:
    """Settings, simulated flights, and real ones."""
    settings = [
        (name, *(", ".join(f"{k} {v}" for k, v in chosen(name, air).items()) for air in TUNED_ON)) for name in tools
    ]
    print_table("settings of the peers", ("tool", *TUNED_ON), settings)
    groups = {case: [case] for case in dict.fromkeys(row["case"] for row in report["rows"])}
    groups |= {f"all {air}": [case for case in groups if every[case].calm == (air == "calm")] for air in TUNED_ON}
    lines = []
    for (group, kinds), tool in itertools.product(groups.items(), (OURS, *tools)):
        rows = [
            row for row in report["rows"] if row["case"] in kinds and row["tool"] == tool and row.get("result") != LOST
        ]
        if rows:
            lines.append((group, tool, str(len(rows)), *figures(rows)))
    errors = [f"{name} {what} [%]" for name in INERTIAS for what in ("mean", "RMS")]
    headings = "flights", "tool", "number", *errors, "95 % hold [%]", "warned [%]", "seconds"
    print_table(f"errors of moments of inertia, flights of {duration:g} s", headings, lines, width=200)
    lines = []
    for row in report["real"]:
        scale = 10.0 ** np.floor(np.log10(REAL[row["flight"]][1].inertia[0]))
        cells = [interval(row.get(name), 1 / scale) for name in INERTIAS]
        reference = REAL[row["flight"]][4]
        known = ", ".join(f"{reference[name] / scale:.2f}" for name in INERTIAS if name in reference)
        warned = "yes" if row["warnings"] else "no"
        lines.append((row["flight"], row["tool"], f"{scale:.0e}", *cells, known, warned, f"{row['seconds']:.1f}"))
    headings = "flight", "tool", "unit [kg m^2]", *INERTIAS, "reference", "warned", "seconds"
    print_table("real flights, 95 % intervals", headings, lines, width=180)


def main(
    flights: Count = 20,
    tuning: int = 1,
    duration: float = 20.0,
    seed: Seed = 65,
    only: list[str] | None = None,
    tools: list[str] = (OURS, *PEERS),
    recorded: list[str] = tuple(REAL),
    recordings: Path | None = None,
    out: Out = None,
) -> None:
    """Fit the same flights by each tool.

    - `tuning`: Number of flights of a kind by which settings are chosen.
    - `only`: Kinds of simulated flights; all by default. `tools`: jaxos4 and the peers.
    - `recorded`: Real flights; - for none. `recordings`: Folder of real flights; by default $JAXOS4_FLIGHTS.
    """
    report = continued(out, {"duration": duration, "seed": seed, "tuning": tuning}, "rows")
    for part in ("chosen", "real"):
        report.setdefault(part, [])
    every = cases()
    check_names("only", only or (), every)
    check_names("tools", tools, (OURS, *PEERS))
    check_names("recorded", recorded, (*REAL, "-"))
    peers = installed([name for name in tools if name in PEERS])
    wanted = only or list(every)

    @functools.lru_cache(maxsize=4)
    def flown(case: str, flight: int) -> jaxos4.Flight | None:
        return every[case].fly(seed + flight, duration)

    def row_of(case: str, flight: int, tool: str, setting: int | None = None, air: str = "") -> Row:
        peer, place = peers.get(tool), "calm" if every[case].calm else "gusts"
        how = {} if peer is None else chosen(tool, place) if setting is None else peer.SETTINGS[setting]
        print(f"{case}, {flight}, {tool} {how}", flush=True)
        return simulated(every[case], flown(case, flight), flight, peer, how)

    def chosen(tool: str, air: str) -> Row:
        settings = peers[tool].SETTINGS
        return settings[best(report["chosen"], tool, settings, air)]

    trials = (
        {"case": case, "flight": UNREPORTED + i, "tool": tool, "setting": k, "air": air}
        for air, kinds in TUNED_ON.items()
        if any(every[case].calm == (air == "calm") for case in wanted)
        for case in kinds
        for i in range(tuning)
        for tool in peers
        for k in range(len(peers[tool].SETTINGS))
    )
    fill(out, report, report["chosen"], trials, row_of)
    compared = [name for name in tools if name == OURS or name in peers]
    trials = ({"case": c, "flight": i, "tool": t} for i in range(flights) for c in wanted for t in compared)
    fill(out, report, report["rows"], trials, row_of)

    def real_row(flight: str, tool: str) -> Row:
        return measured(recordings, flight, peers.get(tool), chosen(tool, "gusts") if tool in peers else {})

    trials = product(flight=[name for name in recorded if name in REAL], tool=compared)
    fill(out, report, report["real"], trials, real_row)
    report["rows"].sort(key=lambda row: wanted.index(row["case"]))
    print_report(report, every, peers, duration, chosen)
