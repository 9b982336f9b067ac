"""How fast are shots, slopes, simulation and identification, and how do time and memory grow with their size?

Double precision, on the device that JAX finds. Each time is the median of runs after a warm-up.
"""

import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, machine, print_table, write_report
from jaxos4.simulation import METHODS


def timed(function: Callable, *arguments, repeats: int) -> tuple[float, float, float, float]:
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
    return compile_seconds, float(np.median(times)), min(times), max(times)


def standard_problem(channels: str, steps: int) -> jaxos4.ShootingProblem:
    """The standard flight with this number of steps of 10 ms, without noise."""
    model = jaxos4.PublishedOS4(jaxos4.OS4)
    omega = jaxos4.multisine(model.airframe, duration=steps * 0.01)
    flight = jaxos4.simulate(model, model.alpha, omega, dt=0.01)
    return jaxos4.ShootingProblem(
        model, flight, sigma=jaxos4.SENSOR_SIGMA, channels=channels, initial_state=flight.states[0]
    )


def shots(problem: jaxos4.ShootingProblem, trials: jax.Array) -> jax.Array:
    """The costs of many parameters."""
    return jax.vmap(problem.cost)(trials)


def slopes(problem: jaxos4.ShootingProblem, trials: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The costs of many parameters, and their derivatives along these parameters."""
    return jax.vmap(lambda x: jax.jvp(problem.cost, (x,), (x,)))(trials)


def identify(problem: jaxos4.ShootingProblem, bracket: jaxos4.Bracket, keys) -> jaxos4.RESULTS:
    """Identify one noisy copy of the problem's flight for each key."""

    def one(key):
        flight = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(problem.flight, key=key)
        return jaxos4.IBSS()(eqx.tree_at(lambda p: p.flight, problem, flight), bracket).parameters

    return jax.vmap(one)(keys)


def in_chunks(problem: jaxos4.ShootingProblem, count: int, chunk: int) -> float:
    """The time of identifying many flights in chunks [s]. The memory should not depend on their number."""
    step, begin = eqx.filter_jit(identify), time.perf_counter()
    for first in range(0, count, chunk):
        keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(2), i))(jnp.arange(first, first + chunk))
        jax.block_until_ready(step(problem, jaxos4.Bracket.default(problem.model), keys))
    return time.perf_counter() - begin


def main(
    batch: Annotated[int, typer.Option(help="Number of shots in one call.")] = 4096,
    steps: Annotated[int, typer.Option(help="Number of steps of a flight.")] = 500,
    flights: Annotated[list[int], typer.Option(help="Numbers of flights in one call.")] = (64, 256, 1024),
    repeats: Annotated[int, typer.Option(help="Number of runs for each time.")] = 7,
    channels: Annotated[list[str], typer.Option(help="Channels; growth is timed with the first.")] = ("all", "rates"),
    methods: Annotated[list[str], typer.Option(help="Integration methods of the simulation.")] = tuple(METHODS),
    out: Annotated[Path | None, typer.Option(help="JSON file for the results.")] = None,
) -> None:
    """Measure computing times."""
    rows: list[Row] = []

    def add(what: str, measured: tuple[float, float, float, float], work: float, unit: str) -> None:
        names = "compile_seconds", "median_seconds", "min_seconds", "max_seconds"
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        row = {"what": what, **dict(zip(names, measured, strict=True)), "rate": work / measured[1]}
        rows.append(row | {"unit": unit, "peak_memory_mib": peak})

    alpha = jaxos4.PublishedOS4(jaxos4.OS4).alpha
    trials = alpha * (1 + 0.1 * jax.random.normal(jax.random.key(0), (batch, 8)))
    for looked_at in channels:
        problem = standard_problem(looked_at, steps)
        add(f"shot, {looked_at}", timed(shots, problem, trials, repeats=repeats), batch * steps, "steps/s")
        add(f"slope, {looked_at}", timed(slopes, problem, trials, repeats=repeats), batch * steps, "steps/s")
    for length in (steps // 2, steps, 2 * steps, 4 * steps):
        problem = standard_problem(channels[0], length)
        measured = timed(shots, problem, trials[: batch // 4], repeats=repeats)
        add(f"shot, {length} steps, batch {batch // 4}", measured, batch // 4 * length, "steps/s")
    for method in methods:
        count = batch // 64 if method == "diffrax" else batch // 8
        problem = standard_problem("all", steps)

        def trajectories(p, a, method=method):
            return jax.vmap(lambda x: jaxos4.simulate(p.model, x, p.flight.omega, dt=0.01, method=method).states)(a)

        measured = timed(trajectories, problem, trials[:count], repeats=repeats)
        add(f"simulate, {method}, batch {count}", measured, count * steps, "steps/s")
    for looked_at in reversed(channels):
        problem = standard_problem(looked_at, steps)
        for count in flights:
            keys = jax.random.split(jax.random.key(1), count)
            measured = timed(identify, problem, jaxos4.Bracket.default(problem.model), keys, repeats=1)
            add(f"IBSS, {looked_at}, {count} flights", measured, count, "flights/s")

    problem, chunk = standard_problem("rates", steps), min(256, flights[-1])
    for count in (4 * chunk, 16 * chunk):
        seconds = in_chunks(problem, count, chunk)
        add(f"IBSS, rates, {count} flights by {chunk}", (0.0, seconds, seconds, seconds), count, "flights/s")
    cells = []
    for row in rows:
        seconds = (f"{row[name]:.4f}" for name in ("median_seconds", "min_seconds", "max_seconds"))
        rate = f"{row['rate'] / 1e6:.1f} M" if row["unit"] == "steps/s" else f"{row['rate']:.1f} "
        cells.append((row["what"], f"{row['compile_seconds']:.2f}", *seconds, rate + row["unit"]))
    provenance = machine()
    title = f"batch {batch}, {steps} steps, float64, {provenance['device']}, {provenance['cores']} cores"
    headings = "measurement", "compile [s]", "median [s]", "smallest [s]", "largest [s]", "rate"
    print_table(title, headings, cells, width=120)
    peaks = ", ".join(f"{row['what']}: {row['peak_memory_mib']:.0f} MiB" for row in rows[-2:])
    print(f"peak memory of the process after {peaks}")
    write_report(out, {"provenance": provenance, "rows": rows})
