"""Diagnostics of residuals accept true models and detect wrong ones."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from helpers import measured, noisy_states, standard_flight, standard_problem
from lanes import LANES, identify, lanes

import jaxos4

LAGS = 25


def judged(states):
    """The diagnostics of a fit to each flight."""
    each = []
    for some in jnp.split(states, len(states) // LANES):
        problem, *arguments = lanes(some)
        found = identify(jaxos4.IBSS(), problem, *arguments)
        for flown, parameters, start in zip(some, found.parameters, found.initial_state, strict=True):
            flight = eqx.tree_at(lambda p: p.flight.states, problem, flown)
            each.append(jaxos4.residual_diagnostics(jaxos4.evaluate(flight, parameters, start)))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *each)


def coloured_states(noise):
    return measured(noise, standard_flight(), jax.random.split(jax.random.key(5), LANES))


def test_figures_are_those_of_plain_numpy():
    states = noisy_states(1)[0]
    problem = standard_problem(states=states, channels="attitude")
    alpha = problem.model.alpha * 1.01
    evaluation = jaxos4.evaluate(problem, alpha)
    found = jaxos4.residual_diagnostics(evaluation, fitted=False)
    order = [7, 9, 11, 6, 8, 10]
    y = np.asarray(states)[1:, order]
    x = np.asarray(problem.predict(alpha, problem.first_state()[0]))[1:]
    e, n = y - x, len(y)
    np.testing.assert_array_equal(found.count, n)
    np.testing.assert_allclose(found.rms, np.sqrt(np.mean(e**2, axis=0)))
    percent = 100 * (1 - np.linalg.norm(e, axis=0) / np.linalg.norm(y - y.mean(axis=0), axis=0))
    np.testing.assert_allclose(found.percent, percent, rtol=1e-9)
    level = np.square(e / jaxos4.SENSOR_SIGMA[order]).sum(axis=0)
    np.testing.assert_allclose(found.level, level / n, rtol=1e-12)
    # Eight parameters, fitted to six channels.
    freedom = 1 - 8 / (6 * n)
    np.testing.assert_allclose(jaxos4.residual_diagnostics(evaluation).level, level / n / freedom, rtol=1e-12)
    below = scipy.stats.chi2.cdf(level, n)
    np.testing.assert_allclose(found.level_p, 2 * np.minimum(below, 1 - below), rtol=1e-6, atol=1e-12)
    for i in range(6):
        r = np.array([e[k:, i] @ e[: n - k, i] for k in range(1, LAGS + 1)]) / (e[:, i] @ e[:, i])
        box = n * (n + 2) * np.sum(r**2 / (n - np.arange(1, LAGS + 1)))
        np.testing.assert_allclose(found.white_p[i], scipy.stats.chi2.sf(box, LAGS), rtol=1e-6, atol=1e-12)
        # Each lag as a mean over its own pairs.
        np.testing.assert_allclose(found.autocorrelation[i], r * n / (n - np.arange(1, LAGS + 1)), atol=1e-12)


@pytest.mark.slow
def test_true_models_pass_as_often_as_the_level_says():
    flights = 4 * LANES
    found = judged(noisy_states(flights, seed=21))
    # 256 flights of three channels: a Monte-Carlo error of 0.8 %. If the level had one tail, 10 % would fail.
    error = np.sqrt(0.05 * 0.95 / (3 * flights))
    for p in (found.white_p, found.level_p):
        assert abs(float((p < 0.05).mean()) - 0.05) < 4 * error
    assert scipy.stats.kstest(np.asarray(found.white_p[:, 0]), "uniform").pvalue > 1e-3
    assert abs(float(found.level.mean()) - 1) < 4 * np.sqrt(2 / (3 * 500 * flights))
    # Conservative, because the many tests are correlated.
    assert float((found.input_p < 0.05).mean()) < 0.05 + 4 * error


FIFTH = np.arange(501)[:, None] % 5 == 0
GAPS = {"7 of 10": np.random.default_rng(0).random((2 * LANES, 501, 12)) > 0.7, "4 of 5": FIFTH}


@pytest.mark.slow
@pytest.mark.parametrize("kept", GAPS.values(), ids=GAPS)
def test_missing_samples_do_not_look_like_colour(kept):
    """Also of every fifth sample, which leaves pairs at five of 25 lags.

    128 flights of three channels: a Monte-Carlo error of 1.1 %. If each lag had all its pairs, 99 % of the first would
    look coloured; if all lags counted, none of the second.
    """
    found = judged(jnp.where(kept, noisy_states(2 * LANES, seed=22), jnp.nan))
    assert abs(float((found.white_p < 0.05).mean()) - 0.05) < 4 * np.sqrt(0.05 * 0.95 / found.white_p.size)


@pytest.mark.slow
def test_coloured_noise_and_a_wrong_size_are_seen():
    found = judged(coloured_states(jaxos4.GaussMarkov(jaxos4.SENSOR_SIGMA, 0.05)))
    assert (found.white_p < 1e-6).all()
    np.testing.assert_allclose(found.autocorrelation[:, :, 0].mean(), np.exp(-0.01 / 0.05), atol=0.05)
    louder = judged(noisy_states(LANES, scale=1.3))
    assert (louder.level_p < 1e-4).all()
    np.testing.assert_allclose(louder.level.mean(), 1.69, rtol=0.03)
    slow = judged(jnp.where(FIFTH, coloured_states(jaxos4.GaussMarkov(jaxos4.SENSOR_SIGMA, 0.1)), jnp.nan))
    assert np.median(slow.white_p) < 1e-3
    # Five samples are half a correlation time. The fit explains some of the noise as motion.
    assert 0.3 < float(slow.colour.mean()) < np.exp(-0.5)


def test_an_effect_of_the_input_that_the_model_lacks_is_detected_in_its_channel():
    """The roll torque acts three samples late, on the roll rate only."""
    flight, model = standard_flight(), jaxos4.PublishedOS4()
    late = jnp.asarray(np.roll(np.asarray(flight.states[:, 7]), 3)).at[:3].set(0.0)
    states = flight.states.at[:, 7].set(late)
    noise = jaxos4.SENSOR_SIGMA * jax.random.normal(jax.random.key(1), states.shape)
    problem = standard_problem(states=states + noise, channels="rates")
    found = jaxos4.IBSS()(problem, jaxos4.Bracket.default(model))
    judgement = jaxos4.residual_diagnostics(jaxos4.evaluate(problem, found.parameters, found.initial_state))
    assert judgement.input_p[0] < 1e-6
    assert jnp.abs(judgement.input_correlation[0]).argmax() == 0
    assert judgement.input_p[2] > 1e-3


def test_no_alarm_without_measurements_or_motion_or_with_rounding_errors_or_after_divergence():
    problem = standard_problem(channels="attitude")
    alpha = problem.model.alpha
    exact = jaxos4.residual_diagnostics(jaxos4.evaluate(problem, alpha))
    assert (exact.white_p == 1).all()
    assert (exact.input_p == 1).all()
    unmeasured = eqx.tree_at(lambda p: p.flight.states, problem, problem.flight.states.at[:, 6].set(jnp.nan))
    found = jaxos4.residual_diagnostics(jaxos4.evaluate(unmeasured, alpha))
    assert found.count.tolist() == [500, 500, 500, 0, 500, 500]
    diverged = jaxos4.residual_diagnostics(jaxos4.evaluate(problem, alpha.at[2].set(1e9)))
    assert (bool(exact.feasible), bool(diverged.feasible)) == (True, False)
    assert (diverged.count == 0).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((found, diverged)))
    # A channel that stands still, and rotors that do.
    omega = jnp.broadcast_to(jnp.array([220.0, 226.0, 221.0, 227.0]), (501, 4))
    flight = jaxos4.simulate(problem.model, alpha, omega, dt=0.01)
    noise = 0.2 * jaxos4.SENSOR_SIGMA * jax.random.normal(jax.random.key(2), flight.states.shape)
    still = eqx.tree_at(lambda f: f.states, flight, (flight.states + noise).at[:, 11].set(0.1))
    known = {"sigma": jaxos4.SENSOR_SIGMA, "initial_state": flight.states[0], "channels": "rates"}
    found = jaxos4.residual_diagnostics(jaxos4.evaluate(jaxos4.ShootingProblem(problem.model, still, **known), alpha))
    assert (found.input_correlation == 0).all()
    assert (found.input_p == 1).all()
    assert found.percent[2] == 0
    # Windows have no verdict on whiteness.
    known = {"sigma": jaxos4.SENSOR_SIGMA, "channels": "rates", "windows": 20}
    noisy = eqx.tree_at(lambda f: f.states, problem.flight, noisy_states(1)[0])
    windowed = jaxos4.ShootingProblem(problem.model, noisy, **known)
    found = jaxos4.OutputError()(windowed, jaxos4.Bracket.default(problem.model))
    judgement = jaxos4.residual_diagnostics(jaxos4.evaluate(windowed, found.parameters, found.initial_state))
    assert (judgement.white_p == 1).all()
    np.testing.assert_allclose(judgement.level, 1, atol=5 * np.sqrt(2 / 430))
