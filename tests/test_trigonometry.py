import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxos4.trigonometry import sincos

SINGLE, DOUBLE = np.float32, np.float64


@pytest.mark.parametrize(("dtype", "turns"), [(DOUBLE, 1), (DOUBLE, 1e3), (DOUBLE, 1e5), (SINGLE, 1), (SINGLE, 1e3)])
def test_agrees_with_the_library_to_about_one_ulp(dtype, turns):
    rng = np.random.default_rng(0)
    anywhere = rng.uniform(-turns, turns, 20_000)
    quarters = np.round(rng.uniform(-4 * turns, 4 * turns, 2_000)) / 4
    angle = (2 * np.pi * np.concatenate([anywhere, quarters])).astype(dtype)
    sin, cos = sincos(jnp.asarray(angle))
    assert sin.dtype == cos.dtype == dtype
    exact = angle.astype(DOUBLE)
    eps = np.finfo(dtype).eps
    np.testing.assert_allclose(sin, np.sin(exact), rtol=0, atol=1.5 * eps)
    np.testing.assert_allclose(cos, np.cos(exact), rtol=0, atol=1.5 * eps)
    if dtype == DOUBLE and turns <= 1e3:  # and near the zeros, in their own units
        np.testing.assert_allclose(sin, np.sin(exact), rtol=3 * eps)
        np.testing.assert_allclose(cos, np.cos(exact), rtol=3 * eps)


def test_nan_and_infinity_give_nan():
    for value in sincos(jnp.array([jnp.nan, jnp.inf, -jnp.inf])):
        assert np.isnan(value).all()
    for value in jax.jvp(lambda x: sincos(x)[0], (jnp.array([jnp.nan, jnp.inf]),), (jnp.ones(2),)):
        assert np.isnan(value).all()


def test_derivatives_of_any_order_and_mode():
    angle = jnp.array([-4.0, -0.3, 0.0, 0.78, np.pi / 2, 2.5, 100.0])
    check_grads(lambda x: sincos(jnp.asarray(x)), (angle,), order=3, modes=("fwd", "rev"))
    np.testing.assert_allclose(jax.vmap(jax.grad(lambda x: sincos(x)[0]))(angle), jnp.cos(angle), atol=1e-15)
    np.testing.assert_allclose(jax.vmap(jax.grad(lambda x: sincos(x)[1]))(angle), -jnp.sin(angle), atol=1e-15)


def test_the_reference_would_catch_a_coarser_one():
    angle = jnp.linspace(-1, 1, 101)
    assert np.abs(sincos(angle)[0] - jnp.sin(angle * (1 + 1e-14))).max() > 1.5 * np.finfo(DOUBLE).eps
