"""Huber's estimate by modified residuals, compared with an independent reference and tested with outliers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import noisy_states, standard_flight
from lanes import bound

import jaxos4
from jaxos4.analysis.huber import CUT
from jaxos4.models.state import CASCADE_ORDER

RATE_COLUMNS = CASCADE_ORDER[:3]


def problem_with(states, *, force=None, model=None, windows=1, **arguments):
    flight = jaxos4.Flight(standard_flight().time, standard_flight().omega, states, force)
    arguments = {"sigma": jaxos4.SENSOR_SIGMA, "channels": "rates", "windows": windows} | arguments
    return jaxos4.ShootingProblem(jaxos4.PublishedOS4() if model is None else model, flight, **arguments)


def spoiled(states, share=0.05, size=50.0, seed=0):
    """The states with a `share` of the rates increased by 50 standard deviations, and which of them."""
    rng = np.random.default_rng(seed)
    states = np.array(states)
    hit = rng.uniform(size=(states.shape[0], 3)) < share
    states[:, RATE_COLUMNS] += size * jaxos4.SENSOR_SIGMA[RATE_COLUMNS] * hit
    return states, hit


def iterate(problem, bracket, passes=40):
    found = jaxos4.IBSS()(problem, bracket)
    for _ in range(passes):
        used = jaxos4.winsorised(problem, found.parameters, found.initial_state)
        again = jaxos4.IBSS()(used.problem, bracket)
        moved = float((jnp.abs(again.parameters - found.parameters) / again.std).max())
        found = again
        if moved < 1e-5:
            break
    return found, used


def test_measurements_are_cut_as_written():
    states, _ = spoiled(noisy_states(1)[0])
    states[17, 7] = np.nan
    problem = problem_with(states, windows=4)
    start = problem.first_state()[0]
    used = jaxos4.winsorised(problem, problem.model.alpha, start)
    predicted = np.asarray(problem.predict(problem.model.alpha, start))
    measured = states[:, RATE_COLUMNS]
    errors = measured - predicted
    kept = total = 0
    for column in range(3):
        finite = np.isfinite(errors[:, column])
        scale = np.median(np.abs(errors[finite, column])) / 0.6745
        assert float(used.problem.sigma[RATE_COLUMNS[column]]) == pytest.approx(scale, rel=1e-10)
        for k in range(states.shape[0]):
            new = float(used.problem.flight.states[k, RATE_COLUMNS[column]])
            if not finite[k]:
                assert np.isnan(new)
                continue
            expected = predicted[k, column] + min(max(errors[k, column], -CUT * scale), CUT * scale)
            assert new == pytest.approx(expected, rel=1e-9, abs=1e-12)
            kept, total = kept + (abs(errors[k, column]) <= CUT * scale), total + 1
    assert float(used.share) == pytest.approx(kept / total, rel=1e-12)
    # Channels that are not compared do not change.
    others = np.setdiff1d(np.arange(12), RATE_COLUMNS)
    np.testing.assert_array_equal(used.problem.flight.states[:, others], problem.flight.states[:, others])
    np.testing.assert_array_equal(used.problem.sigma[others], problem.sigma[others])


def test_it_is_hubers_estimate_of_a_reference():
    """The reference is iteratively reweighted least squares: another algorithm for the same loss."""
    states, _ = spoiled(noisy_states(1)[0])
    problem = problem_with(states, initial_state=np.zeros(12))
    found, used = iterate(problem, jaxos4.Bracket.default(problem.model))
    alpha, scale = np.asarray(problem.model.alpha), np.asarray(used.problem.sigma[RATE_COLUMNS])
    predict = jax.jit(lambda a: problem.predict(a, jnp.zeros(3)))
    slope = jax.jit(jax.jacfwd(lambda a: problem.predict(a, jnp.zeros(3))))
    for _ in range(200):
        errors = (states[1:, RATE_COLUMNS] - np.asarray(predict(alpha))[1:]) / scale
        weight = np.minimum(1.0, CUT / np.maximum(np.abs(errors), 1e-12)).ravel()
        jacobian = (np.asarray(slope(alpha))[1:] / scale[:, None]).reshape(-1, 8)
        norm = np.linalg.norm(jacobian, axis=0)
        step = np.linalg.lstsq(
            np.sqrt(weight)[:, None] * jacobian / norm, np.sqrt(weight) * errors.ravel(), rcond=None
        )[0]
        alpha = alpha + step / norm
        if np.all(np.abs(step / norm) < 1e-6 * found.std):
            break
    else:
        pytest.fail("the reference did not converge")
    # Both have the same fixed point, because the scale comes from the median of the residuals there.
    assert np.all(np.abs(found.parameters - alpha) < 2e-2 * found.std)


def test_outliers_move_least_squares_and_not_this():
    """With 5 % outliers the errors are 1.12 bounds (Huber's asymptotic variance); allow four standard errors."""
    flights = 24
    clean = noisy_states(flights, seed=3)
    spoiled_states, hit = (np.stack(x) for x in zip(*(spoiled(clean[i], seed=i) for i in range(flights)), strict=True))
    base = problem_with(spoiled_states[0], initial_state=np.zeros(12))
    bracket, ibss = jaxos4.Bracket.default(base.model), jaxos4.IBSS()
    problems = [eqx.tree_at(lambda p: p.flight.states, base, jnp.asarray(states)) for states in spoiled_states]
    robust = plain = [ibss(problem, bracket) for problem in problems]
    for _ in range(5):
        fits = zip(problems, robust, strict=True)
        used = [jaxos4.winsorised(problem, found.parameters, found.initial_state) for problem, found in fits]
        robust = [ibss(u.problem, bracket) for u in used]
    share = np.array([u.share for u in used])
    # Outliers increase the median by 1.063, and 84.7 % of the noise is within 1.345 times that scale.
    assert np.all(np.abs(share - (1 - hit.reshape(flights, -1).mean(axis=1)) * 0.847) < 0.04)
    plain, robust = (np.stack([(f.parameters - base.model.alpha) / bound() for f in x]) for x in (plain, robust))
    plain, robust = (np.sqrt(np.square(x).mean()) for x in (plain, robust))
    assert plain > 6
    assert robust < 1.5


def test_without_outliers_it_keeps_its_efficiency():
    flights = 10
    clean, errors = noisy_states(flights, seed=5), []
    for i in range(flights):
        problem = problem_with(clean[i], initial_state=np.zeros(12))
        robust, used = iterate(problem, jaxos4.Bracket.default(problem.model), passes=3)
        errors.append(np.asarray(robust.parameters - problem.model.alpha) / bound())
        np.testing.assert_allclose(used.problem.sigma[RATE_COLUMNS], jaxos4.SENSOR_SIGMA[RATE_COLUMNS], rtol=0.25)
    # 95 % of the efficiency of least squares: errors of 1.026 bounds.
    rms = np.sqrt(np.square(errors).mean())
    assert abs(rms - 1.026) < 4 / np.sqrt(2 * 8 * flights)


def test_specific_force_is_cut_too_and_what_was_not_measured_keeps_its_sigma():
    model = jaxos4.FlightModel(terms=("accelerometer",))
    states = np.array(noisy_states(1)[0])
    states[:, 11] = np.nan
    force = np.full((states.shape[0], 3), np.nan)
    force[:, 2] = 9.81 + np.random.default_rng(0).normal(0, 0.1, states.shape[0])
    force[7, 2] = 500.0
    problem = problem_with(states, force=force, model=model, windows=2)
    used = jaxos4.winsorised(problem, model.alpha, problem.first_state()[0])
    assert float(used.problem.flight.specific_force[7, 2]) < 20
    assert float(used.problem.sigma[11]) == float(problem.sigma[11])
    assert np.isnan(used.problem.flight.states[:, 11]).all()
    assert np.isnan(used.problem.flight.specific_force[:, :2]).all()
    assert float(used.problem.sigma[14]) != float(problem.sigma[14])
