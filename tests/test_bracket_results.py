import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxos4
from jaxos4.results import NAMES

ALPHA = jaxos4.PublishedOS4().alpha
HALF = jaxos4.DEFAULT_HALF_WIDTH


def test_a_bracket_reaches_one_half_width_to_each_side():
    bracket = jaxos4.Bracket.around(ALPHA, HALF)
    np.testing.assert_array_equal(bracket.lower, ALPHA - HALF)
    np.testing.assert_array_equal(bracket.upper, ALPHA + HALF)
    np.testing.assert_allclose(bracket.center, ALPHA, rtol=1e-15, atol=1e-15)
    np.testing.assert_allclose(bracket.half_width, HALF, rtol=1e-13)


def test_the_default_bracket_is_the_models_own():
    for airframe in (jaxos4.OS4, jaxos4.VOOS):
        model = jaxos4.CorrectedOS4(airframe)
        bracket = jaxos4.Bracket.default(model)
        np.testing.assert_allclose(bracket.center, model.alpha)
        np.testing.assert_allclose(bracket.half_width, model.half_width)


@pytest.mark.parametrize("kind", [np.array, jnp.array])
def test_takes_arrays_of_any_kind_and_keeps_strong_floats(kind):
    bracket = jaxos4.Bracket(kind([0, 1]), kind([2, 3]))
    for end in (bracket.lower, bracket.upper):
        assert end.dtype == jnp.float64
        assert not end.weak_type


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        ([0.0, 1.0], [1.0, 1.0]),
        ([0.0, 2.0], [1.0, 1.0]),
        ([0.0, jnp.nan], [1.0, 1.0]),
        ([0.0, 0.0], [1.0, jnp.nan]),
        ([0.0, 0.0], [1.0, jnp.inf]),
        ([-jnp.inf, 0.0], [1.0, 1.0]),
        ([-jnp.inf, -jnp.inf], [jnp.inf, jnp.inf]),
        ([0.0, jnp.inf], [1.0, jnp.inf]),
    ],
)
def test_says_when_it_is_none(lower, upper):
    unknowns = jaxos4.Unknowns.of(jaxos4.PublishedOS4())
    assert bool(unknowns.valid)
    assert not bool(unknowns.within(jaxos4.Bracket(np.resize(lower, 8), np.resize(upper, 8))).valid)


@pytest.mark.parametrize(
    ("lower", "upper"), [(np.zeros(8), np.ones(7)), (np.zeros((2, 8)), np.ones((2, 8))), (0.0, 1.0)]
)
def test_ends_that_do_not_fit_are_named(lower, upper):
    with pytest.raises(ValueError, match=r"`lower` and `upper` must be one-dimensional and of one shape"):
        jaxos4.Bracket(lower, upper)


# Results.


def test_every_result_has_a_name_and_a_message():
    assert len(jaxos4.RESULTS) == len(NAMES)
    for name in NAMES:
        result = getattr(jaxos4.RESULTS, name)
        assert jaxos4.result_names(result).tolist() == name
        assert (jaxos4.RESULTS[result] == "") is (name == "successful")


def test_names_a_whole_batch():
    codes = jnp.array([[0, 1, 2], [2, 1, 0]])

    def result(code):
        chosen = jaxos4.RESULTS.where(code == 1, jaxos4.RESULTS.at_bound, jaxos4.RESULTS.successful)
        return jaxos4.RESULTS.where(code == 2, jaxos4.RESULTS.max_sweeps, chosen)

    batch = eqx.filter_vmap(eqx.filter_vmap(result))(codes)
    assert jaxos4.result_names(batch).tolist() == [
        ["successful", "at_bound", "max_sweeps"],
        ["max_sweeps", "at_bound", "successful"],
    ]
