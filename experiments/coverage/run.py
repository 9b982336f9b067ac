"""How often do 95 % intervals contain the truth, for the alphas and for the constants of the rigid body?

IBSS, the hybrid and output error identify noisy standard flights with one true vehicle. Each bracket's center is drawn
within 80 % of the default half-widths around the truth. The constants Ix, Iy, Iz, J_R are fitted to the alphas of each
flight and their covariance.
"""

import functools
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, continued, fill, in_words, print_table
from experiments.shared import PARAMETERS, fit_noisy, scores, standard_problem
from jaxos4.models import MODELS
from jaxos4.results import NINETY_FIVE

ESTIMATORS = {"ibss": jaxos4.IBSS, "hybrid": jaxos4.Hybrid, "output-error": jaxos4.OutputError}
CONSTANTS = ("Ix", "Iy", "Iz", "J_R")


def rigid_bodies(model: jaxos4.AbstractModel, found: jaxos4.Estimate) -> Row:
    """How often intervals of the constants hold the truth, and how often the alphas do not seem to be of one body."""
    rigid = jaxos4.fit_inertia(model, found.parameters, found.covariance)
    truth = np.append(np.asarray(model.airframe.inertia), model.airframe.rotor_inertia)
    outside = np.abs(rigid.constants - truth) > NINETY_FIVE * np.asarray(rigid.std)
    covered = (np.isfinite(rigid.std) & ~outside).mean(axis=0)
    return {"constants_covered": covered.tolist(), "inconsistent": float((rigid.p_value < 0.05).mean())}


def main(
    flights: Annotated[int, typer.Option(help="Number of flights for each row.")] = 2000,
    seed: Annotated[int, typer.Option(help="Random seed for noise and brackets.")] = 11,
    model: Annotated[str, typer.Option(help="Model: published or corrected.")] = "published",
    channels: Annotated[str, typer.Option(help="Channels that are compared: rates, attitude or all.")] = "all",
    estimators: Annotated[list[str], typer.Option(help="Names of the estimators.")] = tuple(ESTIMATORS),
    scales: Annotated[list[float], typer.Option(help="Noise / standard noise.")] = (0.1, 1.0, 10.0),
    steps: Annotated[int, typer.Option(help="Training steps of the hybrid's network.")] = jaxos4.NetworkEstimator.steps,
    out: Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")] = None,
) -> None:
    """Measure the coverage of 95 % intervals."""
    vehicle, error = MODELS[model](jaxos4.OS4), np.sqrt(0.95 * 0.05 / flights)

    @functools.cache
    def network() -> jaxos4.TrainedNetwork:
        training = jaxos4.NetworkEstimator(channels=channels, steps=steps)
        standard = standard_problem(vehicle, channels)
        return training.fit(standard, jaxos4.Bracket.default(vehicle), key=jax.random.key(0))

    def row_of(scale: float, estimator: str) -> Row:
        problem = standard_problem(vehicle, channels, scale=scale)
        chosen = jaxos4.Hybrid(network()) if estimator == "hybrid" else ESTIMATORS[estimator]()
        found, seconds = fit_noisy(chosen, problem, flights, seed)
        return scores(problem, found) | rigid_bodies(vehicle, found) | {"seconds": flights * seconds}

    settings = {"seed": seed, "flights": flights, "model": model, "channels": channels, "monte_carlo_error": error}
    report = continued(out, settings, "rows")
    trials = ({"scale": scale, "estimator": name} for scale in scales for name in estimators)
    fill(out, report, report["rows"], trials, row_of)
    cells = (
        (
            *(f"{row['scale']:g}", row["estimator"]),
            *(f"{100 * x:.1f}" for x in (*row["covered"], *row["constants_covered"], row["inconsistent"])),
            *(f"{row['seconds']:.0f}", in_words(row["results"])),
        )
        for row in report["rows"]
    )
    title = f"95 % intervals that contain the truth [%], {flights} flights, {model}, {channels}"
    headings = "scale", "estimator", *PARAMETERS, *CONSTANTS, "p < 5 %", "s", "results"
    print_table(title, headings, cells, width=170)
    print(f"Monte-Carlo error of each number: {100 * error:.2f} %.")
