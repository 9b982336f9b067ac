"""How many windows does a long flight need if it drifts away from its model?

The true rotor speeds differ from the recorded ones by a constant factor for each rotor and flight. The model has no
term for this factor. The simulated body rates drift away from the measured ones, and the drift grows with the length of
a window.
"""

import functools
import itertools
import time
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, continued, count_results, fill, in_words, print_table
from experiments.shared import PARAMETERS, identify, many_times

SHOOTING = {"ibss": jaxos4.IBSS, "output-error": jaxos4.OutputError}
# The parameters that are compared: those that are identifiable and not 0.
COMPARED = (0, 2, 3, 5, 7)


def drifting(duration: float, drift: float, flights: int, seed: int) -> tuple[jaxos4.Flight, jax.Array]:
    """A recorded flight without drift, and the noisy states of flights that drift."""
    model = jaxos4.PublishedOS4(jaxos4.OS4)
    recorded = jaxos4.simulate(model, model.alpha, jaxos4.multisine(model.airframe, duration=duration), dt=0.01)
    noise = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)

    @jax.jit
    @jax.vmap
    def fly(key: jax.Array) -> jax.Array:
        factor_key, noise_key = jax.random.split(key)
        actual = recorded.omega * (1 + drift * jax.random.normal(factor_key, (4,)))
        return noise(jaxos4.simulate(model, model.alpha, actual, dt=0.01), key=noise_key).states

    return recorded, fly(jax.random.split(jax.random.key(seed), flights))


def fit(name: str, recorded: jaxos4.Flight, states: jax.Array, windows: int) -> Row:
    """The results of one estimator with one number of windows: a row of the table."""
    model, flights = jaxos4.PublishedOS4(jaxos4.OS4), states.shape[0]
    bracket = many_times(jaxos4.Bracket.around(model.alpha + 0.3 * model.half_width, model.half_width), flights)
    problem = jaxos4.ShootingProblem(model, recorded, sigma=jaxos4.SENSOR_SIGMA, channels="rates", windows=windows)
    for _ in range(2):  # the first call compiles
        begin = time.perf_counter()
        found = jax.block_until_ready(identify(SHOOTING[name](), problem, bracket, states))
    seconds = (time.perf_counter() - begin) / flights
    results = jaxos4.result_names(found.result)
    answered = results == "successful"
    errors = np.asarray(found.parameters / model.alpha - 1)[:, COMPARED]
    return {
        "results": count_results(results),
        "successful": int(answered.sum()),
        "percent": (100 * np.sqrt(np.mean(errors[answered] ** 2, axis=0))).tolist() if answered.any() else None,
        "rollouts": float(np.mean(found.rollouts)),
        "seconds": seconds,
    }


def main(
    duration: Annotated[float, typer.Option(help="Duration of each flight, in seconds.")] = 60.0,
    flights: Annotated[int, typer.Option(help="Number of flights for each row.")] = 8,
    seed: Annotated[int, typer.Option(help="Random seed for drifts and noise.")] = 3,
    drifts: Annotated[list[float], typer.Option(help="Standard deviations of the factors.")] = (0.0, 1e-4, 1e-3),
    windows: Annotated[list[int], typer.Option(help="Numbers of windows.")] = (1, 6, 30, 120),
    estimators: Annotated[list[str], typer.Option(help="Names of the estimators.")] = tuple(SHOOTING),
    out: Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")] = None,
) -> None:
    """Compare one window with many on long flights."""
    flown = functools.cache(lambda drift: drifting(duration, drift, flights, seed))

    def row_of(drift: float, windows: int, estimator: str) -> Row:
        return fit(estimator, *flown(drift), windows)

    report = continued(out, {"seed": seed, "duration": duration, "flights": flights}, "rows")
    trials = (
        {"drift": drift, "windows": count, "estimator": name}
        for drift, count, name in itertools.product(drifts, windows, estimators)
    )
    fill(out, report, report["rows"], trials, row_of)
    cells = (
        (
            *(f"{row['drift']:g}", str(row["windows"]), row["estimator"]),
            *((f"{x:.2g}" for x in row["percent"]) if row["percent"] else "-" * len(COMPARED)),
            *(f"{row['rollouts']:.0f}", f"{row['seconds']:.2g}", in_words(row["results"])),
        )
        for row in report["rows"]
    )
    headings = "drift", "windows", "estimator", *(PARAMETERS[i] for i in COMPARED), "rollouts", "s", "results"
    print_table(f"RMS error [%] on {flights} flights of {duration:g} s, rates", headings, cells)
