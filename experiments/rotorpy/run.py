"""Are the intervals right if the truth is RotorPy's, not ours?

Each flight: AscTec's Hummingbird as RotorPy simulates it, under RotorPy's SE3 controller, which knows the true state.
The references are sums of sines and steps. The airframe that is given has a thrust coefficient that is 20 % wrong and
moments of inertia that are 25 % wrong; its mass and arms are right. The log has a gyro, an accelerometer, the attitude
and measured rotor speeds. RotorPy's vehicle has effects that the model has otherwise or not at all: see `flights.py`.
"""

import itertools
import sys
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer

import jaxos4

sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parents[1])]

from fits import continued, print_table, run_cases, write_report
from flights import VEHICLE, recorded
from predictions import QUANTITIES, prediction
from rich.console import Console
from shared import table_of

jax.config.update("jax_enable_x64", True)

GUSTS = {"calm": 0.0, "gusty": 1.5}  # [m/s]
KINDS, ESTIMATORS = tuple(GUSTS), ("filter-error", "ibss", "hybrid")


def main(
    recordings: Annotated[Path, typer.Argument(help="Folder of the flights. Those that are missing are flown.")],
    flights: Annotated[int, typer.Option(help="Number of flights of each kind.")] = 20,
    kinds: Annotated[list[str], typer.Option(help="calm, gusty")] = KINDS,
    duration: Annotated[float, typer.Option(help="Length of a flight [s].")] = 20.0,
    seed: Annotated[int, typer.Option(help="Random seed of references, gusts and noise.")] = 21,
    estimators: Annotated[list[str], typer.Option(help="Names of the estimators.")] = (
        "filter-error",
        "ibss",
        "hybrid",
    ),
    predict: Annotated[
        bool, typer.Option(help="Identify each gusty flight, with motion capture, and predict the next 0.5 s ahead.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")] = None,
) -> None:
    """Fly and identify RotorPy's Hummingbird."""

    def flights_of(kind: str) -> list[jaxos4.Flight]:
        return [jaxos4.read_flight(recorded(recordings, GUSTS[kind], i, duration, seed)) for i in range(flights)]

    settings = {"flights": flights, "duration": duration, "seed": seed}
    if predict:
        captured = [recorded(recordings, GUSTS["gusty"], i, duration, seed, captured=True) for i in range(flights)]
        report = continued(out, settings, "predictions")
        rows, known = report["predictions"], [jaxos4.read_flight(path) for path in captured]
        for i in range(len(rows), flights):
            rows.append(prediction(known, i))
            write_report(out, report)
        table = table_of("0.5 s ahead", ("", "error", "of the true parameters", "ratio", "inside the 95 % band [%]"))
        for name in QUANTITIES:
            error, true, held = np.mean([list(row[name].values()) for row in rows], axis=0)
            table.add_row(name, f"{error:.3g}", f"{true:.3g}", f"{error / true:.2f}", f"{100 * held:.1f}")
        Console(width=150).print(table)
        return
    report = run_cases(out, settings, list(itertools.product(kinds, estimators)), VEHICLE, flights_of)
    print_table(f"RotorPy's Hummingbird, flights of {duration:g} s", report)


if __name__ == "__main__":
    typer.run(main)
