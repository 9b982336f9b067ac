"""Batches of standard flights, each lane with a bracket of its own: what the tests of estimators share."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from helpers import random_starts, standard_flight, standard_problem

import jaxos4

HALF = jaxos4.DEFAULT_HALF_WIDTH
LANES = 64


@eqx.filter_jit
def identify(estimator, problem, states, omega, lower, upper):
    """One estimate for each lane of the last four arguments."""

    @eqx.filter_vmap
    def lane(states, omega, lower, upper):
        data = eqx.tree_at(lambda p: (p.flight.states, p.flight.omega), problem, (states, omega))
        return estimator(data, jaxos4.Bracket(lower, upper))

    return lane(states, omega, lower, upper)


def lanes(states, model_class=jaxos4.PublishedOS4, channels="rates", *, free=False, scale=1.0, seed=150):
    """Arguments of `identify`: sigma times `scale`, and bracket centers off by up to 80 % of the half-width."""
    center = random_starts(model_class(), len(states), seed=seed)
    omega = jnp.tile(standard_flight(model_class).omega, (len(states), 1, 1))
    problem = standard_problem(model_class, channels, free=free)
    problem = eqx.tree_at(lambda p: p.sigma, problem, scale * problem.sigma)
    return problem, states, omega, center - HALF, center + HALF


@functools.cache
def bound(model_class=jaxos4.PublishedOS4, channels="rates", free=False):
    """Standard deviations at the Cramer-Rao bound."""
    problem = standard_problem(model_class, channels, free=free)
    return np.sqrt(np.diagonal(jaxos4.cramer_rao_bound(problem, model_class().alpha)))


def names(estimates):
    """The result of each lane."""
    return jaxos4.result_names(estimates.result)
