"""Shots of this package: the cost of one simulated flight, and its slope along one direction, many in one call."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from benchmarks.case import Case
from benchmarks.opponents.jaxos4_fit import for_all_flights, problem_of

from jaxos4.study.devices import use_all_cores

BLOCK = 32  # shots at a time: 16 to 64 take about the same, 4 and 8 longer


def shots(case: Case, *, channels: str = "all", slope: bool = False, all_cores: bool = False) -> Callable[[], dict]:
    """The cost of each flight at its start, and with `slope` also the derivative along one direction."""
    if all_cores:
        use_all_cores()
    problem = problem_of(case, channels)

    def shoot(measured, alpha):
        cost = eqx.tree_at(lambda p: p.flight.states, problem, measured).cost
        return jax.jvp(cost, (alpha,), (jnp.asarray(case.half_width),)) if slope else (cost(alpha),)

    def blockwise(function: Callable) -> Callable:
        return lambda *data: jax.lax.map(lambda one: function(*one), data, batch_size=BLOCK)

    arguments = jnp.asarray(case.measured), jnp.asarray(case.starts)
    compiled = jax.jit(for_all_flights(shoot, all_cores, blockwise)).lower(*arguments).compile()

    def run() -> dict:
        found = jax.block_until_ready(compiled(*arguments))
        return {"costs": found[0]}

    return run
