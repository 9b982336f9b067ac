"""How close does IBSS come to the Cramer-Rao bound?

Many noisy standard flights are identified in one call. They are simulated with the model that is fitted (the inverse
crime), so that the bound applies.
"""

import json
import time
from pathlib import Path
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typer
from rich.console import Console

import jaxos4
from jaxos4.report.experiment import PARAMETERS, count_results, in_words, table_of
from jaxos4.results import NINETY_FIVE

jax.config.update("jax_enable_x64", True)

CASES = {
    "published, all": (jaxos4.PublishedOS4, "all", True),
    "published, rates": (jaxos4.PublishedOS4, "rates", True),
    "published, all, free start": (jaxos4.PublishedOS4, "all", False),
    "corrected, all": (jaxos4.CorrectedOS4, "all", True),
    "corrected, rates": (jaxos4.CorrectedOS4, "rates", True),
}


def study(model: jaxos4.AbstractModel, channels: str, flights: int, seed: int, *, scale: float, known: bool) -> dict:
    """Identify noisy standard flights, each from a random start within 80 % of the default bracket."""
    flight = jaxos4.simulate(model, model.alpha, jaxos4.multisine(model.airframe), dt=0.01)
    bracket = jaxos4.Bracket.default(model)
    sigma = scale * jaxos4.SENSOR_SIGMA
    noise = jaxos4.WhiteNoise(sigma)

    def problem(data: jaxos4.Flight) -> jaxos4.ShootingProblem:
        start = flight.states[0] if known else None
        return jaxos4.ShootingProblem(model, data, sigma=sigma, channels=channels, initial_state=start)

    @eqx.filter_jit
    @eqx.filter_vmap(in_axes=(None, 0))
    def identify(key, trial) -> jaxos4.Estimate:
        noise_key, start_key = jax.random.split(jax.random.fold_in(key, trial))
        start = bracket.center + 0.8 * bracket.half_width * jax.random.uniform(start_key, (8,), minval=-1, maxval=1)
        return jaxos4.IBSS()(problem(noise(flight, key=noise_key)), bracket, start=start)

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
    out: Annotated[Path | None, typer.Option(help="JSON file for the results.")] = None,
) -> None:
    """Measure RMSE / Cramer-Rao bound of IBSS for each parameter."""
    report = {"flights": flights, "seed": seed, "scale": scale, "version": jaxos4.__version__, "cases": {}}
    title = f"RMSE / bound, {flights} flights, noise {scale:g}, Monte-Carlo error {1 / np.sqrt(2 * flights):.3f}"
    table = table_of(title, ("case", *PARAMETERS, "covered", "results", "rollouts", "s"))
    for case in cases:
        model, channels, known = CASES[case]
        row = study(model(jaxos4.OS4), channels, flights, seed, scale=scale, known=known)
        report["cases"][case] = row
        figures = [f"{x:.2f}" for x in row["efficiency"]]
        table.add_row(
            case,
            *figures,
            f"{row['covered']:.3f}",
            in_words(row["results"]),
            f"{row['rollouts']:.0f}",
            f"{row['seconds']:.1f}",
        )
    Console(width=150).print(table)
    if out is not None:
        out.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    typer.run(main)
