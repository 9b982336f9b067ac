"""`Unknowns`, brackets and results: held parameters keep their values; the others are estimated as if known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import noisy_states, standard_problem

import jaxos4
from jaxos4 import estimators
from jaxos4.results import NAMES
from jaxos4.shooting import InnovationsProblem

HELD = {"alpha2": 0.0079, "alpha7": 0.01}
PLACES = [1, 6]
ESTIMATORS = {name: kind() for name, kind in estimators.ESTIMATORS.items() if not kind.needs_network}
# Their covariance is the inverse of an information.
LIKELIHOODS = ("ibss", "output-error", "filter-error", "kalman", "ant-colony")


def noisy_problem():
    return standard_problem(jaxos4.CorrectedOS4, channels="rates", states=noisy_states(1, jaxos4.CorrectedOS4)[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_held_parameter_keeps_its_value_and_has_no_variance(name):
    found = ESTIMATORS[name](noisy_problem().hold(HELD))
    np.testing.assert_array_equal(found.parameters[np.array(PLACES)], list(HELD.values()))
    covariance = np.asarray(found.covariance)
    assert (covariance[PLACES] == 0).all()
    assert (covariance[:, PLACES] == 0).all()
    others = np.delete(np.arange(8), PLACES)
    assert (np.diagonal(covariance)[others] > 0).all()
    if name in LIKELIHOODS:
        # Fewer unknowns are known better; the bound is computed at another answer.
        free = ESTIMATORS[name](noisy_problem())
        assert (np.asarray(found.std)[others] <= 1.1 * np.asarray(free.std)[others]).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ibss", "output-error", "kalman", "equation-error"])
def test_the_others_are_estimated_without_error_if_the_held_values_are_true(name):
    model = jaxos4.CorrectedOS4()
    problem = standard_problem(jaxos4.CorrectedOS4, "rates").hold({"alpha2": model.alpha[1], "alpha7": 0.0})
    found = ESTIMATORS[name](problem, jaxos4.Bracket.around(model.alpha + 0.5 * model.half_width, model.half_width))
    # A Gaussian prior moves the answer by its share of the information.
    tolerance = 0.05 * np.asarray(found.std) + 1e-12 if name == "kalman" else 1e-5 * np.asarray(model.half_width)
    assert (np.abs(found.parameters - model.alpha) <= tolerance).all()


@pytest.mark.slow
def test_a_held_parameter_needs_neither_a_start_nor_a_bracket():
    """A start elsewhere does not move it, and its bracket may be empty."""
    problem = noisy_problem().hold(HELD)
    found, start = jaxos4.IBSS()(problem), problem.unknowns.center + 0.9 * problem.unknowns.half_width
    half_width = problem.unknowns.half_width.at[np.array(PLACES)].set(0.0)
    empty = jaxos4.IBSS()(problem, jaxos4.Bracket.around(problem.unknowns.center, half_width))
    for other in (jaxos4.IBSS()(problem, start=start), empty):
        assert other.result == jaxos4.RESULTS.successful
        np.testing.assert_array_equal(other.parameters[np.array(PLACES)], list(HELD.values()))
        assert (np.abs(other.parameters - found.parameters) <= 0.01 * found.std).all()


@pytest.mark.slow
def test_held_parameters_are_no_degrees_of_freedom():
    problem = noisy_problem()
    residuals = problem.residuals(problem.model.alpha)
    free, held = (np.asarray(each.reweighted(residuals).sigma)[9] for each in (problem, problem.hold(HELD)))
    count = residuals.size - 3  # the first sample is known
    assert held / free == pytest.approx(np.sqrt((1 - 8 / count) / (1 - 6 / count)), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["shooting", "innovations"])
def test_information_about_held_unknowns_is_left_out(kind):
    """Gradient and information of the others do not change."""
    free = noisy_problem() if kind == "shooting" else InnovationsProblem(noisy_problem())
    held = free.hold(
        {name: float(value) for name, value in zip(HELD, free.unknowns.center[np.array(PLACES)], strict=True)}
    )
    model_at = eqx.filter_jit(lambda problem, at: problem.stages().local_model(jnp.asarray(0), at, at))
    at = eqx.filter_jit(lambda problem: problem.initial_guess.starts[0])(free)
    whole, part = (jax.tree.map(np.asarray, model_at(problem, at)) for problem in (free, held))
    others = np.delete(np.arange(free.unknowns.count), PLACES)
    np.testing.assert_allclose(part.cost, whole.cost, rtol=1e-12)
    np.testing.assert_allclose(part.gradient[:, others], whole.gradient[:, others], rtol=1e-9)
    np.testing.assert_array_equal(part.gradient[:, PLACES], 0)
    cross = np.ix_([0], others, others)
    np.testing.assert_allclose(part.information[cross], whole.information[cross], rtol=1e-9)
    np.testing.assert_array_equal(part.information[np.ix_([0], PLACES, others)], 0)


def test_a_bracket_moves_free_unknowns_only():
    problem = noisy_problem().hold(HELD)
    moved = problem.within(jaxos4.Bracket.around(np.full(8, 5.0), np.full(8, 2.0))).unknowns
    np.testing.assert_array_equal(np.asarray(moved.center)[PLACES], list(HELD.values()))
    np.testing.assert_array_equal(np.delete(np.asarray(moved.center), PLACES), 5.0)
    np.testing.assert_array_equal(moved.half_width, 2.0)
    twice = noisy_problem().hold({"alpha2": 0.0079}).hold({"alpha7": 0.01}).unknowns
    assert eqx.tree_equal(twice, problem.unknowns)


def test_the_default_bracket_is_the_models_own_to_each_side():
    for airframe in (jaxos4.OS4, jaxos4.VOOS):
        model = jaxos4.CorrectedOS4(airframe)
        bracket = jaxos4.Bracket.default(model)
        np.testing.assert_allclose(bracket.lower, model.alpha - model.half_width, rtol=1e-14)
        np.testing.assert_allclose(bracket.upper, model.alpha + model.half_width, rtol=1e-14)
        np.testing.assert_allclose(bracket.center, model.alpha, rtol=1e-15, atol=1e-15)
        np.testing.assert_allclose(bracket.half_width, model.half_width, rtol=1e-13)


# Results.


def test_half_widths_are_gaussian_unless_calibrated():
    estimate = jaxos4.OutputError()(noisy_problem())
    np.testing.assert_allclose(estimate.half_width(0.95), 1.959963985 * estimate.std, rtol=1e-8)
    assert (estimate.half_width(0.95, simultaneous=True) > estimate.half_width(0.95)).all()
    for level in (0.0, 1.0, -1.0, 95.0):
        with pytest.raises(ValueError, match="`level` must lie between 0 and 1"):
            estimate.half_width(level)


def test_every_result_has_a_name_and_a_message_in_a_batch_too():
    assert len(jaxos4.RESULTS) == len(NAMES)
    for name in NAMES:
        result = getattr(jaxos4.RESULTS, name)
        assert jaxos4.result_names(result).tolist() == name
        assert (jaxos4.RESULTS[result] == "") is (name == "successful")
    where, codes = jaxos4.RESULTS.where, jnp.array([[0, 1], [1, 0]])
    batch = jax.vmap(jax.vmap(lambda code: where(code == 1, jaxos4.RESULTS.at_bound, jaxos4.RESULTS.successful)))(codes)
    assert jaxos4.result_names(batch).tolist() == [["successful", "at_bound"], ["at_bound", "successful"]]
