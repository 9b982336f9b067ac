"""How often do 95 % intervals contain the truth, for the alphas and for the constants of the rigid body?

IBSS, the hybrid and output error identify noisy standard flights with one true vehicle. Each bracket's center is drawn
within 80 % of the default half-widths around the truth. The constants Ix, Iy, Iz, J_R are fitted to the alphas of each
flight and their covariance.
"""

import functools
import time
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, continued, count_results, fill, in_words, print_table
from experiments.shared import PARAMETERS, brackets_around, identify, measure, noise_and_bracket_keys
from jaxos4.models import MODELS
from jaxos4.results import NINETY_FIVE

ESTIMATORS = {"ibss": jaxos4.IBSS, "hybrid": jaxos4.Hybrid, "output-error": jaxos4.OutputError}
CONSTANTS = ("Ix", "Iy", "Iz", "J_R")
# Flights in one call, limited by the memory for the derivatives of the residuals.
CHUNK = 250


def cover(
    estimator: jaxos4.AbstractEstimator, problem: jaxos4.ShootingProblem, scale: float, flights: int, seed: int
) -> Row:
    """The coverage of one estimator at one noise scale: a row of the table. `problem` has the flight without noise."""
    model, exact, noise = problem.model, problem.flight, jaxos4.WhiteNoise(scale * jaxos4.SENSOR_SIGMA)
    noise_keys, start_keys = noise_and_bracket_keys(seed, flights)
    brackets, begin = brackets_around(model, start_keys), time.perf_counter()

    def part(first: int) -> jaxos4.Estimate:
        some = slice(first, first + CHUNK)
        states = measure(noise, exact, noise_keys[some])
        return jax.block_until_ready(identify(estimator, problem, jax.tree.map(lambda x: x[some], brackets), states))

    found = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *map(part, range(0, flights, CHUNK)))
    seconds = time.perf_counter() - begin
    rigid = jaxos4.fit_inertia(model, found.parameters, found.covariance)
    results = count_results(jaxos4.result_names(found.result))
    # A flight without an estimate has an infinite interval, and counts as not covered.
    errors, half_width = np.abs(found.parameters - model.alpha), np.asarray(found.half_width(0.95))
    bound = np.sqrt(np.diagonal(jaxos4.cramer_rao_bound(problem, model.alpha)))
    truth = np.append(np.asarray(model.airframe.inertia), model.airframe.rotor_inertia)
    outside = np.abs(rigid.constants - truth) > NINETY_FIVE * np.asarray(rigid.std)
    finite = np.isfinite(half_width)
    return {
        "results": results,
        "std": np.median(found.std / bound, axis=0).tolist(),
        "covered": (finite & (errors < half_width)).mean(axis=0).tolist(),
        "constants_covered": (np.isfinite(rigid.std) & ~outside).mean(axis=0).tolist(),
        "inconsistent": float((rigid.p_value < 0.05).mean()),
        "seconds": seconds,
    }


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
    vehicle = MODELS[model](jaxos4.OS4)
    exact = jaxos4.simulate(vehicle, vehicle.alpha, jaxos4.multisine(vehicle.airframe), dt=0.01)
    error = np.sqrt(0.95 * 0.05 / flights)

    def problem(scale: float) -> jaxos4.ShootingProblem:
        sigma = scale * jaxos4.SENSOR_SIGMA
        return jaxos4.ShootingProblem(vehicle, exact, sigma=sigma, initial_state=exact.states[0], channels=channels)

    @functools.cache
    def network() -> jaxos4.TrainedNetwork:
        training = jaxos4.NetworkEstimator(channels=channels, steps=steps)
        return training.fit(problem(1.0), jaxos4.Bracket.default(vehicle), key=jax.random.key(0))

    def row_of(scale: float, estimator: str) -> Row:
        found = jaxos4.Hybrid(network()) if estimator == "hybrid" else ESTIMATORS[estimator]()
        return cover(found, problem(scale), scale, flights, seed)

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
