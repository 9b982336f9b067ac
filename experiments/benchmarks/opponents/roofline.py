"""What the machine can do, and what one step of the simulation asks of it."""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmarks.case import Case
from experiments.benchmarks.opponents.jaxos4_fit import problem_of
from jaxos4.models.state import unstack

_LANES = 1024  # of the step that XLA counts
_REPEATS = 5


def roofline(case: Case, *, size: int = 1024, stream: int = 1 << 24) -> Callable[[], dict]:
    """Peak of a matrix product of this `size` and of a copy of `stream` numbers, and the operations of a step.

    XLA counts the operations and bytes of one step of `_LANES` shots: state and parameters are read, and the next state
    is written. Inside of a scan the state stays in registers and caches, so that the bytes are an upper limit.
    """
    problem = problem_of(case)
    rows = jax.tree.map(lambda leaf: leaf[0, 0], problem.rows())
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (_LANES,)), unstack(jnp.zeros(problem.size)))
    alphas = jnp.broadcast_to(case.starts[0], (_LANES, 8))

    @jax.jit
    @jax.vmap
    def advance(state, alpha):
        return problem.advance(rows.forcing, state, tuple(alpha))[0]

    counted = advance.lower(states, alphas).compile().cost_analysis() or {}
    matrix, numbers = jnp.ones((size, size)), jnp.ones(stream)
    product = _seconds(jax.jit(jnp.matmul), matrix, matrix)
    copy = _seconds(jax.jit(lambda x: x + 1.0), numbers)
    found = {
        "operations_per_step": counted.get("flops", np.nan) / _LANES,
        "bytes_per_step": counted.get("bytes accessed", np.nan) / _LANES,
        "peak_operations_per_second": 2 * size**3 / product,
        "peak_bytes_per_second": 2 * numbers.nbytes / copy,
    }
    return lambda: found


def _seconds(function: Callable, *arguments) -> float:
    """The shortest time of a run."""
    jax.block_until_ready(function(*arguments))
    times = []
    for _ in range(_REPEATS):
        begin = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - begin)
    return min(times)
