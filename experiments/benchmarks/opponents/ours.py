"""The methods of this package: estimators on all channels, the network on the rates, and shots; and the roofline.

Each search begins at the centre of the flight's bracket.
"""

import time
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxos4
from experiments.benchmarks.case import Case
from jaxos4.batching import cores
from jaxos4.estimators import make_estimator
from jaxos4.models.state import unstack

jax.config.update("jax_enable_x64", True)

HYBRID_STEPS, HELD_OUT = 2000, 5000  # steps of training for the hybrid; held-out flights of all networks
BLOCK = 16  # shots at a time, as many as the package computes together
LANES = 1024  # of the step whose operations XLA counts


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
    trained = _trained(case, problem, HYBRID_STEPS)[0] if estimator == "hybrid" else None
    searching = make_estimator(estimator, trained)

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


def _trained(case: Case, problem: jaxos4.ShootingProblem, steps: int) -> tuple[jaxos4.TrainedNetwork, jaxos4.Bracket]:
    """A network, and its bracket: twice as wide as those of the flights, all of which it contains."""
    wide = jaxos4.Bracket.around(case.truth, 2 * case.half_width)
    training = jaxos4.NetworkEstimator(steps=steps, held_out=HELD_OUT)
    return training.fit(problem, wide, key=jax.random.key(0)), wide


def network(case: Case, *, steps: int) -> Callable[[], dict]:
    """The answers of all flights in one call, with the time of the training [s]."""
    problem = problem_of(case, "rates")
    begin = time.perf_counter()
    trained, wide = _trained(case, problem, steps)
    jax.block_until_ready(eqx.filter(trained, eqx.is_array))
    seconds = time.perf_counter() - begin

    @eqx.filter_jit
    @eqx.filter_vmap(in_axes=(None, None, 0))
    def identify(trained, problem, measured):
        return trained(eqx.tree_at(lambda p: p.flight.states, problem, measured), wide).parameters

    measured = jnp.asarray(case.measured)
    compiled = identify.lower(trained, problem, measured).compile()
    return lambda: {
        "parameters": jax.block_until_ready(compiled(trained, problem, measured)),
        "training_seconds": seconds,
    }


def shots(
    case: Case, *, channels: str = "all", slope: bool = False, same_flight: bool = False, all_cores: bool = False
) -> Callable[[], dict]:
    """The cost of each flight at its start, and with `slope` also the derivative along one direction.

    The measurements are put in the order in which they are read before the time counts. `same_flight`: all shots are
    compared with the first flight, as those of a search are.
    """
    if all_cores:
        jax.config.update("jax_num_cpu_devices", cores())
    problem = problem_of(case, channels)
    rows = jax.tree.map(lambda leaf: leaf[0], problem.rows())  # of its only window
    first = problem.first_state()[0]
    # The last flight is repeated, so that all blocks have the same number.
    places = np.minimum(np.arange(-case.flights % BLOCK + case.flights), case.flights - 1).reshape(-1, BLOCK)
    blocks = np.moveaxis(case.measured[places][..., problem.columns], 1, -1)  # blocks, samples, columns, lanes
    blocks[:, : case.begin] = np.nan
    measured = None if same_flight else tuple(jnp.asarray(blocks[:, :, i]) for i in range(len(problem.columns)))

    def shoot(measured, alpha):
        def cost(alpha):
            data = rows if measured is None else rows._replace(measured=measured)
            return problem.shot(data, alpha, first)[0]

        return jax.jvp(cost, (alpha,), (jnp.asarray(case.half_width),)) if slope else (cost(alpha),)

    def each_block(function: Callable) -> Callable:
        return lambda *data: jax.lax.map(lambda block: function(*block), data)

    arguments = measured, jnp.asarray(case.starts[places])
    together = jax.vmap(shoot, in_axes=(-1, 0))
    compiled = jax.jit(for_all_flights(together, all_cores, each_block)).lower(*arguments).compile()

    def run() -> dict:
        found = jax.block_until_ready(compiled(*arguments))
        return {"costs": found[0].ravel()[: case.flights]}

    return run


def for_all_flights(function: Callable, all_cores: bool, batch: Callable) -> Callable:
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


def roofline(case: Case, *, size: int = 1024, stream: int = 1 << 24) -> Callable[[], dict]:
    """Peak of a matrix product of this `size` and of a copy of `stream` numbers, and the operations of a step.

    XLA counts the operations and bytes of one step of `LANES` shots: state and parameters are read, and the next state
    is written. Inside of a scan the state stays in registers and caches, so that the bytes are an upper limit.
    """
    # Imported here: it loads all that prints tables, which the memory of no other contender should hold.
    from experiments.speed.run import timed

    problem = problem_of(case)
    rows = jax.tree.map(lambda leaf: leaf[0, 0], problem.rows())
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (LANES,)), unstack(jnp.zeros(problem.size)))
    alphas = jnp.broadcast_to(case.starts[0], (LANES, 8))

    @jax.jit
    @jax.vmap
    def advance(state, alpha):
        return problem.advance(rows.forcing, state, tuple(alpha))[0]

    counted = advance.lower(states, alphas).compile().cost_analysis() or {}
    matrix, numbers = jnp.ones((size, size)), jnp.ones(stream)
    product = timed(jnp.matmul, matrix, matrix, repeats=5)["min_seconds"]
    copy = timed(lambda x: x + 1.0, numbers, repeats=5)["min_seconds"]
    found = {
        "operations_per_step": counted.get("flops", np.nan) / LANES,
        "bytes_per_step": counted.get("bytes accessed", np.nan) / LANES,
        "peak_operations_per_second": 2 * size**3 / product,
        "peak_bytes_per_second": 2 * numbers.nbytes / copy,
    }
    return lambda: found
