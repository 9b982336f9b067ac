"""Networks, hybrids from them and IBSS on new flights with random parameters: RMSE / bound, coverage, rollouts, time.

Each error is in units of the Cramer-Rao bound at that flight's own truth.
"""

import functools
import os
import resource
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typer

import jaxos4
from experiments.monte_carlo import Row, count_results, in_words, print_table, write_report
from experiments.shared import PARAMETERS, identify, measure
from jaxos4.study import metrics

CHUNK = 250
LEVELS = (0.5, 0.9, 0.99)
NOISES = (0.1, 1.0, 10.0)


# Frequencies [Hz] that the standard flight does not have; all axes move at once, as there.
OTHER_TONES = ((0.4, 0.9, 2.9), (0.5, 1.5, 2.1), (0.3, 1.1, 2.7))


class Case(NamedTuple):
    """A model, an excitation, and the width of the bracket in multiples of the default."""

    model: type[jaxos4.AbstractModel] = jaxos4.PublishedOS4
    excite: Callable[[jaxos4.Airframe], jax.Array] = jaxos4.multisine
    wide: float = 1.0

    @property
    def bracket(self) -> jaxos4.Bracket:
        """The bracket around the OS4."""
        model = self.model(jaxos4.OS4)
        return jaxos4.Bracket.around(model.alpha, self.wide * model.half_width)

    @property
    def flight(self) -> jaxos4.Flight:
        """The exact flight at the bracket's center."""
        model = self.model(jaxos4.OS4)
        return jaxos4.simulate(model, model.alpha, self.excite(model.airframe), dt=0.01)

    def problem(self, flight: jaxos4.Flight, noise: float | jax.Array, channels: str = "all") -> jaxos4.ShootingProblem:
        """The problem of a flight; all flights start at rest, and the start is known."""
        sigma = noise * jaxos4.SENSOR_SIGMA
        model = self.model(jaxos4.OS4)
        return jaxos4.ShootingProblem(model, flight, sigma=sigma, initial_state=jnp.zeros(12), channels=channels)


CASES = {
    "standard": Case(),
    "twice as wide": Case(wide=2.0),
    "corrected": Case(model=jaxos4.CorrectedOS4),
    "other tones": Case(excite=functools.partial(jaxos4.multisine, tones=OTHER_TONES)),
    "doublet": Case(excite=jaxos4.doublet),
}
NETWORKS = {
    "score, mlp": {},
    "raw, mlp": {"features": "raw", "steps": 3000},
    "score, cmac": {"architecture": "cmac"},
    "score, cmac, 10000 steps": {"architecture": "cmac", "steps": 10_000},
}


def many_times(bracket: jaxos4.Bracket, flights: int) -> jaxos4.Bracket:
    """The same bracket for each flight."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (flights, *x.shape)), bracket)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, None, None, None, None, 0))
def fly(case: Case, channels: str, bracket: jaxos4.Bracket, omega: jax.Array, noise: jax.Array, key: jax.Array):
    """A noisy flight with parameters drawn over the bracket: parameters, states, bounds, and whether it succeeded."""
    alpha_key, noise_key = jax.random.split(key)
    u = jax.random.uniform(alpha_key, (8,), minval=-1, maxval=1)
    alpha = bracket.center + u * bracket.half_width
    truth = jaxos4.simulate(case.model(jaxos4.OS4), alpha, omega, dt=0.01)
    flight = jaxos4.WhiteNoise(noise * jaxos4.SENSOR_SIGMA)(truth, key=noise_key)
    bound = jnp.sqrt(jnp.diagonal(jaxos4.cramer_rao_bound(case.problem(truth, noise, channels), alpha)))
    flown = (truth.result == jaxos4.RESULTS.successful) & jnp.isfinite(bound).all()
    return alpha, flight.states, bound, flown


def unseen(
    case: Case,
    estimator: jaxos4.AbstractEstimator,
    channels: str,
    bound_channels: str,
    noises: list[float],
    flights: int,
    seed: int,
) -> Iterator[tuple[float, dict]]:
    """For each noise, identifies `flights` flights that do not diverge, with parameters drawn over the bracket."""
    bracket, exact, at_once = case.bracket, case.flight, min(CHUNK, flights)
    for noise in noises:
        problem, rows, seconds, chunk = case.problem(exact, noise, channels), [], [], 0
        while sum(len(r["alpha"]) for r in rows) < flights and chunk < 20 + 20 * flights / at_once:
            keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), chunk), at_once)
            alpha, states, bound, flown = fly(case, bound_channels, bracket, exact.omega, jnp.asarray(noise), keys)
            begin, chunk = time.perf_counter(), chunk + 1
            found = jax.block_until_ready(identify(estimator, problem, many_times(bracket, at_once), states))
            seconds.append(time.perf_counter() - begin)
            error = found.parameters - alpha
            row = {
                "alpha": alpha,
                "error": error,
                "bound": bound,
                "result": jaxos4.result_names(found.result),
                "rollouts": found.rollouts,
                "covered": jnp.stack([jnp.abs(error) < found.half_width(level) for level in LEVELS], axis=1),
            }
            if found.seed is not None:
                row["hit"] = ((alpha >= found.seed.lower) & (alpha <= found.seed.upper)).all(axis=1)
            rows.append({name: np.asarray(value)[np.asarray(flown)] for name, value in row.items()})
        data = {name: np.concatenate([r[name] for r in rows])[:flights] for name in rows[0]}
        yield noise, summary(data) | {"flights_per_second": at_once / float(np.median(seconds))}


def summary(data: dict[str, np.ndarray]) -> dict:
    """A row of the table: errors of the converged flights, and the number of flights with each result."""
    converged = np.isin(data["result"], metrics.CONVERGED)
    error, bound = data["error"][converged], data["bound"][converged]
    return {
        "flights": len(converged),
        "answers": int(converged.sum()),
        "results": count_results(data["result"]),
        "efficiency": np.sqrt(np.mean((error / bound) ** 2, axis=0)).tolist(),
        "rms_ratio": np.sqrt(np.mean(error**2, axis=0) / np.mean(bound**2, axis=0)).tolist(),
        "monte_carlo_error": float(1 / np.sqrt(2 * max(converged.sum(), 1))),
        "covered": data["covered"][converged].mean(axis=(0, 2)).tolist(),
        "rollouts": float(data["rollouts"].mean()),
        "hit_rate": float(data["hit"].mean()) if "hit" in data else None,
    }


def amortised(case: Case, network: jaxos4.TrainedNetwork, channels: str, flights: int) -> dict:
    """Identifies many noisy flights in one call: time, and the growth of the process's memory."""
    keys = jax.random.split(jax.random.key(3), flights)
    noisy = measure(jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA), case.flight, keys)
    arguments = network, case.problem(case.flight, 1.0, channels), many_times(case.bracket, flights), noisy

    def peak() -> float:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    begin = time.perf_counter()
    compiled = identify.lower(*arguments).compile()
    built, before = time.perf_counter(), peak()
    jax.block_until_ready(compiled(*arguments))
    seconds = time.perf_counter() - built
    return {
        "flights": flights,
        "compile_seconds": built - begin,
        "seconds": seconds,
        "data_mib": noisy.nbytes / 2**20,
        "peak_mib": peak(),
        "added_mib": peak() - before,
    }


def cells(row: Row) -> tuple[str, ...]:
    """A row of the table."""
    return (
        *(row["case"], row["estimator"], f"{row['noise']:g}", *(f"{x:.2f}" for x in row["efficiency"])),
        " ".join(f"{100 * x:.1f}" for x in row["covered"]),
        "" if row["hit_rate"] is None else f"{100 * row['hit_rate']:.1f}",
        *(f"{row['rollouts']:.0f}", f"{row['flights_per_second'] or 0:.0f}", in_words(row["results"])),
    )


def main(
    flights: Annotated[int, typer.Option(help="New flights for each row.")] = 2000,
    seed: Annotated[int, typer.Option(help="Random seed for the new flights; networks are trained with seed 0.")] = 7,
    cases: Annotated[list[str], typer.Option(help="Cases to run.")] = tuple(CASES),
    networks: Annotated[list[str], typer.Option(help="Networks of the standard case.")] = tuple(NETWORKS),
    noises: Annotated[list[float], typer.Option(help="Noise scales.")] = NOISES,
    channels: Annotated[
        str, typer.Option(help="Channels that are measured, and that the hybrid and IBSS look at.")
    ] = "all",
    steps: Annotated[
        int | None, typer.Option(help="Training steps of all networks; each has its own number without it.")
    ] = None,
    many: Annotated[int, typer.Option(help="Flights identified in one call.")] = 10_000,
    separate: Annotated[bool, typer.Option(help="Train one network for each noise scale too.")] = True,
    out: Annotated[Path | None, typer.Option(help="JSON file for the figures.")] = None,
) -> None:
    """Networks, hybrid and IBSS on flights drawn over the whole bracket."""
    report: Row = {"flights": flights, "seed": seed, "version": jaxos4.__version__, "load": os.getloadavg()}
    report |= {"rows": [], "training_seconds": {}}

    def add(name: str, label: str, rows: Iterable[tuple[float, Row]]) -> None:
        for noise, row in rows:
            report["rows"].append({"case": name, "estimator": label, "noise": noise, **row})
            write_report(out, report)

    def fit(case: Case, settings: dict) -> tuple[jaxos4.TrainedNetwork, float]:
        begin = time.perf_counter()
        estimator = jaxos4.NetworkEstimator(**settings | ({} if steps is None else {"steps": steps}))
        trained = estimator.fit(case.problem(case.flight, 1.0), case.bracket, key=jax.random.key(0))
        return trained, time.perf_counter() - begin

    for name in cases:
        case = CASES[name]
        for label in networks if name == "standard" else networks[:1]:
            trained, seconds = fit(case, NETWORKS[label])
            print(f"{name}: {label} trained in {seconds:.0f} s")
            report["training_seconds"][f"{name}: {label}"] = seconds
            add(name, label, unseen(case, trained, channels, "rates", noises, flights, seed))
            if "features" in NETWORKS[label]:
                continue
            if name == "standard" and label == networks[0]:
                report["one_call"] = amortised(case, trained, channels, many)
                print(f"one call: {report['one_call']}")
            seeds = trained
            if channels != trained.channels:
                seeds, seconds = fit(case, {**NETWORKS[label], "channels": channels})
                report["training_seconds"][f"{name}: {label} of {channels} channels, for the hybrid"] = seconds
            searches = {f"hybrid from {label}": jaxos4.Hybrid(seeds)}
            searches |= {"ibss": jaxos4.IBSS()} if label == networks[0] else {}
            for other, estimator in searches.items():
                add(name, other, unseen(case, estimator, channels, channels, noises, flights, seed))
        for noise in noises if name == "standard" and separate else ():
            trained, seconds = fit(case, {**NETWORKS[networks[0]], "noise": (noise, noise)})
            label = f"{networks[0]}, this noise only"
            report["training_seconds"][f"{name}: {label} {noise:g}"] = seconds
            add(name, label, unseen(case, trained, channels, "rates", [noise], flights, seed))
    write_report(out, report)
    headings = "case", "estimator", "noise", *PARAMETERS, "50, 90, 99 %", "hit", "rollouts", "1/s", "results"
    title = f"RMSE / Cramer-Rao bound: of the rates for a network alone, of {channels} for the others"
    print_table(title, headings, map(cells, report["rows"]), width=170)
