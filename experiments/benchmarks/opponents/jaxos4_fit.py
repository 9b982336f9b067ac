"""The estimators of this package, on all channels. Each search begins at the centre of the flight's bracket."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from benchmarks.case import Case

import jaxos4
from jaxos4.estimators import make_estimator
from jaxos4.study import use_all_cores

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
    if all_cores:
        use_all_cores()
    problem, lanes = problem_of(case, channels), min(lanes, case.flights)
    held = dict(zip(problem.unknowns.names[parameters:], case.truth[parameters:], strict=True))
    if held:
        problem = problem.hold(held)
    searching = _estimator(estimator, problem, case)

    def identify(measured, center):
        data = eqx.tree_at(lambda p: p.flight.states, problem, measured)
        found = searching(data, jaxos4.Bracket.around(center, case.half_width))
        return found.parameters, found.initial_state

    measured, starts = jnp.asarray(case.measured), jnp.asarray(case.starts)
    groups = [slice(first, first + lanes) for first in range(0, case.flights, lanes)]
    compiled = jax.jit(for_all_flights(identify, all_cores)).lower(measured[:lanes], starts[:lanes]).compile()

    def run() -> dict:
        found = [jax.block_until_ready(compiled(measured[g], starts[g])) for g in groups]
        first = np.zeros((case.flights, 12))
        first[:, problem.columns] = np.concatenate([x for _, x in found])
        return {"parameters": np.concatenate([p for p, _ in found]), "first": first}

    return run


def for_all_flights(function: Callable, all_cores: bool, batch: Callable = jax.vmap) -> Callable:
    """`batch(function)`; with `all_cores`, each core computes the batch of its own flights."""
    if not all_cores:
        return batch(function)
    cores, share = jax.device_count(), jax.sharding.PartitionSpec("flights")
    mesh = jax.make_mesh((cores,), ("flights",), axis_types=(jax.sharding.AxisType.Auto,))
    divided = jax.shard_map(batch(function), mesh=mesh, in_specs=share, out_specs=share, check_vma=False)

    def whole(*data):
        count = jax.tree.leaves(data)[0].shape[0]
        # The last flight is repeated, so that all cores have the same number.
        even = jax.tree.map(lambda x: jnp.concatenate([x, jnp.repeat(x[-1:], -count % cores, axis=0)]), data)
        return jax.tree.map(lambda x: x[:count], divided(*even))

    return whole


def _estimator(name: str, problem: jaxos4.ShootingProblem, case: Case) -> jaxos4.AbstractEstimator:
    if name != "hybrid":
        return make_estimator(name)
    # Twice as wide: it contains the brackets of all flights.
    wide = jaxos4.Bracket.around(case.truth, 2 * case.half_width)
    network = jaxos4.NetworkEstimator(**TRAINING).fit(problem, wide, key=jax.random.key(0))
    return make_estimator(name, network)
