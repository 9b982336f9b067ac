"""How often 95 % intervals hold the truth: IBSS, hybrid, output error; of alphas and of the rigid body's constants.

Noisy standard flights of one truth; each search begins anywhere within 80 % of the default bracket. The constants Ix,
Iy, Iz, J_R come from each flight's alphas and their covariance.
"""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
import typer
from rich.console import Console
from rich.table import Table

import jaxos4
from jaxos4.dynamics import MODELS

jax.config.update("jax_enable_x64", True)

ESTIMATORS = {"ibss": jaxos4.IBSS, "hybrid": jaxos4.Hybrid, "output-error": jaxos4.OutputError}
CONSTANTS = ("Ix", "Iy", "Iz", "J_R")
# Flights in one call: what fits in memory beside the residuals' derivatives.
CHUNK = 250


def cover(
    estimator: jaxos4.AbstractEstimator,
    problem: Callable[[jax.Array], jaxos4.ShootingProblem],
    exact: jaxos4.Flight,
    scale: float,
    flights: int,
    seed: int,
) -> dict:
    """One row of the table."""
    model, noise = problem(exact.states).model, jaxos4.WhiteNoise(scale * jaxos4.SENSOR_SIGMA)

    @eqx.filter_jit
    @eqx.filter_vmap
    def one(key: jax.Array) -> tuple[jaxos4.Estimate, jaxos4.InertiaFit]:
        noise_key, start_key = jax.random.split(key)
        center = model.alpha + jax.random.uniform(start_key, (8,), minval=-0.8, maxval=0.8) * model.half_width
        bracket = jaxos4.Bracket.around(center, model.half_width)
        found = estimator(problem(noise(exact, key=noise_key).states), bracket)
        return found, jaxos4.fit_inertia(model, found.parameters, found.covariance)

    keys, begin = jax.random.split(jax.random.key(seed), flights), time.perf_counter()
    parts = [jax.block_until_ready(one(keys[i : i + CHUNK])) for i in range(0, flights, CHUNK)]
    seconds = time.perf_counter() - begin
    found, rigid = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    names, counts = np.unique(jaxos4.result_names(found.result), return_counts=True)
    # A flight without an estimate has an infinite interval: it counts as not covered.
    errors, half_width = np.abs(found.parameters - model.alpha), np.asarray(found.half_width(0.95))
    bound = np.sqrt(np.diagonal(jaxos4.cramer_rao_bound(problem(exact.states), model.alpha)))
    truth = np.append(np.asarray(model.airframe.inertia), model.airframe.rotor_inertia)
    outside = np.abs(rigid.constants - truth) > scipy.stats.norm.ppf(0.975) * np.asarray(rigid.std)
    told = np.isfinite(half_width)
    return {
        "results": dict(zip(names.tolist(), counts.tolist(), strict=True)),
        "std": np.median(found.std / bound, axis=0).tolist(),
        "covered": (told & (errors < half_width)).mean(axis=0).tolist(),
        "constants_covered": (np.isfinite(rigid.std) & ~outside).mean(axis=0).tolist(),
        "inconsistent": float((rigid.p_value < 0.05).mean()),
        "seconds": seconds,
    }


def main(
    flights: Annotated[int, typer.Option(help="Flights for a row.")] = 2000,
    seed: Annotated[int, typer.Option(help="Of noise and starts.")] = 11,
    model: Annotated[str, typer.Option(help="published or corrected.")] = "published",
    channels: Annotated[str, typer.Option(help="rates, attitude or all.")] = "all",
    estimators: Annotated[list[str], typer.Option(help="Which ones.")] = tuple(ESTIMATORS),
    scales: Annotated[list[float], typer.Option(help="Multiples of the standard noise.")] = (0.1, 1.0, 10.0),
    steps: Annotated[int, typer.Option(help="Training of the hybrid's network.")] = jaxos4.NetworkEstimator.steps,
    out: Annotated[Path | None, typer.Option(help="JSON file for the figures.")] = None,
) -> None:
    """Coverage of 95 % intervals."""
    vehicle = MODELS[model](jaxos4.OS4)
    exact = jaxos4.simulate(vehicle, vehicle.alpha, jaxos4.multisine(vehicle.airframe), dt=0.01)
    rows, network = [], None
    error = np.sqrt(0.95 * 0.05 / flights)
    table = Table(title=f"95 % intervals that hold the truth [%], {flights} flights, {model}, {channels}")
    for heading in ("scale", "estimator", *(f"a{i}" for i in range(1, 9)), *CONSTANTS, "p < 5 %", "s", "results"):
        table.add_column(heading, no_wrap=heading != "results")
    for scale in scales:

        def problem(states: jax.Array, scale: float = scale) -> jaxos4.ShootingProblem:
            return jaxos4.ShootingProblem(
                vehicle,
                eqx.tree_at(lambda f: f.states, exact, states),
                sigma=scale * jaxos4.SENSOR_SIGMA,
                initial_state=exact.states[0],
                channels=channels,
            )

        for name in estimators:
            if name == "hybrid" and network is None:
                training = jaxos4.NetworkEstimator(channels=channels, steps=steps)
                standard = jaxos4.ShootingProblem(
                    vehicle, exact, sigma=jaxos4.SENSOR_SIGMA, initial_state=exact.states[0], channels=channels
                )
                network = training.fit(standard, jaxos4.Bracket.default(vehicle), key=jax.random.key(0))
            estimator = jaxos4.Hybrid(network) if name == "hybrid" else ESTIMATORS[name]()
            row = cover(estimator, problem, exact, scale, flights, seed)
            rows.append({"scale": scale, "estimator": name, **row})
            table.add_row(
                f"{scale:g}",
                name,
                *(f"{100 * x:.1f}" for x in row["covered"] + row["constants_covered"]),
                f"{100 * row['inconsistent']:.1f}",
                f"{row['seconds']:.0f}",
                ", ".join(f"{count} {what}" for what, count in row["results"].items()),
            )
            if out is not None:
                report = {"version": jaxos4.__version__, "seed": seed, "monte_carlo_error": error, "rows": rows}
                out.write_text(json.dumps(report | {"flights": flights, "model": model}, indent=2) + "\n")
    console = Console(width=170)
    console.print(table)
    console.print(f"Monte-Carlo error of each {100 * error:.2f} %.")


if __name__ == "__main__":
    typer.run(main)
