"""How fast are shots, slopes and simulations of the standard flight? Identification: `benchmarks`.

Double precision, on the device that JAX finds. Each time is the median of runs after a warm-up.
"""

import time
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np

import jaxos4
from experiments.monte_carlo import Column, Row, machine, print_rows, write_report
from experiments.shared import DT, Report, standard_problem
from jaxos4.simulation import METHODS

STEPS = 500  # of the standard flight
COLUMNS: dict[str, Column] = {
    "measurement": "what",
    "compile [s]": "compile_seconds",
    "median [s]": "median_seconds",
    "smallest [s]": "min_seconds",
    "largest [s]": "max_seconds",
    "M steps/s": lambda row: row["steps_per_second"] / 1e6,
}


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


def main(batch: int = 4096, repeats: int = 7, out: Report = None) -> None:
    """Measure computing times.

    - `batch`: Number of shots in one call.
    """
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
    provenance = machine()
    title = f"{STEPS} steps, float64, {provenance['device']}, {provenance['cores']} cores"
    print_rows(title, rows, COLUMNS)
    write_report(out, {"provenance": provenance, "rows": rows})
