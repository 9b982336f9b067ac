"""Multiple shooting: the windows, and the estimators. A drift that one shot cannot follow: `test_experiments.py`."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import first_samples, noisy_states, numpy_residuals, random_starts, standard_flight
from lanes import LANES, identify

import jaxos4
from jaxos4.models.state import CASCADE_ORDER

PUBLISHED, CORRECTED = jaxos4.PublishedOS4, jaxos4.CorrectedOS4
SHOOTING = {"ibss": jaxos4.IBSS, "output error": jaxos4.OutputError}
WINDOWS = 4
CASES = [(PUBLISHED, "attitude"), (CORRECTED, "rates")]
every_case = pytest.mark.parametrize(("model_class", "channels"), CASES)


def windowed(windows, channels="all", model_class=PUBLISHED, *, states=None):
    flight = standard_flight(model_class)
    states = noisy_states(1, model_class)[0] if states is None else states
    flight = eqx.tree_at(lambda f: f.states, flight, states)
    model = model_class(jaxos4.OS4)
    return jaxos4.ShootingProblem(model, flight, sigma=jaxos4.SENSOR_SIGMA, channels=channels, windows=windows)


def flown(name, model_class, channels, states):
    """The estimates of `LANES` flights in four windows each, each with its own bracket."""
    starts, half_width = random_starts(model_class(), LANES, share=0.5), model_class().half_width
    omega = jnp.tile(standard_flight(model_class).omega, (LANES, 1, 1))
    problem = windowed(WINDOWS, channels, model_class)
    return identify(SHOOTING[name](), problem, states, omega, starts - half_width, starts + half_width)


@functools.cache
def noisy(name, model_class, channels):
    return flown(name, model_class, channels, noisy_states(LANES, model_class))


@eqx.filter_jit
def simulated(problem, parameters, starts):
    """In one program: residuals, cost, predictions, and the initial states at which a search starts."""
    arguments = parameters, starts
    outputs = problem.residuals(*arguments), problem.cost(*arguments), problem.predict(*arguments)
    return *outputs, problem.first_state()[0]


@pytest.mark.parametrize(("channels", "windows"), [("rates", 7), ("all", 1), ("all", 2)])
def test_windows_are_flights_of_their_own(windows, channels):
    problem = windowed(windows, channels)
    order, states = CASCADE_ORDER[: problem.size], np.asarray(problem.flight.states)
    alpha, starts = problem.model.alpha * 1.02, np.random.default_rng(0).normal(size=windows * problem.size) * 0.1
    whole, cost, predicted, first = simulated(problem, alpha, jnp.asarray(starts))
    expected = numpy_residuals(problem, alpha, starts)
    # Later samples of a long window have large residuals, with larger rounding errors.
    np.testing.assert_allclose(whole, expected.ravel(), rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    assert float(cost) == pytest.approx(0.5 * float(whole @ whole))
    np.testing.assert_array_equal(first, states[first_samples(problem)[:-1]][:, order].ravel())
    # The predictions follow the order of the flight's samples.
    weight = 1 / problem.sigma[order]
    np.testing.assert_allclose(whole, (weight * (states[:, order] - predicted)).ravel(), rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@every_case
def test_both_shooting_methods_find_the_same_answer_with_errors_at_the_bound(model_class, channels):
    """With all channels: `experiments/efficiency`."""
    ibss, output_error = (noisy(name, model_class, channels) for name in SHOOTING)
    assert np.abs((ibss.parameters - output_error.parameters) / ibss.std).max() < 0.05
    np.testing.assert_allclose(ibss.cost, output_error.cost, rtol=1e-4)
    np.testing.assert_allclose(ibss.std, output_error.std, rtol=1e-3)
    problem = windowed(WINDOWS, channels, model_class, states=noisy_states(1, model_class)[0])
    for found in (ibss, output_error):
        assert set(jaxos4.result_names(found.result)) == {"successful"}
        assert found.initial_state.shape == (LANES, WINDOWS * problem.size)
        errors = np.asarray((found.parameters - model_class().alpha) / found.std)
        assert np.all(np.abs(np.sqrt(np.square(errors).mean(axis=0)) - 1) < 4 / np.sqrt(2 * LANES))
        # The cost is that of the estimate.
        cost = problem.cost(found.parameters[0], found.initial_state[0])
        np.testing.assert_allclose(found.cost[0], cost, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHOOTING)
def test_a_window_without_measurements_changes_no_estimate(name):
    states = np.array(noisy_states(LANES, CORRECTED))
    states[:, 125:251] = np.nan  # the second window, and a sample of the third
    found = flown(name, CORRECTED, "rates", jnp.asarray(states))
    assert set(jaxos4.result_names(found.result)) == {"successful"}
    assert np.all(np.abs(found.parameters - CORRECTED().alpha) < 5 * found.std)
    assert np.isfinite(found.initial_state).all()


@pytest.mark.slow
def test_the_hybrid_runs_on_windows():
    problem, bracket = windowed(WINDOWS, "rates", CORRECTED), jaxos4.Bracket.default(CORRECTED())
    network = jaxos4.NetworkEstimator(width=32, depth=2, batch=64, steps=100, held_out=1000)
    network = network.fit(problem, bracket, key=jax.random.key(0))
    found, alone = (estimator(problem, bracket) for estimator in (jaxos4.Hybrid(network), jaxos4.OutputError()))
    assert str(jaxos4.result_names(found.result)) == "successful"
    assert np.abs((found.parameters - alone.parameters) / alone.std).max() < 0.1
    with pytest.raises(ValueError, match=f"trained for {WINDOWS} windows, not 1"):
        network(windowed(1, "rates", CORRECTED), bracket)


@pytest.mark.slow
def test_equation_error_is_the_same_whatever_the_windows():
    one, several = windowed(1, "rates"), windowed(4, "rates")
    bracket = jaxos4.Bracket.default(one.model)
    found, same = (jaxos4.EquationError()(problem, bracket) for problem in (one, several))
    np.testing.assert_allclose(found.parameters, same.parameters, rtol=1e-9)
