"""Equation error, in batch and recursive: against plain NumPy, with noise, with gaps, and when things go wrong."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DT, OS4, noisy_states, standard_flight, standard_problem
from lanes import HALF, bound, errors, lost, names

import jaxos4
from jaxos4.estimators.equation_error import EquationError, RecursiveLeastSquares, normal_equations

PUBLISHED, CORRECTED = jaxos4.PublishedOS4, jaxos4.CorrectedOS4
KINDS = EquationError, RecursiveLeastSquares
RATES = np.array([jaxos4.STATE_NAMES.index(name) for name in "pqr"])


def bracket_of(model_class, offset=0.5):
    """A bracket around the truth, its center off by `offset` half-widths."""
    return jaxos4.Bracket.around(model_class().alpha + offset * HALF, HALF)


# The same regression, written from the printed equations.


def equations(rates, omega, *, corrected=False):
    """Regressors of p', q' and r' and the columns of alpha that they belong to."""
    p, q, r = rates.T
    w1, w2, w3, w4 = np.asarray(omega).T
    roll = OS4["L"] * OS4["b"] * (w4**2 - w2**2)
    pitch = OS4["L"] * OS4["b"] * (w3**2 - w1**2)
    yaw = OS4["d"] * (w4**2 + w2**2 - w3**2 - w1**2)
    speed = w1 + w3 - w2 - w4
    second, fifth = (-speed * q, speed * p) if corrected else (-q, r)
    return [
        (np.stack([q * r, second, roll], axis=1), slice(0, 3)),
        (np.stack([p * r, fifth, pitch], axis=1), slice(3, 6)),
        (np.stack([p * q, yaw], axis=1), slice(6, 8)),
    ]


def reference(states, omega, form, *, forgetting=1.0, corrected=False):
    """Least squares of plain differences, or of integrals with a known (0) or a free start."""
    rates, alpha = np.asarray(states)[:, RATES], np.zeros(8)
    if form == "known":
        rates = np.concatenate([np.zeros((1, 3)), rates[1:]])
    for (regressors, columns), output in zip(equations(rates, omega, corrected=corrected), rates.T, strict=True):
        weight = np.sqrt(forgetting ** np.arange(len(output))[::-1])
        if form == "differences":
            matrix, right = DT * regressors[:-1], np.diff(output)
        else:
            matrix = np.concatenate([np.zeros_like(regressors[:1]), np.cumsum(DT * regressors[:-1], axis=0)])
            if form == "free":
                matrix = np.column_stack([matrix, np.ones(len(matrix))])
            matrix, right = weight[:, None] * matrix, weight * output
        scale = np.linalg.norm(matrix, axis=0)
        alpha[columns] = (np.linalg.lstsq(matrix / scale, right, rcond=None)[0] / scale)[: regressors.shape[1]]
    return alpha


@pytest.mark.parametrize(
    ("estimator", "model_class", "form", "forgetting"),
    [
        *((EquationError(), *case, 1.0) for case in ((PUBLISHED, "known"), (PUBLISHED, "free"), (CORRECTED, "free"))),
        *((EquationError(memory=0.0), model_class, "differences", 1.0) for model_class in (PUBLISHED, CORRECTED)),
        (RecursiveLeastSquares(forgetting=0.99), PUBLISHED, "free", 0.99),
    ],
)
def test_equals_least_squares_in_numpy(estimator, model_class, form, forgetting):
    states = noisy_states(1, model_class)[0]
    problem = standard_problem(model_class, "rates", free=form != "known", states=states)
    estimate, omega = estimator(problem, bracket_of(model_class)), np.asarray(problem.flight.omega)
    late = np.concatenate([omega[:1], omega[:-1]])  # a reference that is wrong by a sample fails
    for given, equal in ((omega, True), (late, False)):
        expected = reference(states, given, form, forgetting=forgetting, corrected=model_class is CORRECTED)
        off = np.abs((estimate.parameters - expected) / estimate.std).max()
        assert off < 1e-9 if equal else off > 1


# Without noise.


def test_the_trapezoidal_rule_is_for_flights_that_were_not_flown_by_eulers():
    """Truth in continuous time: a fifth of the bound at most, where Euler's rule is off by half of it."""
    model = PUBLISHED()
    flight = jaxos4.simulate(model, model.alpha, standard_flight().omega, dt=DT, method="rk4")
    off = {}
    for method in ("euler", "rk4"):
        problem = jaxos4.ShootingProblem(
            model, flight, sigma=jaxos4.SENSOR_SIGMA, initial_state=flight.states[0], channels="rates", method=method
        )
        off[method] = np.abs(errors(EquationError()(problem, bracket_of(PUBLISHED))) / bound()).max()
    assert off["rk4"] < 0.2 < 0.4 < off["euler"]


# Recursion.


@pytest.mark.parametrize(("free", "memory"), [(False, 0.99), (True, 0.0), (True, 1.0)])
def test_without_forgetting_it_is_the_batch(free, memory):
    states = noisy_states(1, seed=3)[0]
    problem = standard_problem(channels="rates", free=free, states=states.at[100:120].set(jnp.nan))
    batch, recursive = (kind(memory=memory)(problem, bracket_of(PUBLISHED)) for kind in KINDS)
    np.testing.assert_allclose(recursive.parameters, batch.parameters, rtol=1e-9)
    np.testing.assert_allclose(recursive.covariance, batch.covariance, rtol=1e-9, atol=1e-9 * HALF.min() ** 2)
    np.testing.assert_allclose(recursive.cost, batch.cost, rtol=1e-9)


def test_history_is_the_estimate_of_every_shorter_flight():
    states, bracket = noisy_states(1, seed=4)[0], bracket_of(PUBLISHED)
    shorter = jnp.asarray(np.where(np.arange(501)[:, None] <= 200, states, np.nan))
    estimate, half_way = (
        RecursiveLeastSquares(forgetting=0.99)(standard_problem(channels="rates", free=True, states=s), bracket)
        for s in (states, shorter)
    )
    assert estimate.history.shape == (501, 8)
    for row, expected in ((-1, estimate.parameters), (0, bracket.center), (200, half_way.parameters)):
        np.testing.assert_allclose(estimate.history[row], expected, rtol=1e-9)


def test_forgetting_follows_parameters_that_jump():
    model, omega = PUBLISHED(), standard_flight().omega
    before, after = model.alpha, model.alpha + 0.4 * HALF
    first = jaxos4.simulate(model, before, omega[:251], dt=DT)
    second = jaxos4.simulate(model, after, omega[250:], dt=DT, initial_state=first.states[-1])
    states = jnp.concatenate([first.states[:-1], second.states])
    problem, bracket = standard_problem(channels="rates", free=True, states=states), bracket_of(PUBLISHED, 0.2)
    follows, stays = (RecursiveLeastSquares(forgetting=share)(problem, bracket) for share in (0.9, 1.0))
    assert np.abs((follows.history[250] - before) / HALF).max() < 1e-6
    assert np.abs((follows.parameters - after) / HALF).max() < 1e-6
    assert np.abs((stays.parameters - after) / HALF).max() > 0.1


# Gaps.


def estimated(states, **settings):
    problem = standard_problem(channels="rates", free=True, states=jnp.asarray(states))
    return EquationError(**settings)(problem, bracket_of(PUBLISHED))


@pytest.mark.parametrize("memory", [0.0, 1.0])
def test_samples_that_are_missing_have_no_weight(memory):
    """Without noise and without bridges, the remaining samples still give the truth."""
    states = np.array(standard_flight().states)
    states[[7, 90, 91, 92, 200, 499, *range(300, 340)]] = np.nan
    estimate = estimated(states, memory=memory, bridge=0)
    np.testing.assert_allclose(estimate.parameters, PUBLISHED().alpha, rtol=1e-9, atol=1e-12)
    assert names(estimate) == "successful"


def test_a_gap_in_one_rate_leaves_the_equations_without_it_alone_and_one_that_is_not_bridged_costs_more():
    """The regressors of p' do not contain p: during a gap in p they are still integrated."""
    estimate = estimated(standard_flight().states.at[100:400, RATES[0]].set(jnp.nan))
    np.testing.assert_allclose(estimate.parameters[:3], PUBLISHED().alpha[:3], rtol=1e-9, atol=1e-12)
    growth = np.asarray(estimate.std) / bound(PUBLISHED, free=True)
    assert growth[2] < growth[5]
    bridged, split = (estimated(lost(noisy_states(1, seed=7)[0]), bridge=bridge) for bridge in (4, 0))
    assert (split.std > 5 * bridged.std).all()


@pytest.mark.parametrize("columns", [20, 200])
def test_normal_equations_of_pooled_logs_fit_into_memory(columns):
    """The products of 200 columns and 60,000 rows would take 19 GB."""
    rows = np.random.default_rng(0).normal(size=(20_000, 3, columns + 1))
    information, moment = jax.jit(normal_equations)(rows)
    flat = rows.reshape(-1, columns + 1)
    np.testing.assert_allclose(information, flat[:, :-1].T @ flat[:, :-1], rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(moment, flat[:, :-1].T @ flat[:, -1], rtol=1e-9, atol=1e-6)
