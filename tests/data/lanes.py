"""Batches of standard flights, each lane with a bracket of its own: what the tests of estimators share."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from helpers import inverse_square, noisy_states, numpy_jacobian, random_starts, standard_flight, standard_problem

import jaxos4

HALF = jaxos4.DEFAULT_HALF_WIDTH
LANES = 64
FEW = 16  # of estimators that compute for long


@eqx.filter_jit
def identify(estimator, problem, *arguments):
    """One estimate for each lane of `arguments`: states, rotor speeds, the bracket's two ends and, if given, starts."""

    @eqx.filter_vmap
    def lane(states, omega, lower, upper, *start):
        data = eqx.tree_at(lambda p: (p.flight.states, p.flight.omega), problem, (states, omega))
        return estimator(data, jaxos4.Bracket(lower, upper), **dict(zip(("start",), start, strict=False)))

    return lane(*arguments)


def lanes(states, model_class=jaxos4.PublishedOS4, channels="rates", *, free=False, scale=1.0, seed=150):
    """Arguments of `identify`: sigma times `scale`, and bracket centers off by up to 80 % of the half-width."""
    center = random_starts(model_class(), len(states), seed=seed)
    omega = jnp.tile(standard_flight(model_class).omega, (len(states), 1, 1))
    problem = standard_problem(model_class, channels, free=free)
    problem = eqx.tree_at(lambda p: p.sigma, problem, scale * problem.sigma)
    return problem, states, omega, center - HALF, center + HALF


def noisy(kind, model_class=jaxos4.PublishedOS4, channels="rates", free=False, scale=1.0, count=LANES):
    """Estimates of noisy flights by the estimator that `kind()` makes. Tests in one process share them."""
    return _noisy(kind, model_class, channels, free, scale, count)


@functools.cache
def _noisy(kind, model_class, channels, free, scale, count):
    states = noisy_states(count, model_class, seed=50, scale=scale)
    return identify(kind(), *lanes(states, model_class, channels, free=free, scale=scale))


def count_of(name):
    """The lanes of a batch for the estimator of this name."""
    return FEW if name in ("filter-error", "ant-colony", "rls") else LANES


@functools.cache
def bound(model_class=jaxos4.PublishedOS4, channels="rates", free=False):
    """Standard deviations at the Cramer-Rao bound by the NumPy equations. The library's: `test_information.py`."""
    problem = standard_problem(model_class, channels, free=free)
    slopes = numpy_jacobian(problem, model_class().alpha, np.zeros(problem.size))
    return np.sqrt(np.diagonal(inverse_square(slopes if free else slopes[:, :8])))[:8]


def errors(estimates, model_class=jaxos4.PublishedOS4):
    """Estimates less the truth, lane by lane."""
    return np.asarray(estimates.parameters - model_class().alpha)


def assert_chi_square(error, information):
    """error^T F error of each lane is chi-square with 8 degrees of freedom: its mean within four standard errors."""
    square = np.einsum("ni,nij,nj->n", error, np.broadcast_to(information, (len(error), 8, 8)), error) / 8
    assert abs(square.mean() - 1) < 4 * np.sqrt(2 / (8 * len(error))), square.mean()


def assert_covered(error, std):
    """95 % intervals hold the truth as often as they say. The errors of a flight are correlated: flights count."""
    inside = np.mean(np.abs(error) < 1.96 * np.asarray(std))
    assert abs(inside - 0.95) < 4 * np.sqrt(0.95 * 0.05 / len(error)), inside


def assert_nothing_invented(estimator, problem, bracket):
    """A flight that does not identify all parameters is named so. The cost is that of the estimate."""
    found = estimator(problem, bracket)
    assert names(found) == "unidentifiable"
    assert np.isfinite(found.parameters).all()
    np.testing.assert_allclose(found.cost, problem.cost(found.parameters, found.initial_state), rtol=1e-9)


def lost(states, share=0.3, seed=8):
    """The states without a `share` of the measurements."""
    gone = np.random.default_rng(seed).random(states.shape) < share
    return jnp.asarray(np.where(gone, np.nan, states))


def names(estimates):
    """The result of each lane."""
    return jaxos4.result_names(estimates.result)
