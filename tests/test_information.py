"""Information and its inverse, and the constants of a rigid body: fitted to alphas, and estimated instead of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from helpers import first_state, numpy_jacobian, numpy_residuals, standard_problem

import jaxos4
from jaxos4 import linalg
from jaxos4.models.state import CHANNELS

# Each as one program.
invert = jax.jit(linalg.invert)

# Standard flight, known initial state: standard deviations in % of alpha (alpha2, 5 and 7: absolute x 100).
PRINTED = {
    "rates": ("0.81", "0.11", "0.11", "0.80", "0.19", "0.11", "0.52", "0.11"),
    "attitude": ("0.35", "0.040", "0.098", "0.38", "0.092", "0.099", "0.13", "0.090"),
    "all": ("0.14", "0.014", "0.029", "0.15", "0.033", "0.027", "0.12", "0.089"),
}


@pytest.mark.parametrize("channels", CHANNELS)
def test_the_standard_flights_bounds_are_the_known_figures(channels):
    alpha = np.asarray(jaxos4.PublishedOS4().alpha)
    bound = jaxos4.cramer_rao_bound(standard_problem(channels=channels), jaxos4.PublishedOS4().alpha)
    figures = 100 * np.sqrt(np.diagonal(bound)) / np.where(np.abs(alpha) > 1e-6, np.abs(alpha), 1)
    rounded = [f"{x:.{len(text) - 2}f}" for x, text in zip(figures, PRINTED[channels], strict=True)]
    assert rounded == list(PRINTED[channels])


PUBLISHED, CORRECTED = MODELS = jaxos4.PublishedOS4, jaxos4.CorrectedOS4


@pytest.mark.parametrize("free", [*(pytest.param(each, marks=pytest.mark.slow) for each in (False, True)), 5])
@pytest.mark.parametrize(
    ("model_class", "channels"), [(PUBLISHED, "attitude"), (CORRECTED, "rates"), (CORRECTED, "all")]
)
def test_information_is_the_jacobians_square(model_class, channels, free):
    """A free initial state is eliminated, in each of 5 windows too: the bound is a corner of the inverse."""
    alpha, problem = model_class().alpha, standard_problem(model_class, channels, free=bool(free))
    if free == 5:
        given = {"sigma": problem.sigma, "channels": channels, "windows": 5}
        problem = jaxos4.ShootingProblem(problem.model, problem.flight, **given)
    starts, moved = np.asarray(first_state(problem)), alpha * 1.001
    slopes = numpy_jacobian(problem, alpha, starts)
    joint = slopes.T @ slopes
    information = np.linalg.inv(np.linalg.inv(joint)[:8, :8]) if free else joint[:8, :8]
    unit = np.outer(*[np.sqrt(np.diagonal(information))] * 2)
    found = jaxos4.evaluate(problem, alpha)
    np.testing.assert_allclose(found.fisher_information / unit, information / unit, atol=1e-6)
    for bound in (jaxos4.cramer_rao_bound(problem, alpha), found.covariance):
        np.testing.assert_allclose(np.diagonal(bound), np.diagonal(np.linalg.inv(information)), rtol=1e-4)
    residuals = numpy_residuals(problem, np.asarray(moved), starts)
    np.testing.assert_allclose(jaxos4.evaluate(problem, moved).cost, np.square(residuals).sum() / 2, rtol=1e-9)


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
    # A combination without information gets a huge and finite variance.
    slopes = np.random.default_rng(0).normal(size=(100, 8))
    slopes[:, 3] = slopes[:, 0] - slopes[:, 1]
    inverse = np.asarray(invert(jnp.asarray(slopes.T @ slopes)))
    assert np.isfinite(inverse).all()
    assert (np.diagonal(inverse)[[0, 1, 3]] > 1e10).all()
    assert inverse[2, 2] == pytest.approx(1 / 100, rel=0.5)


def constants(airframe=jaxos4.OS4):
    """Ix, Iy, Iz, J_R."""
    return np.append(np.asarray(airframe.inertia), airframe.rotor_inertia)


def bound_of(model_class, channels="all"):
    """The covariance of an efficient estimate of the standard flight."""
    return jaxos4.cramer_rao_bound(standard_problem(model_class, channels), model_class(jaxos4.OS4).alpha)


@pytest.mark.parametrize("model_class", MODELS)
def test_it_is_the_weighted_least_squares_that_another_minimiser_finds(model_class):
    model, covariance = model_class(jaxos4.OS4), np.asarray(bound_of(model_class))
    alpha = np.random.default_rng(0).multivariate_normal(model.alpha, covariance)
    fit = jaxos4.fit_inertia(model, jnp.asarray(alpha), jnp.asarray(covariance))
    whiten, factor = np.linalg.inv(np.linalg.cholesky(covariance)), float(model.gyroscopic_factor)

    def residuals(u):
        ix, iy, iz, rotor = u * constants()
        g = rotor * factor
        own = [(iy - iz) / ix, g / ix, 1 / ix, (iz - ix) / iy, g / iy, 1 / iy, (ix - iy) / iz, 1 / iz]
        return whiten @ (alpha - own)

    best = scipy.optimize.least_squares(residuals, np.ones(4), x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert np.abs((fit.constants - best.x * constants()) / fit.std).max() < 1e-4
    spread = np.linalg.inv(best.jac.T @ best.jac) * np.outer(constants(), constants())
    np.testing.assert_allclose(fit.std, np.sqrt(np.diagonal(spread)), rtol=1e-3)
    # The weights matter: an unweighted fit gives another answer.
    plain = jaxos4.fit_inertia(model, jnp.asarray(alpha), jnp.diag(jnp.square(model.half_width)))
    assert np.abs((fit.constants - plain.constants) / fit.std).max() > 0.3


@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
def test_intervals_hold_the_truth_and_the_mismatch_is_chi_squared(scale):
    model, draws = jaxos4.CorrectedOS4(), 4000
    covariance = scale**2 * np.asarray(bound_of(jaxos4.CorrectedOS4))
    alphas = np.random.default_rng(1).multivariate_normal(model.alpha, covariance, size=draws)
    fit = jaxos4.fit_inertia(model, alphas, covariance)
    held = (np.abs(fit.constants - constants()) < 1.96 * fit.std).mean(axis=0)
    assert np.all(np.abs(held - 0.95) < 4 * np.sqrt(0.95 * 0.05 / draws))
    assert scipy.stats.kstest(fit.p_value, "uniform").pvalue > 1e-3
    np.testing.assert_allclose(fit.p_value, scipy.stats.chi2.sf(fit.mismatch, 4), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("model_class", MODELS)
def test_alphas_of_no_rigid_body_far_from_the_airframe_or_without_an_error_are_seen(model_class):
    model, covariance = model_class(jaxos4.OS4), bound_of(model_class)
    alpha, std = model.alpha, np.sqrt(np.diagonal(covariance))
    assert jaxos4.fit_inertia(model, alpha.at[0].add(10 * std[0]), covariance).p_value < 1e-3
    flat = jaxos4.alpha_from_inertia(np.array([0.005, 0.005, 0.013]), 6e-5 * float(model.gyroscopic_factor))
    fit = jaxos4.fit_inertia(model, flat, covariance)
    assert (fit.p_value > 0.99, fit.is_rigid_body) == (True, False)
    assert fit.constants[0] + fit.constants[1] - fit.constants[2] == pytest.approx(-0.003)
    for far in (alpha.at[2].set(0.0), jnp.full(8, jnp.nan), -alpha):
        fit = jaxos4.fit_inertia(model, far, covariance)
        assert np.isfinite(fit.constants).all()
        assert fit.p_value < 1e-6
    for spread in (jnp.full((8, 8), jnp.inf), jnp.full((8, 8), jnp.nan)):
        fit = jaxos4.fit_inertia(model, alpha, spread)
        np.testing.assert_allclose(fit.constants, constants())
        assert np.isposinf(fit.std).all()
        assert fit.p_value == 0
    with pytest.raises(ValueError, match=r"shapes \(8,\), \(8, 8\), got \(4,\)"):
        jaxos4.fit_inertia(model, alpha[:4], covariance[:4, :4])
