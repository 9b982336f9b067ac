"""Are answers right on flights of another's simulator, which shares no code with this package?

Its folder has `cases.jsonl`, `fly.py` and `truth.py`; it needs a C compiler and SciPy. Each case becomes a log, the
airframe that a user would write, and the true values. Each log is identified as `jaxos4 estimate` does by default.
`--sag` adds flights whose battery sags under load, with commands logged; `--clean` adds flights without any fault.

Counted are Ix, Iy and Iz: *identified* and beyond three standard deviations or 12 % of the truth; with a reservation
and beyond four; refused although right, within two standard deviations and 10 %. The truths of damping and drag are
linearised about hover, which is worth 5 %. The thrust gain of commands depends on the motor, and has no truth.
"""

import json
import os
import runpy
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import jaxos4
from experiments.fits import INERTIAS, identified
from experiments.monte_carlo import Row, plus_minus, print_table, product, share, statistics, study
from experiments.shared import Out
from experiments.verdicts.run import FAR, SURE
from jaxos4.identification.tables import physical_quantities
from jaxos4.identification.verdict import CONTRADICTED, IDENTIFIED, MISSING, RESERVED
from jaxos4.results import NINETY_FIVE

OTHERS = ("roll_damping", "pitch_damping", "yaw_damping", "z_drag", "thrust_gain")
LINEARISED, SHARE = OTHERS[:4], 0.05  # truths that are known to this share
RESERVED_SURE = 4.0  # standard deviations; beyond, an answer with a reservation is wrong
RIGHT_SURE, RIGHT_SHARE = 2.0, 0.1  # standard deviations and share of the truth; within both, an answer is right
LETTERS = {IDENTIFIED: "I", RESERVED: "R", MISSING: "N", CONTRADICTED: "C"}
VEHICLES = "nano", "five", "big"
SAGS = 0.0, 0.03, 0.06, 0.1  # share of the voltage that a hover load takes
KINDS, SEED, SECONDS = ("sine", "step"), 2000, 40  # of the flights of both studies

BESIDE = Path(__file__).resolve().parents[3] / "shared" / "cases" / "truth"  # beside the checkout

Fly = Callable[[Row, Path], None]
"""Writes NAME.csv, NAME.toml and NAME.truth.json of a case into a folder."""


def simulator(folder: Path | None) -> tuple[dict[str, Row], Fly]:
    """The cases of the simulator in a folder by name, and what flies them. Default: `$JAXOS4_TRUTH`, or `BESIDE`."""
    folder = folder or Path(os.environ.get("JAXOS4_TRUTH") or BESIDE)
    if not (folder / "cases.jsonl").is_file():
        raise SystemExit(f"--truth: no cases.jsonl in {folder}: give the folder of the simulator, or set JAXOS4_TRUTH.")
    lines = (folder / "cases.jsonl").read_text(encoding="utf-8").splitlines()
    sys.path.insert(0, str(folder))  # its files import each other
    cases = {case["name"]: case for case in map(json.loads, filter(None, lines))}
    return cases, runpy.run_path(str(folder / "fly.py"))["fly"]


def studies(sag: int, clean: int) -> dict[str, Row]:
    """The cases of both studies, with this many seeds of each vehicle, and of each sag."""
    every = []
    for size in VEHICLES:
        for i in range(max(sag, clean)):
            flight = {"size": size, "seed": SEED + i, "kind": KINDS[i % 2], "seconds": SECONDS}
            if i < clean:
                every.append({**flight, "name": f"clean_{size}_{i}", "effect": f"clean, {size}"})
            for lost in SAGS if i < sag else ():
                battery = {"motor_mode": 1.0, "curve": 0.8, "sag_load": lost, "sag_lin": 0.001}
                about = {"name": f"sag_{100 * lost:g}_{size}_{i}", "effect": f"sag {100 * lost:g} %, {size}"}
                every.append({**flight, **about, "sim": {"over": battery}, "log": {"motors": "commands"}})
    return {case["name"]: case for case in every}


def judged(case: Row, fly: Fly) -> Row:
    """The row of one case: for each quantity with a truth its estimate, standard deviation and verdict.

    `missing`: the verdicts of moments of inertia without an estimate.
    """
    row: Row = {"effect": case["effect"], "quantities": {}, "missing": {}}
    with tempfile.TemporaryDirectory() as folder:
        fly(case, Path(folder))
        path = Path(folder) / case["name"]
        truth = json.loads(path.with_suffix(".truth.json").read_text(encoding="utf-8"))
        begun, found = identified(path.with_suffix(".csv"), jaxos4.load_airframe(str(path.with_suffix(".toml"))))
    row |= begun
    if found is None:
        return row
    for each in physical_quantities(found):
        name = each.name.replace(" ", "_") + "_mm" * (each.unit == "mm")
        if name in truth and each.verdict is not None:
            verdict = {"status": each.verdict.status, "reasons": list(each.verdict.reasons)}
            row["quantities"][name] = {"truth": truth[name], "estimate": each.value, "std": each.std, **verdict}
    absent = (name for name in INERTIAS if name in found.verdicts and name not in row["quantities"])
    row["missing"] = {name: found.verdicts[name].status for name in absent}
    return row | {"notes": list(found.provenance.notes)}


def errors_of(rows: list[Row], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Error and standard deviation of a quantity in all rows that have it, as shares of the truth."""
    known = [row["quantities"][name] for row in rows if name in row["quantities"]]
    values = np.array([(each["estimate"], each["std"], each["truth"]) for each in known]).reshape(-1, 3).T
    return values[0] / values[2] - 1, values[1] / values[2]


def counts(rows: list[Row]) -> Iterator[tuple[str, int, str]]:
    """What is counted, of how many values it is, and the names of the cases and quantities."""
    every = []
    for row in rows:
        for name in INERTIAS:
            if name in row["quantities"]:
                (off,), (std,) = errors_of([row], name)
                every.append((f"{row['case']} {name}", row["quantities"][name]["status"], abs(off), abs(off) / std))
    said = {
        "identified, beyond 3 std or 12 %": [
            a for a, s, off, z in every if s == IDENTIFIED and (z > SURE or off > FAR)
        ],
        "with a reservation, beyond 4 std": [a for a, s, _, z in every if s == RESERVED and z > RESERVED_SURE],
        "refused, but right": [
            a for a, s, off, z in every if s in (MISSING, CONTRADICTED) and z < RIGHT_SURE and off < RIGHT_SHARE
        ],
    }
    yield from ((what, len(names), ", ".join(names)) for what, names in said.items())
    yield "values", len(every), ""


def cell(row: Row, name: str) -> str:
    """Estimate over truth, error in standard deviations, letter of the verdict; only the letter without an estimate."""
    if name not in row["quantities"]:
        return LETTERS[row["missing"][name]] if name in row["missing"] else ""
    (off,), (std,) = errors_of([row], name)
    return f"{1 + off:.3f} {off / std:+.1f} {LETTERS[row['quantities'][name]['status']]}"


def by_effect(groups: dict[str, list[Row]]) -> Iterator[tuple[str, ...]]:
    """For each group and moment of inertia: errors, their size in standard deviations, intervals and verdicts."""
    for effect, rows in groups.items():
        for name in INERTIAS:
            off, std = errors_of(rows, name)
            if not off.size:
                continue
            found, z = statistics(off, std), off / std
            known = [row["quantities"][name]["status"] for row in rows if name in row["quantities"]]
            trusted = share(sum(each in (IDENTIFIED, RESERVED) for each in known), len(rows))
            mean_z, rms_z = plus_minus(statistics(z, np.ones_like(z)), scale=1.0), f"{np.sqrt(np.mean(z**2)):.2f}"
            held, width = plus_minus(found, "covered"), f"{100 * found['width']:.1f}"
            yield effect, name, str(off.size), plus_minus(found), mean_z, rms_z, held, width, trusted


def linearised(rows: list[Row]) -> Iterator[tuple[str, ...]]:
    """How many intervals of damping and drag hold the truth, which is known to 5 %, and of those identified."""
    for name in LINEARISED:
        off, std = errors_of(rows, name)
        held = np.abs(off) < NINETY_FIVE * np.hypot(std, SHARE)
        known = [row["quantities"][name]["status"] == IDENTIFIED for row in rows if name in row["quantities"]]
        sure = np.array(known, dtype=bool)
        yield name, str(held.size), share(int(held.sum()), held.size), share(int(held[sure].sum()), int(sure.sum()))


def print_tables(rows: list[Row]) -> None:
    """A line for each case, the counts, and statistics of effects with several flights."""
    lines = [
        (row["case"], row["effect"], *(cell(row, name) for name in (*INERTIAS, *OTHERS)), row["result"]) for row in rows
    ]
    names = (name.replace("_", " ") for name in (*INERTIAS, *OTHERS))
    letters = ", ".join(f"{letter}: {status}" for status, letter in LETTERS.items())
    title = f"estimate over truth, error in standard deviations, verdict ({letters})"
    print_table(title, ("case", "effect", *names, "results"), lines, width=240)
    print_table("counts of Ix, Iy and Iz", ("", "values", "results"), ((a, str(n), b) for a, n, b in counts(rows)))
    groups = {effect: [row for row in rows if row["effect"] == effect] for effect in (row["effect"] for row in rows)}
    several = {effect: some for effect, some in groups.items() if len(some) > 2}
    headings = "effect", "", "flights", "mean error [%]", "mean z", "rms z", "held [%]", "half-width [%]", "trusted [%]"
    print_table("moments of inertia by effect", headings, by_effect(several))
    headings = "", "flights", "intervals that hold [%]", "of those identified [%]"
    print_table("damping and drag", headings, linearised(rows))


def main(truth: Path | None = None, cases: list[str] = (), sag: int = 0, clean: int = 0, out: Out = None) -> None:
    """Judge answers against the truth of an independent simulator.

    - `truth`: Folder of the simulator; $JAXOS4_TRUTH by default.
    - `cases`: Names of its cases; by default all, `none`: none.
    - `sag`: Flights of each vehicle and sag of the battery, commands logged.
    - `clean`: Flights of each vehicle without a fault, speeds logged.
    """
    known, fly = simulator(truth)
    if unknown := [name for name in cases if name not in (*known, "none")]:
        raise SystemExit(f"--cases: no {unknown[0]} in cases.jsonl; give one of {', '.join(known)}, or none.")
    chosen = {name: known[name] for name in cases or known if name in known} | studies(sag, clean)
    rows = study(out, {"seed": SEED}, product(case=chosen), lambda case: judged(chosen[case], fly))
    print_tables([row for row in rows if row["case"] in chosen])
