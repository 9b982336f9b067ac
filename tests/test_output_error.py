"""Output error against an independent minimiser, the bound, and what cannot be identified."""

import equinox as eqx
import numpy as np
import optimistix
import pytest
from helpers import noisy_states, random_starts, standard_problem
from lanes import LANES, bound, identify, lanes

import jaxos4
from jaxos4.estimators.newton import OutputError

every_case = pytest.mark.parametrize(
    ("model_class", "channels"), [(jaxos4.PublishedOS4, "all"), (jaxos4.CorrectedOS4, "rates")]
)


@every_case
def test_without_noise_the_truth_is_found(model_class, channels):
    states = noisy_states(LANES, model_class, scale=0.0)
    found = identify(OutputError(), *lanes(states, model_class, channels, seed=1))
    assert set(jaxos4.result_names(found.result)) == {"successful"}
    np.testing.assert_allclose(found.parameters, np.tile(model_class().alpha, (LANES, 1)), rtol=1e-7, atol=1e-9)


def test_it_is_the_minimum_that_another_minimiser_finds():
    problem = standard_problem(channels="rates", states=noisy_states(1, seed=4)[0])
    found = OutputError()(problem, jaxos4.Bracket.default(problem.model))
    scale = np.asarray(problem.model.half_width)
    solver = optimistix.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
    start = problem.model.alpha / scale
    best = optimistix.least_squares(lambda u, _: problem.residuals(u * scale), solver, start).value

    def off(answer):
        return np.abs((answer - best * scale) / found.std).max()

    assert off(found.parameters) < 1e-4
    # Stopped after the first step, it is far from there: the comparison can fail.
    early = OutputError(max_steps=1)(problem, jaxos4.Bracket.around(problem.model.alpha + 0.5 * scale, scale))
    assert jaxos4.result_names(early.result) == "max_sweeps"
    assert off(early.parameters) > 0.1


@every_case
def test_errors_are_those_of_the_bound(model_class, channels):
    found = identify(OutputError(), *lanes(noisy_states(LANES, model_class), model_class, channels, seed=0))
    assert set(jaxos4.result_names(found.result)) == {"successful"}
    error = np.asarray(found.parameters - model_class().alpha)
    efficiency = np.sqrt(np.mean((error / bound(model_class, channels)) ** 2, axis=0))
    assert np.all(np.abs(efficiency - 1) < 4 / np.sqrt(2 * LANES))
    held = (np.abs(error) < found.half_width(0.95)).mean()
    # Parameters are correlated: as if there were one of them.
    assert abs(held - 0.95) < 4 * np.sqrt(0.95 * 0.05 / LANES)


def test_a_free_initial_state_gives_the_answer_of_ibss():
    arguments = lanes(noisy_states(4, seed=2), free=True, seed=2)
    ours, other = (identify(estimator, *arguments) for estimator in (OutputError(), jaxos4.IBSS()))
    assert np.abs((ours.parameters - other.parameters) / other.std).max() < 0.1
    np.testing.assert_allclose(ours.std, other.std, rtol=1e-2)
    assert np.abs(ours.initial_state - other.initial_state).max() < 0.01


def test_many_lanes_at_once_come_back():
    flights = 512
    states, starts = noisy_states(flights, duration=0.5), random_starts(jaxos4.PublishedOS4(), flights)
    problem = standard_problem(channels="rates", duration=0.5)

    @eqx.filter_jit
    @eqx.filter_vmap
    def short(states, center):
        flight = eqx.tree_at(lambda p: p.flight.states, problem, states)
        return OutputError()(flight, jaxos4.Bracket.around(center, problem.model.half_width))

    assert np.isfinite(short(states, starts).parameters).all()


def test_a_truth_far_from_the_bracket_is_reported():
    problem = standard_problem(channels="rates")
    narrow = jaxos4.Bracket.around(
        problem.model.alpha + 0.8 * problem.model.half_width, 0.15 * problem.model.half_width
    )
    assert jaxos4.result_names(OutputError()(problem, narrow).result) == "at_bound"
