"""How fast are shots, slopes and simulations of the standard flight? Identification: `benchmarks`.

Double precision, on the device that JAX finds. Each time is the median of runs after a warm-up.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import equinox as eqx
import jax
import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, machine, print_table, write_report
from experiments.shared import DT, standard_problem
from jaxos4.simulation import METHODS

STEPS = 500  # of the standard flight


def timed(function: Callable, *arguments, repeats: int) -> Row:
    """Compile time, and the median, smallest and largest time of a run [s]."""
    begin = time.perf_counter()
    compiled = eqx.filter_jit(function).lower(*arguments).compile()
    compile_seconds = time.perf_counter() - begin
    jax.block_until_ready(compiled(*arguments))
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        times.append(time.perf_counter() - begin)
    names = "compile_seconds", "median_seconds", "min_seconds", "max_seconds"
    return dict(zip(names, (compile_seconds, float(np.median(times)), min(times), max(times)), strict=True))


def shots(problem: jaxos4.ShootingProblem, trials: jax.Array) -> jax.Array:
    """The costs of many parameters."""
    return jax.vmap(problem.cost)(trials)


def slopes(problem: jaxos4.ShootingProblem, trials: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The costs of many parameters, and their derivatives along these parameters."""
    return jax.vmap(lambda x: jax.jvp(problem.cost, (x,), (x,)))(trials)


def main(
    batch: Annotated[int, typer.Option(help="Number of shots in one call.")] = 4096,
    repeats: Annotated[int, typer.Option(help="Number of runs for each time.")] = 7,
    out: Annotated[Path | None, typer.Option(help="JSON file for the results.")] = None,
) -> None:
    """Measure computing times."""
    rows: list[Row] = []
    model = jaxos4.PublishedOS4(jaxos4.OS4)
    trials = model.alpha * (1 + 0.1 * jax.random.normal(jax.random.key(0), (batch, 8)))

    def add(what: str, function: Callable, *arguments, count: int = batch) -> None:
        row = {"what": f"{what}, batch {count}", **timed(function, *arguments, repeats=repeats)}
        rows.append(row | {"steps_per_second": count * STEPS / row["median_seconds"]})

    for channels in ("all", "rates"):
        problem = standard_problem(model, channels)
        add(f"shot, {channels}", shots, problem, trials)
        add(f"slope, {channels}", slopes, problem, trials)
    for method in METHODS:
        count, omega = batch // (64 if method == "diffrax" else 8), jaxos4.multisine(model.airframe)

        def states(alphas: jax.Array, method=method, omega=omega) -> jax.Array:
            return jax.vmap(lambda x: jaxos4.simulate(model, x, omega, dt=DT, method=method).states)(alphas)

        add(f"simulate, {method}", states, trials[:count], count=count)
    seconds = "compile_seconds", "median_seconds", "min_seconds", "max_seconds"
    cells = ((row["what"], *(f"{row[s]:.4g}" for s in seconds), f"{row['steps_per_second'] / 1e6:.1f}") for row in rows)
    provenance = machine()
    title = f"{STEPS} steps, float64, {provenance['device']}, {provenance['cores']} cores"
    headings = "measurement", "compile [s]", "median [s]", "smallest [s]", "largest [s]", "M steps/s"
    print_table(title, headings, cells, width=120)
    write_report(out, {"provenance": provenance, "rows": rows})
