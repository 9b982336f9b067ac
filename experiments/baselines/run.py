"""How do all estimators perform on the standard flight, for each kind and scale of noise?

The table shows RMSE / bound, bias, coverage, rollouts and time. Each bracket's center is drawn within 80 % of the
default half-widths around the truth. The bound is always the one for white noise of the same standard deviation, so
that the cost of coloured and biased noise is visible. Without noise, errors are in units of the bound at scale 1.
"""

import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, continued, count_results, fill, in_words, print_table
from experiments.shared import PARAMETERS, brackets_around, identify, measure, noise_and_bracket_keys
from jaxos4.estimators import ESTIMATORS as ALL
from jaxos4.noise import NOISES

ESTIMATORS: dict[str, Callable[[], jaxos4.AbstractEstimator]] = {
    name: kind for name, kind in ALL.items() if not kind.needs_network
}


def row_of(
    estimator: jaxos4.AbstractEstimator,
    noise: jaxos4.AbstractNoise,
    scale: float,
    channels: str,
    flights: int,
    seed: int,
) -> Row:
    """The results of one estimator with one noise: a row of the table."""
    model = jaxos4.PublishedOS4(jaxos4.OS4)
    exact = jaxos4.simulate(model, model.alpha, jaxos4.multisine(model.airframe), dt=0.01)
    problem = jaxos4.ShootingProblem(
        model, exact, sigma=(scale or 1.0) * jaxos4.SENSOR_SIGMA, initial_state=exact.states[0], channels=channels
    )
    noise_keys, start_keys = noise_and_bracket_keys(seed, flights)
    states, brackets = measure(noise, exact, noise_keys), brackets_around(model, start_keys)
    jax.block_until_ready(identify(estimator, problem, brackets, states))
    begin = time.perf_counter()
    found = jax.block_until_ready(identify(estimator, problem, brackets, states))
    seconds = (time.perf_counter() - begin) / flights
    bound = np.sqrt(np.diagonal(jaxos4.cramer_rao_bound(problem, model.alpha)))
    results = jaxos4.result_names(found.result)
    answered = np.isin(results, ["successful", "unidentifiable"])
    errors = np.asarray(found.parameters - model.alpha)[answered] / bound
    inside = np.abs(np.asarray(found.parameters - model.alpha)) < np.asarray(found.half_width(0.95))
    return {
        "flights": flights,
        "answers": int(answered.sum()),
        "results": count_results(results),
        "efficiency": np.sqrt(np.mean(errors**2, axis=0)).tolist() if answered.any() else None,
        "bias": np.mean(errors, axis=0).tolist() if answered.any() else None,
        "monte_carlo_error": float(1 / np.sqrt(2 * max(answered.sum(), 1))),
        "covered": inside[answered].mean(axis=0).tolist() if answered.any() else None,
        "rollouts": float(np.mean(found.rollouts)),
        "seconds": seconds,
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
        return row_of(ESTIMATORS[estimator](), kind, scale, channels, flights, seed)

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
            f"{100 * np.mean(row['covered']):.0f}" if row["covered"] else "",
            *(f"{row['rollouts']:.0f}", f"{1000 * row['seconds']:.3g}", in_words(row["results"])),
        )
        for row in report["rows"]
    )
    title = f"RMSE / Cramer-Rao bound of white noise, {channels}, {flights} flights"
    headings = "noise", "scale", "estimator", *PARAMETERS, "bias", "95 %", "rollouts", "ms", "results"
    print_table(title, headings, cells, width=170)
