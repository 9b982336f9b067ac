"""How close do the shooting methods come to the Cramer-Rao bound?

Many noisy standard flights are identified in one call, by IBSS if the case names no other estimator. They are simulated
with the model that is fitted (the inverse crime), so that the bound applies.
"""

from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, continued, fill, in_words, print_table
from experiments.shared import PARAMETERS, fit_noisy, scores, standard_problem


class Case(NamedTuple):
    """The model and the data of a case. Several windows have free starts."""

    model: type[jaxos4.AbstractModel]
    channels: str
    known: bool = True
    windows: int = 1
    estimator: type[jaxos4.AbstractEstimator] = jaxos4.IBSS


CASES = {
    "published, all": Case(jaxos4.PublishedOS4, "all"),
    "published, rates": Case(jaxos4.PublishedOS4, "rates"),
    "published, all, free start": Case(jaxos4.PublishedOS4, "all", known=False),
    "corrected, all": Case(jaxos4.CorrectedOS4, "all"),
    "corrected, rates": Case(jaxos4.CorrectedOS4, "rates"),
    "published, all, 4 windows": Case(jaxos4.PublishedOS4, "all", known=False, windows=4),
    "published, all, 4 windows, output error": Case(
        jaxos4.PublishedOS4, "all", known=False, windows=4, estimator=jaxos4.OutputError
    ),
}


def main(
    flights: Annotated[int, typer.Option(help="Number of flights for each case.")] = 512,
    seed: Annotated[int, typer.Option(help="Random seed for noise and starts.")] = 0,
    scale: Annotated[float, typer.Option(help="Noise scale, in multiples of the standard sensor noise.")] = 1.0,
    cases: Annotated[list[str], typer.Option(help="Names of the cases.")] = tuple(CASES),
    out: Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")] = None,
) -> None:
    """Measure RMSE / Cramer-Rao bound for each parameter."""

    def row_of(case: str) -> Row:
        of = CASES[case]
        settings = {"scale": scale, "known": of.known, "windows": of.windows}
        problem = standard_problem(of.model(jaxos4.OS4), of.channels, **settings)
        found, seconds = fit_noisy(of.estimator(), problem, flights, seed)
        return scores(problem, found) | {"seconds": flights * seconds}

    report = continued(out, {"flights": flights, "seed": seed, "scale": scale}, "cases")
    fill(out, report, report["cases"], ({"case": name} for name in cases), row_of)
    cells = (
        (
            *(row["case"], *(f"{x:.2f}" for x in row["efficiency"]), f"{np.mean(row['covered']):.3f}"),
            *(in_words(row["results"]), f"{row['rollouts']:.0f}", f"{row['seconds']:.1f}"),
        )
        for row in report["cases"]
    )
    title = f"RMSE / bound, {flights} flights, noise {scale:g}, Monte-Carlo error {1 / np.sqrt(2 * flights):.3f}"
    print_table(title, ("case", *PARAMETERS, "covered", "results", "rollouts", "s"), cells)
