"""How close do the shooting methods come to the Cramer-Rao bound?

Many noisy standard flights are identified in one call, by IBSS if the case names no other estimator. They are simulated
with the model that is fitted (the inverse crime), so that the bound applies.
"""

import time
from pathlib import Path
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, continued, count_results, in_words, print_table, write_report
from experiments.shared import PARAMETERS
from jaxos4.results import NINETY_FIVE


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


def study(case: Case, flights: int, seed: int, *, scale: float) -> Row:
    """Identify noisy standard flights, each from a random start within 80 % of the default bracket."""
    model = case.model(jaxos4.OS4)
    flight = jaxos4.simulate(model, model.alpha, jaxos4.multisine(model.airframe), dt=0.01)
    bracket = jaxos4.Bracket.default(model)
    sigma = scale * jaxos4.SENSOR_SIGMA
    noise = jaxos4.WhiteNoise(sigma)

    def problem(data: jaxos4.Flight) -> jaxos4.ShootingProblem:
        settings = {"channels": case.channels, "windows": case.windows}
        start = flight.states[0] if case.known else None
        return jaxos4.ShootingProblem(model, data, sigma=sigma, initial_state=start, **settings)

    @eqx.filter_jit
    @eqx.filter_vmap(in_axes=(None, 0))
    def identify(key, trial) -> jaxos4.Estimate:
        noise_key, start_key = jax.random.split(jax.random.fold_in(key, trial))
        start = bracket.center + 0.8 * bracket.half_width * jax.random.uniform(start_key, (8,), minval=-1, maxval=1)
        noisy = problem(noise(flight, key=noise_key))
        if case.estimator is jaxos4.IBSS:
            return jaxos4.IBSS()(noisy, bracket, start=start)
        return case.estimator()(noisy, jaxos4.Bracket.around(start, bracket.half_width))

    arguments = jax.random.key(seed), jnp.arange(flights)
    begin = time.perf_counter()
    compiled = identify.lower(*arguments).compile()
    built = time.perf_counter()
    estimates = jax.block_until_ready(compiled(*arguments))
    done = time.perf_counter()

    bound = np.sqrt(np.diagonal(jaxos4.cramer_rao_bound(problem(flight), model.alpha)))
    error = np.asarray(estimates.parameters - model.alpha) / bound
    return {
        "efficiency": np.sqrt(np.mean(error**2, axis=0)).tolist(),
        "bias": error.mean(axis=0).tolist(),
        "monte_carlo_error": 1 / np.sqrt(2 * flights),
        "covered": float(np.mean(np.abs(error * bound) < NINETY_FIVE * np.asarray(estimates.std))),
        "results": count_results(jaxos4.result_names(estimates.result)),
        "rollouts": float(np.mean(estimates.rollouts)),
        "compile_seconds": built - begin,
        "seconds": done - built,
    }


def main(
    flights: Annotated[int, typer.Option(help="Number of flights for each case.")] = 512,
    seed: Annotated[int, typer.Option(help="Random seed for noise and starts.")] = 0,
    scale: Annotated[float, typer.Option(help="Noise scale, in multiples of the standard sensor noise.")] = 1.0,
    cases: Annotated[list[str], typer.Option(help="Names of the cases.")] = tuple(CASES),
    out: Annotated[Path | None, typer.Option(help="JSON file for the results; continued if it exists.")] = None,
) -> None:
    """Measure RMSE / Cramer-Rao bound for each parameter."""
    report = continued(out, {"flights": flights, "seed": seed, "scale": scale}, "cases")
    report["cases"] = dict(report["cases"])
    for case in cases:
        if case not in report["cases"]:
            report["cases"][case] = study(CASES[case], flights, seed, scale=scale)
            write_report(out, report)
    cells = (
        (
            *(case, *(f"{x:.2f}" for x in row["efficiency"]), f"{row['covered']:.3f}"),
            *(in_words(row["results"]), f"{row['rollouts']:.0f}", f"{row['seconds']:.1f}"),
        )
        for case, row in report["cases"].items()
    )
    title = f"RMSE / bound, {flights} flights, noise {scale:g}, Monte-Carlo error {1 / np.sqrt(2 * flights):.3f}"
    print_table(title, ("case", *PARAMETERS, "covered", "results", "rollouts", "s"), cells)
