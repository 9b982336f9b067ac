"""The constants of a rigid body: fitted to alphas, and estimated instead of them."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from helpers import standard_problem

import jaxos4

MODELS = (jaxos4.PublishedOS4, jaxos4.CorrectedOS4)


def constants(airframe=jaxos4.OS4):
    """Ix, Iy, Iz, J_R."""
    return np.append(np.asarray(airframe.inertia), airframe.rotor_inertia)


def bound_of(model_class, channels="all"):
    """The covariance of an efficient estimate of the standard flight."""
    return jaxos4.cramer_rao_bound(standard_problem(model_class, channels), model_class(jaxos4.OS4).alpha)


@pytest.mark.parametrize("model_class", MODELS)
@pytest.mark.parametrize("airframe", [jaxos4.OS4, jaxos4.OS4_SIMULATOR, jaxos4.VOOS])
def test_exact_alphas_give_exact_constants(model_class, airframe):
    model = model_class(airframe)
    fit = jaxos4.fit_inertia(model, model.alpha, bound_of(model_class))
    np.testing.assert_allclose(fit.constants[:3], constants(airframe)[:3], rtol=1e-9)
    assert np.all(np.abs(fit.constants - constants(airframe)) < 1e-6 * fit.std)
    assert fit.mismatch < 1e-9
    assert fit.is_rigid_body


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


def test_alphas_of_no_rigid_body_are_seen():
    model, covariance = jaxos4.CorrectedOS4(), bound_of(jaxos4.CorrectedOS4)
    std = np.sqrt(np.diagonal(covariance))
    odd = jaxos4.fit_inertia(model, model.alpha.at[0].add(10 * std[0]), covariance)
    assert odd.p_value < 1e-3
    flat = jaxos4.alpha_from_inertia(np.array([0.005, 0.005, 0.013]), 6e-5)
    fit = jaxos4.fit_inertia(model, flat, covariance)
    assert fit.p_value > 0.99
    assert not fit.is_rigid_body
    assert fit.triangle[2] == pytest.approx(-0.003)


@pytest.mark.parametrize("model_class", MODELS)
def test_alphas_far_from_the_airframe_or_without_an_error_give_a_fit_or_say_that_there_is_none(model_class):
    model, covariance = model_class(jaxos4.OS4), bound_of(model_class)
    for alpha in (model.alpha.at[2].set(0.0), jnp.full(8, jnp.nan), -model.alpha):
        fit = jaxos4.fit_inertia(model, alpha, covariance)
        assert np.isfinite(fit.constants).all()
        assert fit.p_value < 1e-6
    for spread in (jnp.full((8, 8), jnp.inf), jnp.full((8, 8), jnp.nan)):
        fit = jaxos4.fit_inertia(model, model.alpha, spread)
        np.testing.assert_allclose(fit.constants, constants())
        assert np.isposinf(fit.std).all()
        assert fit.p_value == 0
    with pytest.raises(ValueError, match=r"shapes \(8,\), \(8, 8\), got \(4,\)"):
        jaxos4.fit_inertia(model, model.alpha[:4], covariance[:4, :4])
