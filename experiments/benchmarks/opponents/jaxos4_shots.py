"""Shots of this package: the cost of one simulated flight, and its slope along one direction, many in one call."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.case import Case
from experiments.benchmarks.opponents.jaxos4_fit import problem_of
from jaxos4.shooting import cores

BLOCK = 32  # shots at a time


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
