"""Laws that hold for every estimator of the registry that needs no network: one batch of noisy flights, one program."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from helpers import doublet_problem, noisy_states, standard_flight, standard_problem
from lanes import (
    FEW,
    HALF,
    LANES,
    assert_chi_square,
    assert_nothing_invented,
    bound,
    count_of,
    identify,
    lanes,
    lost,
    names,
    noisy,
)

import jaxos4
from jaxos4.bracket import GAUSSIAN_PRIOR
from jaxos4.estimators import ESTIMATORS, make_estimator

MODEL, P = jaxos4.PublishedOS4(), jaxos4.STATE_NAMES.index("p")
NAMES = [name for name, kind in ESTIMATORS.items() if not kind.needs_network]
# Their covariance is the inverse of an information.
LIKELIHOODS = ("ibss", "output-error", "filter-error", "kalman", "ant-colony")


@pytest.fixture(params=[pytest.param(each, marks=pytest.mark.slow) if each == "ant-colony" else each for each in NAMES])
def name(request):
    """Every estimator in turn."""
    if request.param in ("filter-error", "ant-colony"):  # they compute for long
        request.getfixturevalue("optimised")
    return request.param


def found_by(name, scale=1.0):
    return noisy(ESTIMATORS[name], scale=scale, count=count_of(name))


def alone(name, lane, **fixed):
    """The flight of this lane by itself, with some parameters fixed."""
    problem, states, _, lower, upper = lanes(noisy_states(count_of(name), seed=50))
    data = eqx.tree_at(lambda p: p.flight.states, problem, states[lane])
    bracket = jaxos4.Bracket(lower[lane], upper[lane])
    return make_estimator(name)(data.fix(fixed, bracket) if fixed else data.within(bracket))


def test_tiny_noise_gives_the_truth(name):
    estimates = found_by(name, 1e-4)
    assert set(names(estimates)) == {"successful"}
    most = 0.02 * HALF if name == "svsf" else 10 * 1e-4 * bound()
    assert (np.abs(estimates.parameters - MODEL.alpha) < most).all()


@pytest.mark.slow
def test_loop_jit_and_vmap_agree(name):
    batched = found_by(name)
    assert set(names(batched)) == {"successful"}
    for lane in range(2):
        single = alone(name, lane)
        most = 1e-3 if name == "output-error" else 1e-6
        assert (np.abs(single.parameters - batched.parameters[lane]) / bound()).max() < most
        np.testing.assert_allclose(single.covariance, batched.covariance[lane], rtol=1e-5, atol=1e-15)
        np.testing.assert_allclose(single.cost, batched.cost[lane], rtol=1e-6)
        assert (names(single), int(single.rollouts)) == (names(batched)[lane], int(batched.rollouts[lane]))


@pytest.mark.slow
def test_a_fixed_parameter_keeps_its_value_and_has_no_variance(name):
    found, places = alone(name, 0, alpha2=1e-4, alpha7=0.01), np.array([1, 6])
    np.testing.assert_array_equal(found.parameters[places], [1e-4, 0.01])
    covariance, others = np.asarray(found.covariance), np.delete(np.arange(8), places)
    assert (covariance[places] == 0).all()
    assert (covariance[:, places] == 0).all()
    assert (np.diagonal(covariance)[others] > 0).all()
    if name in LIKELIHOODS:
        # Fewer unknowns are known better; the bound is computed at another answer.
        assert (np.asarray(found.std)[others] <= 1.1 * np.asarray(found_by(name).std)[0, others]).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ibss", "output-error", "kalman", "equation-error"])
def test_the_others_are_estimated_without_error_if_the_fixed_values_are_true(name):
    problem = standard_problem(channels="rates").fix({"alpha2": MODEL.alpha[1], "alpha7": 0.0})
    found = make_estimator(name)(problem, jaxos4.Bracket.around(MODEL.alpha + 0.5 * HALF, HALF))
    # A Gaussian prior moves the answer by its share of the information.
    tolerance = 0.05 * np.asarray(found.std) + 1e-12 if name == "kalman" else 1e-5 * np.asarray(HALF)
    assert (np.abs(found.parameters - MODEL.alpha) <= tolerance).all()


@pytest.mark.slow
def test_failing_lanes_leave_their_neighbours_alone(name):
    problem, *arrays = lanes(noisy_states(count_of(name), seed=50))
    states, omega, lower, upper = (np.array(x) for x in arrays)
    failed, vague = np.arange(1, 16, 2), np.array([2, 4, 6])
    omega[1, 250, 2] = np.nan
    omega[3, 30, 0] = np.inf
    states[5, 100, P] = np.inf
    states[7, 500, P] = -np.inf
    lower[9, 0], upper[9, 0] = upper[9, 0], lower[9, 0]
    lower[11, 2] = np.nan
    upper[13, 3] = np.inf
    upper[15, 4] = lower[15, 4]
    states[2, :, P] = np.nan  # roll was not measured
    states[4] -= standard_flight().states  # a hover
    omega[4] = MODEL.airframe.hover_speed
    states[6] = np.nan  # nothing was measured
    broken = identify(make_estimator(name), problem, *map(jnp.asarray, (states, omega, lower, upper)))
    expected = np.full(len(states), "successful", dtype=object)
    expected[failed], expected[vague] = ["nonfinite_trajectory"] * 4 + ["bracket_invalid"] * 4, "unidentifiable"
    assert names(broken).tolist() == expected.tolist()
    others = np.setdiff1d(np.arange(len(states)), [*failed, *vague])
    for kept, was in zip(jax.tree.leaves(broken), jax.tree.leaves(found_by(name)), strict=True):
        np.testing.assert_array_equal(np.asarray(kept)[others], np.asarray(was)[others])
    # Every parameter is finite. A lane without an answer is infinitely uncertain.
    assert all(np.isfinite(leaf).all() for leaf in (broken.parameters, broken.initial_state))
    assert broken.history is None or np.isfinite(broken.history).all()
    assert np.isinf(np.asarray(broken.std)[failed]).all()
    assert np.isinf(np.asarray(broken.cost)[failed]).all()
    np.testing.assert_allclose(broken.parameters[1:9:2], (lower[1:9:2] + upper[1:9:2]) / 2)
    # A flight without measurements adds nothing to the bracket.
    largest_std = ESTIMATORS[name].largest_std
    assert (np.asarray(broken.std)[vague] > largest_std * HALF).any(axis=1).all()
    np.testing.assert_allclose(broken.parameters[6], (lower[6] + upper[6]) / 2)
    if largest_std == GAUSSIAN_PRIOR:
        np.testing.assert_allclose(broken.std[6], HALF)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NAMES if name != "svsf"])
def test_missing_samples_only_cost_precision(name):
    """Three of ten measurements are lost, and the covariance still describes the errors."""
    estimates = identify(make_estimator(name), *lanes(lost(noisy_states(count_of(name), seed=7))))
    assert set(names(estimates)) == {"successful"}
    assert (np.median(estimates.std, axis=0) > 1.05 * bound()).all()
    assert_chi_square(np.asarray(estimates.parameters - MODEL.alpha), np.linalg.inv(estimates.covariance))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "free"),
    [*((name, False) for name in NAMES), *((name, True) for name in ("svsf", "equation-error", "rls"))],
)
def test_no_estimator_invents_numbers_for_doublets(name, free):
    """Doublets do not identify all parameters. For a hover: above."""
    for only_roll in (True, False):
        assert_nothing_invented(make_estimator(name), *doublet_problem(only_roll=only_roll, free=free))


@pytest.mark.slow
def test_output_error_is_the_minimum_that_another_minimiser_finds():
    problem = standard_problem(channels="rates", states=noisy_states(1, seed=4)[0])
    found = jaxos4.OutputError()(problem, jaxos4.Bracket.default(problem.model))
    scale = np.asarray(problem.model.half_width)
    solver = optimistix.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
    start = problem.model.alpha / scale
    best = optimistix.least_squares(lambda u, _: problem.residuals(u * scale), solver, start).value

    def off(answer):
        return np.abs((answer - best * scale) / found.std).max()

    assert off(found.parameters) < 1e-4
    # Stopped after the first step, it is far from there: the comparison can fail.
    early = jaxos4.OutputError(max_steps=1)(problem, jaxos4.Bracket.around(problem.model.alpha + 0.5 * scale, scale))
    assert names(early) == "max_sweeps"
    assert off(early.parameters) > 0.1


@pytest.mark.slow
def test_ibss_reaches_the_maximum_of_the_likelihood():
    """That of output error, which is that of another minimiser, see above."""
    problem, *arguments = lanes(noisy_states(LANES, seed=5))
    best = identify(jaxos4.OutputError(tolerance=1e-9), problem, *arguments).parameters
    # What the default tolerance allows is far below the noise.
    for settings, most in (({"tolerance": 1e-5}, 1e-4), ({}, 0.05)):
        estimates = identify(jaxos4.IBSS(**settings), problem, *arguments)
        assert set(names(estimates)) == {"successful"}
        assert np.abs((estimates.parameters - best) / bound()).max() < most


def test_too_few_sweeps_are_reported():
    """They are counted for each share of the flight."""
    estimates = identify(jaxos4.IBSS(max_sweeps=1, tolerance=1e-8), *lanes(noisy_states(LANES)))
    assert set(names(estimates)) == {"max_sweeps"}
    assert np.isfinite(estimates.parameters).all()
    assert (np.asarray(estimates.sweeps) == 3).all()


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_the_colony_reaches_the_optimum_of_ibss_with_many_more_rollouts():
    colony = found_by("ant-colony")
    ibss = jax.tree.map(lambda leaf: leaf[: count_of("ant-colony")], found_by("ibss"))
    assert set(names(colony)) == {"successful"}
    # A cost of 0.005 is an error of 0.1 standard deviations.
    assert (np.abs(colony.cost - ibss.cost) < 5 * jaxos4.AntColony().tolerance).all()
    assert (np.abs(colony.parameters - ibss.parameters) < 0.1 * bound()).all()
    np.testing.assert_allclose(colony.std, ibss.std, rtol=0.01)
    assert (np.asarray(colony.rollouts) > 5 * np.asarray(ibss.rollouts)).all()


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_filter_error_finds_the_truth_at_nearly_the_bound():
    """White noise and nothing else. The noise is estimated too, and a weak disturbance can never be ruled out.

    So the standard deviations lie above the bound, which knows that there is none: by little for torques, and by up to
    40 % for parameters that act slowly.
    """
    problem, *arrays = lanes(noisy_states(LANES, seed=50))
    parts = [
        identify(ESTIMATORS["filter-error"](), problem, *(x[i : i + FEW] for x in arrays)) for i in range(0, LANES, FEW)
    ]
    found = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    assert set(names(found)) == {"successful"}
    ratio = np.median(found.std, axis=0) / bound()
    assert (ratio > 0.95).all(), ratio
    assert (ratio < np.array([1.2, 1.4, 1.1, 1.2, 1.4, 1.1, 1.2, 1.1])).all(), ratio
    assert_chi_square(np.asarray(found.parameters - MODEL.alpha), np.linalg.inv(found.covariance))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["output-error", "equation-error", "rls"])
def test_a_truth_far_from_the_bracket_is_reported(name):
    problem = standard_problem(channels="rates", free=True)
    narrow = jaxos4.Bracket.around(MODEL.alpha + 0.75 * HALF, 0.15 * HALF)
    assert names(make_estimator(name)(problem, narrow)) == "at_bound"
