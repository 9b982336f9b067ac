"""Are the estimators' defaults the best of their settings?

Noisy standard flights are identified with each value of a setting, with starts within 80 % of the default half-widths
around the truth. The bound is that of the channels that the estimator sees.
"""

import functools
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, continued, fill, in_words, print_table
from experiments.shared import fit_noisy, scores, span, standard_problem
from jaxos4.models import MODELS

BOTH, NOISES = ("published", "corrected"), (0.1, 1.0, 10.0)


class Setting(NamedTuple):
    """An estimator with a setting, and the flights on which it is measured."""

    estimator: jaxos4.AbstractEstimator
    channels: str = "rates"
    known: bool = True
    scales: tuple[float, ...] = (1.0,)
    models: tuple[str, ...] = ("published",)


SETTINGS = {
    **{f"equation error, memory {m:g}": Setting(jaxos4.EquationError(memory=m)) for m in (0.0, 0.9, 0.99)},
    "equation error, memory 1 (default)": Setting(jaxos4.EquationError(), scales=NOISES),
    **{
        f"recursive least squares, forgetting {f:g}": Setting(jaxos4.RecursiveLeastSquares(forgetting=f), known=False)
        for f in (0.98, 0.995)
    },
    "recursive least squares, forgetting 1 (default)": Setting(jaxos4.RecursiveLeastSquares(), known=False),
    "SVSF, equilibration 1": Setting(jaxos4.SVSF(equilibration=1.0), scales=NOISES),
    **{f"SVSF, passes {n}": Setting(jaxos4.SVSF(passes=n), scales=NOISES) for n in (1, 8)},
    "SVSF (default: equilibration 150, passes 4)": Setting(jaxos4.SVSF(), scales=NOISES, models=BOTH),
    "SVSF (default), free start": Setting(jaxos4.SVSF(), known=False, scales=NOISES),
    "Kalman filter, passes 1, rates": Setting(jaxos4.JointEKF(passes=1), models=BOTH),
    "Kalman filter, passes 1": Setting(jaxos4.JointEKF(passes=1), "all", models=BOTH),
    "Kalman filter, passes 10 (default)": Setting(jaxos4.JointEKF(), "all", models=BOTH),
    "output error, ten times the noise, free start": Setting(jaxos4.OutputError(), "all", False, (10.0,)),
    "IBSS, ten times the noise, free start": Setting(jaxos4.IBSS(), "all", False, (10.0,)),
    **{f"ant colony, q {q:g}": Setting(jaxos4.AntColony(q=q), "all") for q in (0.02, 0.1)},
    **{f"ant colony, xi {xi:g}": Setting(jaxos4.AntColony(xi=xi), "all") for xi in (0.7, 1.0)},
    "ant colony, archive 30": Setting(jaxos4.AntColony(archive=30), "all"),
    "ant colony (default: q 0.05, xi 0.85, archive 50)": Setting(jaxos4.AntColony(), "all"),
}


def main(
    flights: Annotated[int, typer.Option(help="Number of flights for each row.")] = 64,
    seed: Annotated[int, typer.Option(help="Random seed for noise and starts.")] = 7,
    settings: Annotated[list[str], typer.Option(help="The settings, by name.")] = tuple(SETTINGS),
    out: Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")] = None,
) -> None:
    """Compare values of the estimators' settings."""

    def problem_of(model: str, channels: str, scale: float, known: bool) -> jaxos4.ShootingProblem:
        return standard_problem(MODELS[model](jaxos4.OS4), channels, scale=scale, known=known)

    @functools.cache
    def least_costs(*flown: Any) -> np.ndarray:
        return np.asarray(fit_noisy(jaxos4.OutputError(), problem_of(*flown), flights, seed)[0].cost)

    def row_of(setting: str, model: str, scale: float) -> Row:
        of = SETTINGS[setting]
        flown = model, of.channels, scale, of.known
        problem = problem_of(*flown)
        found, _ = fit_noisy(of.estimator, problem, flights, seed)
        # Costs of estimators without a search are those of another criterion.
        gap = float(np.max(np.asarray(found.cost) - least_costs(*flown))) if of.estimator.shoots else 0.0
        return scores(problem, found) | {"gap": gap}

    report = continued(out, {"flights": flights, "seed": seed}, "rows")
    trials = (
        {"setting": name, "model": model, "scale": scale}
        for name in settings
        for model in SETTINGS[name].models
        for scale in SETTINGS[name].scales
    )
    fill(out, report, report["rows"], trials, row_of)
    cells = (
        (
            *(row["setting"], row["model"], f"{row['scale']:g}"),
            span(np.asarray(row["efficiency"] or [])),
            f"{100 * np.mean(row['covered']):.0f}",
            f"{row['rollouts']:.0f}",
            f"{row['gap']:.1g}" if SETTINGS[row["setting"]].estimator.shoots else "",
            in_words(row["results"]),
        )
        for row in report["rows"]
    )
    headings = "setting", "model", "noise", "RMSE / bound", "95 % intervals that hold [%]", "rollouts", "gap", "results"
    print_table(f"{flights} flights, Monte-Carlo error {1 / np.sqrt(2 * flights):.2g}", headings, cells, width=170)
