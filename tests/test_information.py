import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import numpy_jacobian, standard_problem

import jaxos4
from jaxos4 import linalg
from jaxos4.models.state import CHANNELS

# Each as one program.
invert = jax.jit(linalg.invert)
joint_factor = jax.jit(linalg.joint_factor, static_argnums=1)
every_channels = pytest.mark.parametrize("channels", CHANNELS)

# Standard flight, known initial state: standard deviations in % of alpha (alpha2, 5 and 7: absolute x 100).
PRINTED = {
    "rates": ("0.81", "0.11", "0.11", "0.80", "0.19", "0.11", "0.52", "0.11"),
    "attitude": ("0.35", "0.040", "0.098", "0.38", "0.092", "0.099", "0.13", "0.090"),
    "all": ("0.14", "0.014", "0.029", "0.15", "0.033", "0.027", "0.12", "0.089"),
}


def percent(bound):
    alpha = np.asarray(jaxos4.PublishedOS4().alpha)
    return 100 * np.sqrt(np.diagonal(bound)) / np.where(np.abs(alpha) > 1e-6, np.abs(alpha), 1)


@every_channels
def test_the_standard_flights_bounds_are_the_known_figures(channels):
    bound = jaxos4.cramer_rao_bound(standard_problem(channels=channels), jaxos4.PublishedOS4().alpha)
    figures = percent(bound)
    rounded = [f"{x:.{len(text) - 2}f}" for x, text in zip(figures, PRINTED[channels], strict=True)]
    assert rounded == list(PRINTED[channels])


@pytest.mark.parametrize("model_class", [jaxos4.PublishedOS4, jaxos4.CorrectedOS4])
@every_channels
def test_information_is_the_jacobians_square(model_class, channels):
    """A free initial state is eliminated: the bound is a corner of the inverse of the joint information."""
    alpha = model_class().alpha
    for free in (False, True):
        problem = standard_problem(model_class, channels, free=free)
        slopes = numpy_jacobian(problem, alpha, np.zeros(problem.size))  # from rest
        joint = slopes.T @ slopes
        information = np.linalg.inv(np.linalg.inv(joint)[:8, :8]) if free else joint[:8, :8]
        scale = np.sqrt(np.diagonal(information))
        actual = jaxos4.fisher_information(problem, alpha)
        np.testing.assert_allclose(actual / np.outer(scale, scale), information / np.outer(scale, scale), atol=1e-6)
        bound = jaxos4.cramer_rao_bound(problem, alpha)
        np.testing.assert_allclose(np.diagonal(bound), np.diagonal(np.linalg.inv(information)), rtol=1e-4)


def test_twice_the_noise_is_twice_the_bound_and_lost_samples_cost():
    alpha, problem = jaxos4.PublishedOS4().alpha, standard_problem(channels="rates")
    bound = jaxos4.cramer_rao_bound(problem, alpha)
    louder = eqx.tree_at(lambda p: p.sigma, problem, 2 * problem.sigma)
    np.testing.assert_allclose(jaxos4.cramer_rao_bound(louder, alpha), 4 * bound, rtol=1e-9)
    kept = np.arange(501) % 2 == 0
    half = eqx.tree_at(lambda p: p.flight.states, problem, jnp.where(kept[:, None], problem.flight.states, jnp.nan))
    ratio = np.diagonal(jaxos4.cramer_rao_bound(half, alpha)) / np.diagonal(bound)
    np.testing.assert_allclose(ratio, 2, rtol=0.05)


# The inverse.


def random_information(size, condition, seed=0):
    rng = np.random.default_rng(seed)
    vectors = np.linalg.qr(rng.normal(size=(size, size)))[0]
    units = 10.0 ** rng.uniform(-6, 6, size)
    return jnp.asarray((vectors * np.geomspace(1, 1 / condition, size)) @ vectors.T * np.outer(units, units))


@pytest.mark.parametrize("condition", [1.0, 1e4, 1e8])
def test_inverts_whatever_the_units(condition):
    information = random_information(8, condition)
    inverse = np.asarray(invert(information))
    scale = np.sqrt(np.diagonal(information))
    np.testing.assert_allclose(inverse, inverse.T, rtol=1e-12)
    unit = (inverse * np.outer(scale, scale)) @ (np.asarray(information) / np.outer(scale, scale))
    np.testing.assert_allclose(unit, np.eye(8), atol=1e-14 * 8 * condition)


@pytest.mark.parametrize("lost", [[3], [0, 7], list(range(8))])
def test_an_unknown_without_information_gets_a_huge_and_finite_variance(lost):
    information = np.asarray(random_information(8, 10.0)).copy()
    expected = np.linalg.inv(np.delete(np.delete(information, lost, 0), lost, 1))
    information[lost, :] = information[:, lost] = 0
    inverse = np.asarray(invert(jnp.asarray(information)))
    assert np.isfinite(inverse).all()
    assert (np.diagonal(inverse)[lost] > 1e12).all()
    np.testing.assert_allclose(np.delete(np.delete(inverse, lost, 0), lost, 1), expected, rtol=1e-9)


def test_a_combination_without_information_gets_a_huge_and_finite_variance():
    slopes = np.random.default_rng(0).normal(size=(100, 4))
    slopes[:, 3] = slopes[:, 0] - slopes[:, 1]
    inverse = np.asarray(invert(jnp.asarray(slopes.T @ slopes)))
    variance = np.diagonal(inverse)
    assert np.isfinite(inverse).all()
    assert (variance[[0, 1, 3]] > 1e10).all()
    assert variance[2] == pytest.approx(1 / 100, rel=0.5)


def arrow(blocks, count):
    """The joint information of all windows: the shared unknowns first, then each window's own."""
    windows, size, _ = blocks.shape
    own = size - count
    joint = np.zeros((count + windows * own,) * 2)
    for w, block in enumerate(np.asarray(blocks)):
        places = np.concatenate([np.arange(count), count + w * own + np.arange(own)])
        joint[np.ix_(places, places)] += block
    return joint


@pytest.mark.parametrize("windows", [1, 2, 7])
def test_block_elimination_is_the_inverse_of_the_whole(windows):
    rng = np.random.default_rng(windows)
    slopes = rng.normal(size=(windows, 40, 11)) * 10.0 ** rng.uniform(-6, 6, 11)
    blocks = jnp.asarray(np.swapaxes(slopes, 1, 2) @ slopes)
    joint = arrow(blocks, 8)
    unit = np.sqrt(np.diagonal(joint))
    inverse = np.linalg.inv(joint / np.outer(unit, unit)) / np.outer(unit, unit)
    scale = np.sqrt(np.diagonal(inverse))
    factor, basis = map(np.asarray, joint_factor(blocks, 8))
    found = basis @ np.swapaxes(basis, 1, 2)
    for w in range(windows):
        places = np.concatenate([np.arange(8), 8 + 3 * w + np.arange(3)])
        own = np.outer(scale[places], scale[places])
        np.testing.assert_allclose(found[w] / own, inverse[np.ix_(places, places)] / own, atol=1e-9)
    identity = np.broadcast_to(np.eye(11), basis.shape)
    np.testing.assert_allclose(np.swapaxes(basis, 1, 2) @ factor, identity, atol=1e-9)
