"""The network of this package: trained for the rates, and then asked for all flights in one call."""

import time
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

import jaxos4
from experiments.benchmarks.case import Case
from experiments.benchmarks.opponents.jaxos4_fit import problem_of


def network(case: Case, *, steps: int, held_out: int = 5000) -> Callable[[], dict]:
    """The answers, with the time of the training [s]."""
    problem = problem_of(case, "rates")
    # Twice as wide: it contains the brackets of all flights.
    wide = jaxos4.Bracket.around(case.truth, 2 * case.half_width)
    begin = time.perf_counter()
    trained = jaxos4.NetworkEstimator(steps=steps, held_out=held_out).fit(problem, wide, key=jax.random.key(0))
    jax.block_until_ready(eqx.filter(trained, eqx.is_array))
    training = time.perf_counter() - begin

    @eqx.filter_jit
    @eqx.filter_vmap(in_axes=(None, None, 0))
    def identify(trained, problem, measured):
        return trained(eqx.tree_at(lambda p: p.flight.states, problem, measured), wide).parameters

    measured = jnp.asarray(case.measured)
    compiled = identify.lower(trained, problem, measured).compile()
    return lambda: {
        "parameters": jax.block_until_ready(compiled(trained, problem, measured)),
        "training_seconds": training,
    }
