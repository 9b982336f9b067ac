"""Multiple shooting: the windows, the estimators, and a drift that one shot cannot follow."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DT, noisy_states, random_starts, standard_flight

import jaxos4
from jaxos4.models.state import CASCADE_ORDER

MODELS = (jaxos4.PublishedOS4, jaxos4.CorrectedOS4)
SHOOTING = (jaxos4.IBSS(), jaxos4.OutputError())


def windowed(windows, channels="all", model_class=jaxos4.PublishedOS4, *, states=None, duration=5.0):
    flight = standard_flight(model_class, duration)
    states = noisy_states(1, model_class, duration=duration)[0] if states is None else states
    flight = eqx.tree_at(lambda f: f.states, flight, states)
    model = model_class(jaxos4.OS4)
    return jaxos4.ShootingProblem(model, flight, sigma=jaxos4.SENSOR_SIGMA, channels=channels, windows=windows)


def parts(problem):
    """Each window as a flight and a problem of its own, cut by hand."""
    samples, flight = problem.flight.states.shape[0], problem.flight
    ends = [k * samples // problem.windows for k in range(problem.windows + 1)]
    return [
        jaxos4.ShootingProblem(
            problem.model,
            jaxos4.Flight(flight.time[a:b], flight.omega[a:b], flight.states[a:b]),
            sigma=problem.sigma,
            channels=problem.channels,
            method=problem.method,
        )
        for a, b in zip(ends[:-1], ends[1:], strict=True)
    ]


@pytest.mark.parametrize("windows", [1, 2, 7])
@pytest.mark.parametrize("channels", ["rates", "all"])
def test_windows_are_flights_of_their_own(windows, channels):
    problem = windowed(windows, channels)
    alpha = problem.model.alpha * 1.02
    starts = np.random.default_rng(0).normal(size=(windows, problem.size)) * 0.1
    whole = problem.residuals(alpha, jnp.asarray(starts.ravel()))
    each = [part.residuals(alpha, jnp.asarray(start)) for part, start in zip(parts(problem), starts, strict=True)]
    np.testing.assert_allclose(whole, np.concatenate(each), rtol=1e-12, atol=1e-12)
    assert float(problem.cost(alpha, jnp.asarray(starts.ravel()))) == pytest.approx(0.5 * float(whole @ whole))
    first = np.concatenate([part.first_state()[0] for part in parts(problem)])
    np.testing.assert_array_equal(problem.first_state()[0], first)
    # The predictions follow the order of the flight's samples.
    predicted = np.asarray(problem.predict(alpha, jnp.asarray(starts.ravel())))
    measured = np.asarray(problem.flight.states)[:, CASCADE_ORDER[: problem.size]]
    weight = 1 / problem.sigma[CASCADE_ORDER[: problem.size]]
    np.testing.assert_allclose(whole, (weight * (measured - predicted)).ravel(), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("model_class", MODELS)
@pytest.mark.parametrize("channels", ["rates", "attitude"])
def test_the_bound_counts_all_initial_states_as_unknowns(model_class, channels):
    problem = windowed(5, channels, model_class)
    alpha, starts = problem.model.alpha, problem.first_state()[0]
    jacobian = np.asarray(jax.jacfwd(lambda u: problem.residuals(u[:8], u[8:]))(jnp.concatenate([alpha, starts])))
    scale = np.linalg.norm(jacobian, axis=0)
    inverse = np.linalg.inv((jacobian / scale).T @ (jacobian / scale)) / np.outer(scale, scale)
    bound = jaxos4.cramer_rao_bound(problem, alpha, starts)
    std = np.sqrt(np.diagonal(inverse))[:8]
    np.testing.assert_allclose(bound / np.outer(std, std), inverse[:8, :8] / np.outer(std, std), atol=1e-8)
    # Windows are not tied together, which loses information.
    whole = jaxos4.cramer_rao_bound(windowed(1, channels, model_class), alpha)
    assert np.all(np.diagonal(bound) > np.diagonal(whole))


@pytest.mark.parametrize("estimator", SHOOTING)
@pytest.mark.parametrize(("model_class", "channels"), [(jaxos4.PublishedOS4, "all"), (jaxos4.CorrectedOS4, "rates")])
def test_errors_reach_the_bound(estimator, model_class, channels):
    flights, windows = 48, 4

    @eqx.filter_jit
    @eqx.filter_vmap
    def identify(states, start):
        problem = windowed(windows, channels, model_class, states=states)
        bracket = jaxos4.Bracket.around(start, problem.model.half_width)
        return estimator(problem, bracket)

    starts = random_starts(model_class(), flights, share=0.5)
    found = identify(noisy_states(flights, model_class), starts)
    assert set(jaxos4.result_names(found.result)) == {"successful"}
    assert found.initial_state.shape == (flights, windows * (12 if channels == "all" else 3))
    errors = (found.parameters - model_class().alpha) / found.std
    assert np.all(np.abs(np.sqrt(np.square(errors).mean(axis=0)) - 1) < 4 / np.sqrt(2 * flights))


def test_both_shooting_methods_find_the_same_answer():
    problem = windowed(6, "attitude")
    bracket = jaxos4.Bracket.around(random_starts(problem.model, 1)[0], problem.model.half_width)
    ibss, output_error = (estimator(problem, bracket) for estimator in SHOOTING)
    assert np.abs((ibss.parameters - output_error.parameters) / ibss.std).max() < 0.05
    np.testing.assert_allclose(ibss.cost, output_error.cost, rtol=1e-4)
    np.testing.assert_allclose(ibss.std, output_error.std, rtol=1e-3)


def test_a_window_without_measurements_changes_no_estimate():
    whole = windowed(5, "rates")
    gap = eqx.tree_at(lambda p: p.flight.states, whole, whole.flight.states.at[100:201].set(jnp.nan))
    bracket = jaxos4.Bracket.default(whole.model)
    for estimator in SHOOTING:
        found = estimator(gap, bracket)
        assert str(jaxos4.result_names(found.result)) == "successful"
        assert np.all(np.abs(found.parameters - whole.model.alpha) < 5 * found.std)
        assert np.isfinite(found.initial_state).all()


def test_the_hybrid_runs_on_windows():
    problem = windowed(3, "rates")
    bracket = jaxos4.Bracket.default(problem.model)
    network = jaxos4.NetworkEstimator(steps=300).fit(problem, bracket, key=jax.random.key(0))
    found = jaxos4.Hybrid(network)(problem, bracket)
    alone = jaxos4.IBSS()(problem, bracket)
    assert str(jaxos4.result_names(found.result)) == "successful"
    assert np.abs((found.parameters - alone.parameters) / alone.std).max() < 0.1
    with pytest.raises(ValueError, match="trained for 3 windows, not 1"):
        network(windowed(1, "rates"), bracket)


def drifting_states(duration):
    """A flight whose rotors turn up to 0.1 % faster or slower than recorded, so that simulated rates drift away."""
    model = jaxos4.PublishedOS4(jaxos4.OS4)
    recorded = standard_flight(duration=duration).omega
    actual = recorded * (1 + 1e-3 * jnp.array([1.0, -0.5, 0.3, 0.8]))
    truth = jaxos4.simulate(model, model.alpha, actual, dt=DT)
    return jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(truth, key=jax.random.key(0)).states


def test_windows_follow_a_drift_that_one_shot_cannot():
    states = drifting_states(20.0)
    errors, results = [], []
    for windows in (1, 20):
        problem = windowed(windows, "rates", states=states, duration=20.0)
        found = jaxos4.IBSS()(problem, jaxos4.Bracket.default(problem.model))
        errors.append(np.abs(found.parameters / problem.model.alpha - 1)[np.array([2, 5, 7])])
        results.append(str(jaxos4.result_names(found.result)))
    assert np.isfinite(errors).all()
    # One shot ends at the bounds, and its result says so.
    assert results == ["at_bound", "successful"]
    assert np.all(errors[1] < 0.02)
    assert errors[0].max() > 3 * errors[1].max()


def test_robust_covariance_of_windows_is_the_bound_under_white_noise():
    problem = windowed(5, "rates", duration=20.0)
    found = jaxos4.IBSS()(problem, jaxos4.Bracket.default(problem.model))
    robust = jaxos4.robust_covariance(problem, found.parameters, found.initial_state)
    ratio = np.sqrt(np.diagonal(robust)) / found.std
    assert np.all((ratio > 0.7) & (ratio < 1.3))


@pytest.mark.parametrize("windows", [0, -1, 251])
def test_impossible_windows_are_named(windows):
    with pytest.raises(ValueError, match="`windows` must be an integer from 1 to 250"):
        windowed(windows)


def test_windows_are_refused_with_a_known_start_and_by_estimators_that_do_not_shoot():
    flight = standard_flight()
    with pytest.raises(ValueError, match="`initial_state` must be `None` if there are several windows"):
        jaxos4.ShootingProblem(
            jaxos4.PublishedOS4(), flight, sigma=jaxos4.SENSOR_SIGMA, initial_state=flight.states[0], windows=2
        )
    problem = windowed(2, "rates")
    for estimator in (jaxos4.RecursiveLeastSquares(), jaxos4.SVSF(), jaxos4.JointEKF()):
        with pytest.raises(ValueError, match="`problem.windows` must be 1"):
            estimator(problem, jaxos4.Bracket.default(problem.model))


def test_equation_error_is_the_same_whatever_the_windows():
    one, several = windowed(1, "rates"), windowed(4, "rates")
    bracket = jaxos4.Bracket.default(one.model)
    found, same = (jaxos4.EquationError()(problem, bracket) for problem in (one, several))
    np.testing.assert_allclose(found.parameters, same.parameters, rtol=1e-9)


def test_the_cost_of_an_estimate_is_that_of_its_parameters():
    """A doublet does not identify all parameters, and the bracket is not centred on the truth."""
    model = jaxos4.PublishedOS4()
    flight = jaxos4.simulate(model, model.alpha, jaxos4.doublet(jaxos4.OS4, duration=5.0, dt=DT), dt=DT)
    noisy = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(flight, key=jax.random.key(0))
    problem = jaxos4.ShootingProblem(model, noisy, sigma=jaxos4.SENSOR_SIGMA, channels="rates")
    bracket = jaxos4.Bracket.around(model.alpha + 0.4 * model.half_width, model.half_width)
    for estimator in (*SHOOTING, jaxos4.EquationError(), jaxos4.RecursiveLeastSquares(), jaxos4.SVSF()):
        found = estimator(problem, bracket)
        assert str(jaxos4.result_names(found.result)) == "unidentifiable"
        cost = problem.cost(found.parameters, found.initial_state)
        np.testing.assert_allclose(found.cost, cost, rtol=1e-9)
