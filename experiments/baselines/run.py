"""How do all estimators perform on the standard flight, for each kind and scale of noise?

The table shows RMSE / bound, bias, coverage, rollouts and time. Each bracket's center is drawn within 80 % of the
default half-widths around the truth. The bound is always the one for white noise of the same standard deviation, so
that the cost of coloured and biased noise is visible. Without noise, errors are in units of the bound at scale 1.
"""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, continued, fill, in_words, print_table
from experiments.shared import PARAMETERS, fit_noisy, scores, standard_problem
from jaxos4.estimators import ESTIMATORS as ALL
from jaxos4.noise import NOISES

ESTIMATORS: dict[str, Callable[[], jaxos4.AbstractEstimator]] = {
    name: kind for name, kind in ALL.items() if not kind.needs_network
}


def main(
    flights: Annotated[int, typer.Option(help="Number of flights for each row.")] = 200,
    seed: Annotated[int, typer.Option(help="Random seed for noise and brackets.")] = 5,
    channels: Annotated[str, typer.Option(help="Channels that are compared: rates, attitude or all.")] = "rates",
    estimators: Annotated[list[str], typer.Option(help="Names of the estimators.")] = tuple(ESTIMATORS),
    noises: Annotated[list[str], typer.Option(help="Kinds of noise.")] = tuple(NOISES),
    scales: Annotated[list[float], typer.Option(help="Noise / standard noise; 0: no noise.")] = (0.0, 0.1, 1.0, 10.0),
    out: Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")] = None,
) -> None:
    """Compare all estimators, with their default settings, on the standard flight."""

    def row(noise: str, scale: float, estimator: str) -> Row:
        kind = NOISES[noise if scale else "white"](scale * jaxos4.SENSOR_SIGMA)
        problem = standard_problem(jaxos4.PublishedOS4(jaxos4.OS4), channels, scale=scale or 1.0)
        _, (found, seconds) = (fit_noisy(ESTIMATORS[estimator](), problem, flights, seed, kind) for _ in range(2))
        return scores(problem, found) | {"seconds": seconds}

    report = continued(out, {"seed": seed, "channels": channels, "flights": flights}, "rows")
    trials = (
        {"noise": kind, "scale": scale, "estimator": name}
        for kind, scale, name in itertools.product(noises, scales, estimators)
        if scale or kind == noises[0]
    )
    fill(out, report, report["rows"], trials, row)
    cells = (
        (
            *(row["noise"] if row["scale"] else "none", f"{row['scale']:g}", row["estimator"]),
            *((f"{x:.2g}" for x in row["efficiency"]) if row["efficiency"] else [""] * len(PARAMETERS)),
            f"{np.abs(row['bias']).max():.2g}" if row["bias"] else "",
            f"{100 * np.mean(row['covered']):.0f}",
            *(f"{row['rollouts']:.0f}", f"{1000 * row['seconds']:.3g}", in_words(row["results"])),
        )
        for row in report["rows"]
    )
    title = f"RMSE / Cramer-Rao bound of white noise, {channels}, {flights} flights"
    headings = "noise", "scale", "estimator", *PARAMETERS, "bias", "95 %", "rollouts", "ms", "results"
    print_table(title, headings, cells, width=170)
