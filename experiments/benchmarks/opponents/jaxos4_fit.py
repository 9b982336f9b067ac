"""The estimators of this package, on all channels. Each search begins at the centre of the flight's bracket."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxos4
from experiments.benchmarks.case import Case
from jaxos4.estimators import make_estimator

jax.config.update("jax_enable_x64", True)

TRAINING = {"steps": 2000, "held_out": 5000}  # of the hybrid's network


def problem_of(case: Case, channels: str = "all") -> jaxos4.ShootingProblem:
    """The first flight of a case as a problem."""
    flight = jaxos4.Flight(case.dt * np.arange(len(case.omega)), case.omega, case.measured[0])
    start = np.zeros(12) if case.known else None
    model = jaxos4.PublishedOS4(jaxos4.OS4)
    return jaxos4.ShootingProblem(model, flight, sigma=case.sigma, initial_state=start, channels=channels)


def fit(
    case: Case,
    *,
    estimator: str,
    lanes: int = 1000,
    channels: str = "all",
    parameters: int = 8,
    all_cores: bool = False,
) -> Callable[[], dict]:
    """Calls of at most `lanes` flights. The first `parameters` are estimated, and the others are known.

    `all_cores`: each core takes its part of a call.
    """
    problem, lanes = problem_of(case, channels), min(lanes, case.flights)
    held = dict(zip(problem.unknowns.names[parameters:], case.truth[parameters:], strict=True))
    if held:
        problem = problem.hold(held)
    searching = _estimator(estimator, problem, case)

    def identify(flight):
        measured, center = flight
        data = eqx.tree_at(lambda p: p.flight.states, problem, measured)
        found = searching(data, jaxos4.Bracket.around(center, case.half_width))
        return found.parameters, found.initial_state

    measured, starts = jnp.asarray(case.measured), jnp.asarray(case.starts)
    groups = [slice(first, first + lanes) for first in range(0, case.flights, lanes)]
    if all_cores:
        compiled = jaxos4.on_all_cores(identify)
    else:
        compiled = jax.jit(jax.vmap(identify)).lower((measured[:lanes], starts[:lanes])).compile()

    def run() -> dict:
        found = [jax.block_until_ready(compiled((measured[g], starts[g]))) for g in groups]
        first = np.zeros((case.flights, 12))
        first[:, problem.columns] = np.concatenate([x for _, x in found])
        return {"parameters": np.concatenate([p for p, _ in found]), "first": first}

    return run


def _estimator(name: str, problem: jaxos4.ShootingProblem, case: Case) -> jaxos4.AbstractEstimator:
    if name != "hybrid":
        return make_estimator(name)
    # Twice as wide: it contains the brackets of all flights.
    wide = jaxos4.Bracket.around(case.truth, 2 * case.half_width)
    network = jaxos4.NetworkEstimator(**TRAINING).fit(problem, wide, key=jax.random.key(0))
    return make_estimator(name, network)
