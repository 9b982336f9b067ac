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
from typing import Annotated, Any

import numpy as np
import typer

import jaxos4
from experiments.fits import INERTIAS, fit, given_airframe
from experiments.monte_carlo import Row, continued, covered_error, fill, print_table
from experiments.peers.flights import REAL, Case, cases, real
from experiments.peers.log import Fit, Log
from jaxos4.errors import InputError
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


def shares(found: Fit, truth: np.ndarray) -> Row:
    """Errors and standard deviations of the moments of inertia as shares of the truth."""
    errors, stds = (found.inertia / truth - 1).tolist(), (found.std / truth).tolist()
    return {name: {"error": e, "std": s} for name, e, s in zip(INERTIAS, errors, stds, strict=True)}


def timed(peer: Any, log: Log, setting: Row) -> tuple[Fit | None, Row]:
    """A fit, or `None` if the tool failed, with warnings and seconds as the begin of its row."""
    begin = time.perf_counter()
    try:
        found = peer.fit(log, **setting)
    except (ValueError, np.linalg.LinAlgError) as error:
        return None, {"warnings": [f"failed: {error}"], "seconds": time.perf_counter() - begin}
    return found, {"warnings": found.warnings, "seconds": time.perf_counter() - begin}


def simulated(case: Case, flight: jaxos4.Flight | None, i: int, peer: Any, setting: Row) -> Row:
    """The row of one simulated flight by one tool; `peer` is `None`: jaxos4."""
    if flight is None:
        return {"lost": True}
    if peer is None:
        row = fit("filter-error", flight, case.vehicle, i)
        warnings = [*row.pop("doubts", []), *([] if row["result"] == "successful" else [row["result"]])]
        return row | {"warnings": warnings}
    log = Log.of(Recording.of(flight, "flight"), given_airframe(case.vehicle, i), commands=case.commands)
    found, row = timed(peer, log, setting)
    return row if found is None else row | shares(found, np.asarray(case.vehicle.inertia))


def measured(folder: Path | None, name: str, peer: Any, setting: Row) -> Row:
    """The row of one real flight by one tool: estimates and standard deviations [kg m^2]."""
    recording, (_, airframe, _, logged, _) = real(folder, name), REAL[name]
    if peer is not None:
        log = Log.of(recording, airframe, commands=logged == "commands")
        found, row = timed(peer, log, setting)
        if found is None:
            return row
        pairs = zip(found.inertia.tolist(), found.std.tolist(), strict=True)
        return row | {n: {"estimate": x, "std": s} for n, (x, s) in zip(INERTIAS, pairs, strict=True)}
    begin = time.perf_counter()
    try:
        found = jaxos4.identify(recording, airframe, settings=jaxos4.VehicleSettings(holdout=0.0))
    except InputError as error:
        return {"warnings": [str(error)], "seconds": time.perf_counter() - begin}
    row: Row = {"warnings": [*map(str, found.issues)], "seconds": time.perf_counter() - begin}
    known = found.rigid_body.constants
    return row | {n: {"estimate": known[n].estimate, "std": known[n].std} for n in INERTIAS if n in known}


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
        if not error.size:
            yield from ("", "")
            continue
        apart = f" +- {100 * error.std(ddof=1) / np.sqrt(error.size):.2g}" if error.size > 1 else ""
        yield f"{100 * error.mean():.2g}{apart}"
        yield f"{100 * np.sqrt(np.mean(error**2)):.2g}"
    share, flights = float(np.mean(covered)) if covered else 0.0, max(len(rows), 1)
    yield f"{100 * share:.0f} +- {100 * covered_error(share, flights):.0f}" if covered else ""
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
        rows = [row for row in report["rows"] if row["case"] in kinds and row["tool"] == tool and "lost" not in row]
        if rows:
            lines.append((group, tool, str(len(rows)), *figures(rows)))
    errors = [f"{name} {what} [%]" for name in INERTIAS for what in ("mean", "RMS")]
    headings = "flights", "tool", "number", *errors, "95 % hold [%]", "warned [%]", "seconds"
    print_table(f"errors of moments of inertia, flights of {duration:g} s", headings, lines, width=200)
    lines = []
    for row in report["real"]:
        scale = 10.0 ** np.floor(np.log10(REAL[row["flight"]][1].inertia[0]))
        values = [row.get(name) for name in INERTIAS]
        cells = [f"{x['estimate'] / scale:.2f} +- {NINETY_FIVE * x['std'] / scale:.2f}" if x else "" for x in values]
        reference = REAL[row["flight"]][4]
        known = ", ".join(f"{reference[name] / scale:.2f}" for name in INERTIAS if name in reference)
        warned = "yes" if row["warnings"] else "no"
        lines.append((row["flight"], row["tool"], f"{scale:.0e}", *cells, known, warned, f"{row['seconds']:.1f}"))
    headings = "flight", "tool", "unit [kg m^2]", *INERTIAS, "reference", "warned", "seconds"
    print_table("real flights, 95 % intervals", headings, lines, width=180)


def main(
    flights: Annotated[int, typer.Option(help="Number of simulated flights in each row.")] = 20,
    tuning: Annotated[int, typer.Option(help="Number of flights of a kind by which settings are chosen.")] = 1,
    duration: Annotated[float, typer.Option(help="Length of a simulated flight [s].")] = 20.0,
    seed: Annotated[int, typer.Option(help="Random seed of references, gusts and noise.")] = 65,
    only: Annotated[list[str] | None, typer.Option(help="Kinds of simulated flights; all by default.")] = None,
    tools: Annotated[list[str], typer.Option(help="jaxos4 and the peers.")] = (OURS, *PEERS),
    recorded: Annotated[list[str], typer.Option(help="Real flights; - for none.")] = tuple(REAL),
    recordings: Annotated[Path | None, typer.Option(help="Folder of real flights; by default $JAXOS4_FLIGHTS.")] = None,
    out: Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")] = None,
) -> None:
    """Fit the same flights by each tool."""
    report = continued(out, {"duration": duration, "seed": seed, "tuning": tuning}, "rows")
    for part in ("chosen", "real"):
        report.setdefault(part, [])
    every, peers = cases(), installed([name for name in tools if name in PEERS])
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
    trials = ({"flight": name, "tool": tool} for name in recorded if name in REAL for tool in compared)

    def real_row(flight: str, tool: str) -> Row:
        return measured(recordings, flight, peers.get(tool), chosen(tool, "gusts") if tool in peers else {})

    fill(out, report, report["real"], trials, real_row)
    report["rows"].sort(key=lambda row: wanted.index(row["case"]))
    print_report(report, every, peers, duration, chosen)
