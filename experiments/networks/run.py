"""Networks, hybrids from them and IBSS on new flights with random parameters: RMSE / bound, coverage, rollouts, time.

Each error is in units of the Cramer-Rao bound at that flight's own truth.
"""

import os
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxos4
from experiments.monte_carlo import Column, Row, check_names, count_results, print_rows, print_table, write_report
from experiments.shared import (
    CHUNK,
    DT,
    EFFICIENCY,
    ENDED,
    Count,
    Report,
    Seed,
    brackets_at,
    identify,
    standard_problem,
)
from jaxos4.study import metrics

LEVELS = (0.5, 0.9, 0.99)
MODEL = jaxos4.PublishedOS4(jaxos4.OS4)
BRACKET = jaxos4.Bracket.default(MODEL)
NETWORKS = {
    "score, mlp": {},
    "raw, mlp": {"features": "raw", "steps": 3000},
    "score, cmac": {"architecture": "cmac"},
    "score, cmac, 10000 steps": {"architecture": "cmac", "steps": 10_000},
}
COLUMNS: dict[str, Column] = {
    "estimator": "estimator",
    "noise": "noise",
    **EFFICIENCY,
    "50, 90, 99 %": lambda row: " ".join(f"{100 * x:.1f}" for x in row["covered"]),
    "hit": lambda row: None if row["hit_rate"] is None else 100 * row["hit_rate"],
    "1/s": "flights_per_second",
    **ENDED,
}


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, 0))
def fly(problem: jaxos4.ShootingProblem, key: jax.Array) -> tuple[jax.Array, ...]:
    """A noisy flight with parameters drawn over the bracket: parameters, states, bounds, and whether it succeeded."""
    alpha_key, noise_key = jax.random.split(key)
    u = jax.random.uniform(alpha_key, (8,), minval=-1, maxval=1)
    alpha = BRACKET.center + u * BRACKET.half_width
    truth = jaxos4.simulate(MODEL, alpha, problem.flight.omega, dt=DT)
    own = eqx.tree_at(lambda p: p.flight.states, problem, truth.states)
    bound = jnp.sqrt(jnp.diagonal(jaxos4.cramer_rao_bound(own, alpha)))
    flown = (truth.result == jaxos4.RESULTS.successful) & jnp.isfinite(bound).all()
    return alpha, jaxos4.WhiteNoise(problem.sigma)(truth, key=noise_key).states, bound, flown


def unseen(
    estimator: jaxos4.AbstractEstimator, channels: str, bound_channels: str, noise: float, flights: int, seed: int
) -> Row:
    """The row of `flights` flights that do not diverge, with parameters drawn over the bracket.

    Errors and coverage are those of the flights that converged.
    """
    at_once, chunk, parts, seconds = min(CHUNK, flights), 0, [], []
    problem, compared = (standard_problem(MODEL, some, scale=noise) for some in (channels, bound_channels))
    brackets = brackets_at(MODEL, 0.0, at_once)
    while sum(len(part["result"]) for part in parts) < flights and chunk < 20 + 20 * flights / at_once:
        keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), chunk), at_once)
        alpha, states, bound, flown = fly(compared, keys)
        begin, chunk = time.perf_counter(), chunk + 1
        found = jax.block_until_ready(identify(estimator, problem, brackets, states))
        seconds.append(time.perf_counter() - begin)
        error = found.parameters - alpha
        part = {"own": error / bound, "result": jaxos4.result_names(found.result), "rollouts": found.rollouts}
        part["covered"] = jnp.stack([jnp.abs(error) < found.half_width(level) for level in LEVELS], axis=1)
        if found.seed is not None:
            part["hit"] = ((alpha >= found.seed.lower) & (alpha <= found.seed.upper)).all(axis=1)
        parts.append({name: np.asarray(value)[np.asarray(flown)] for name, value in part.items()})
    data = {name: np.concatenate([part[name] for part in parts])[:flights] for name in parts[0]}
    converged = np.isin(data["result"], metrics.CONVERGED)
    return {
        "flights": len(converged),
        "answers": int(converged.sum()),
        "results": count_results(data["result"]),
        "efficiency": np.sqrt(np.mean(data["own"][converged] ** 2, axis=0)).tolist(),
        "monte_carlo_error": float(1 / np.sqrt(2 * max(converged.sum(), 1))),
        "covered": data["covered"][converged].mean(axis=(0, 2)).tolist(),
        "rollouts": float(data["rollouts"].mean()),
        "hit_rate": float(data["hit"].mean()) if "hit" in data else None,
        "flights_per_second": at_once / float(np.median(seconds)),
    }


def main(
    flights: Count = 2000,
    seed: Seed = 7,
    networks: list[str] = tuple(NETWORKS),
    noises: list[float] = (0.1, 1.0, 10.0),
    channels: str = "all",
    steps: int | None = None,
    separate: bool = True,
    out: Report = None,
) -> None:
    """Networks, hybrid and IBSS on flights drawn over the whole bracket. Networks are trained with seed 0.

    - `networks`: Names of the networks.
    - `channels`: Channels that are measured, and that the hybrid and IBSS look at.
    - `steps`: Training steps of all networks; each has its own number without it.
    - `separate`: Train one network for each noise scale too.
    """
    check_names("networks", networks, NETWORKS)
    report: Row = {"flights": flights, "seed": seed, "version": jaxos4.__version__, "load": os.getloadavg()}
    report |= {"rows": [], "training_seconds": {}}

    def add(label: str, estimator: jaxos4.AbstractEstimator, seen: str, bound: str, scales: list[float]) -> None:
        for noise in scales:
            row = unseen(estimator, seen, bound, noise, flights, seed)
            report["rows"].append({"estimator": label, "noise": noise, **row})
            write_report(out, report)

    def fit(label: str, settings: dict) -> jaxos4.TrainedNetwork:
        begin = time.perf_counter()
        estimator = jaxos4.NetworkEstimator(**settings | ({} if steps is None else {"steps": steps}))
        trained = estimator.fit(standard_problem(MODEL), BRACKET, key=jax.random.key(0))
        report["training_seconds"][label] = time.perf_counter() - begin
        return trained

    for label in networks:
        trained = fit(label, NETWORKS[label])
        add(label, trained, channels, "rates", noises)
        if "features" in NETWORKS[label]:
            continue
        if channels != trained.channels:
            trained = fit(f"{label} of {channels} channels, for the hybrid", NETWORKS[label] | {"channels": channels})
        add(f"hybrid from {label}", jaxos4.Hybrid(trained), channels, channels, noises)
        if label == networks[0]:
            add("ibss", jaxos4.IBSS(), channels, channels, noises)
    for noise in noises if separate else ():
        label = f"{networks[0]}, this noise only"
        trained = fit(f"{label} {noise:g}", NETWORKS[networks[0]] | {"noise": (noise, noise)})
        add(label, trained, channels, "rates", [noise])
    write_report(out, report)
    seconds = ((label, f"{spent:.0f}") for label, spent in report["training_seconds"].items())
    print_table("training", ("network", "time [s]"), seconds)
    title = f"RMSE / Cramer-Rao bound: of the rates for a network alone, of {channels} for the others"
    print_rows(title, report["rows"], COLUMNS)
