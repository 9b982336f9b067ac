"""Shots of this package: the cost of one simulated flight, and its slope along one direction, many in one call."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from benchmarks.case import Case
from benchmarks.opponents.jaxos4_fit import problem_of


def shots(case: Case, *, channels: str = "all", slope: bool = False) -> Callable[[], dict]:
    """The cost of each flight at its start, and with `slope` also the derivative along one direction."""
    problem = problem_of(case, channels)

    @eqx.filter_jit
    @eqx.filter_vmap(in_axes=(None, 0, 0))
    def shoot(problem, measured, alpha):
        cost = eqx.tree_at(lambda p: p.flight.states, problem, measured).cost
        return jax.jvp(cost, (alpha,), (jnp.asarray(case.half_width),)) if slope else (cost(alpha),)

    arguments = problem, jnp.asarray(case.measured), jnp.asarray(case.starts)
    compiled = shoot.lower(*arguments).compile()

    def run() -> dict:
        found = jax.block_until_ready(compiled(*arguments))
        return {"costs": found[0]}

    return run
