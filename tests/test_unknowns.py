"""`Unknowns`, brackets and results. Fixed parameters in searches: `test_searches.py`, `test_estimators.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import noisy_states, standard_problem

import jaxos4
from jaxos4.results import NAMES
from jaxos4.shooting import InnovationsProblem

HELD = {"alpha2": 0.0079, "alpha7": 0.01}
PLACES = [1, 6]


def noisy_problem():
    return standard_problem(jaxos4.CorrectedOS4, channels="rates", states=noisy_states(1, jaxos4.CorrectedOS4)[0])


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
    model_at = eqx.filter_jit(lambda problem, at: problem.stages().at(0, at).local_model(at))
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
