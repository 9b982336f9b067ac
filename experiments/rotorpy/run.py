"""Are the intervals right if the truth is RotorPy's, not ours?

Each flight: AscTec's Hummingbird as RotorPy simulates it, under RotorPy's SE3 controller, which knows the true state.
The references are sums of sines and steps. The airframe that is given has a thrust coefficient that is 20 % wrong and
moments of inertia that are 25 % wrong; its mass and arms are right. The log has a gyro, an accelerometer, the attitude
and measured rotor speeds. RotorPy's vehicle has effects that the model has otherwise or not at all: see `flights.py`.
"""

import functools
import itertools
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

import jaxos4
from experiments.fits import fit, print_summaries, summary
from experiments.monte_carlo import Row, continued, fill, monte_carlo, print_table
from experiments.rotorpy.flights import GUSTS, VEHICLE, recorded
from experiments.rotorpy.predictions import QUANTITIES, prediction

KINDS, ESTIMATORS = tuple(GUSTS), ("filter-error", "ibss", "hybrid")


def read(recordings: Path, settings: Row, kind: str, *, captured: bool = False) -> list[jaxos4.Flight]:
    """The flights of a kind; those that are missing are flown."""
    about = GUSTS[kind], settings["duration"], settings["seed"]
    paths = (recorded(recordings, i, *about, captured=captured) for i in range(settings["flights"]))
    return [jaxos4.read_flight(path) for path in paths]


def predicted(out: Path | None, settings: Row, recordings: Path) -> list[Row]:
    """Predictions of each gusty flight by the vehicle of the one before; continued if `out` exists."""
    report, known = continued(out, settings, "predictions"), read(recordings, settings, "gusty", captured=True)
    numbers = ({"flight": i} for i in range(settings["flights"]))
    fill(out, report, report["predictions"], numbers, lambda flight: prediction(known, flight))
    return report["predictions"]


def main(
    recordings: Annotated[Path, typer.Argument(help="Folder of the flights. Those that are missing are flown.")],
    flights: Annotated[int, typer.Option(help="Number of flights of each kind.")] = 20,
    kinds: Annotated[list[str], typer.Option(help="calm, gusty")] = KINDS,
    duration: Annotated[float, typer.Option(help="Length of a flight [s].")] = 20.0,
    seed: Annotated[int, typer.Option(help="Random seed of references, gusts and noise.")] = 21,
    estimators: Annotated[list[str], typer.Option(help="Names of the estimators.")] = ESTIMATORS,
    predict: Annotated[
        bool, typer.Option(help="Identify each gusty flight, with motion capture, and predict the next 0.5 s ahead.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")] = None,
) -> None:
    """Fly and identify RotorPy's Hummingbird."""
    settings = {"flights": flights, "duration": duration, "seed": seed}
    if predict:
        rows = predicted(out, settings, recordings)
        headings = "", "error", "of the true parameters", "ratio", "inside the 95 % band [%]"
        means = {name: np.mean([list(row[name].values()) for row in rows], axis=0) for name in QUANTITIES}
        cells = [
            (name, f"{error:.3g}", f"{true:.3g}", f"{error / true:.2f}", f"{100 * held:.1f}")
            for name, (error, true, held) in means.items()
        ]
        print_table("0.5 s ahead", headings, cells)
        return

    def row_of(flight: jaxos4.Flight, i: int, kind: str, estimator: str) -> Row:
        return fit(estimator, flight, VEHICLE, i)

    cases = [{"kind": kind, "estimator": name} for kind, name in itertools.product(kinds, estimators)]
    flown = functools.cache(lambda kind: read(recordings, settings, kind))
    report = monte_carlo(out, settings, cases, lambda kind, **_: flown(kind), row_of, summary)
    print_summaries(f"RotorPy's Hummingbird, flights of {duration:g} s", report)
