"""The joint extended Kalman filter and the smooth variable structure filter. Their errors: `test_errors.py`."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DT, REFERENCES, noisy_states, published_derivative, random_starts, standard_problem
from lanes import HALF, LANES, bound, errors, identify, lanes, lost, names, noisy

import jaxos4
from jaxos4.estimators import SVSF, JointEKF

PUBLISHED, CORRECTED = jaxos4.PublishedOS4, jaxos4.CorrectedOS4
ORDER = np.array([7, 9, 11, 6, 8, 10, 0, 1, 2, 3, 4, 5])  # p, q, r, phi, theta, psi, x, vx, ...


@pytest.mark.slow
def test_one_pass_is_not_enough_beyond_the_rates():
    """Why there are passes: the plain filter keeps the errors of its first linearisations, and does not know it."""
    case = CORRECTED, "all", False
    kinds = (functools.partial(JointEKF, passes=1), functools.partial(JointEKF, passes=2), JointEKF)
    (plain, few, enough), unit = (noisy(kind, *case) for kind in kinds), bound(*case)
    assert set(names(plain)) == {"successful"}
    assert (np.sqrt(np.mean((errors(plain, CORRECTED) / unit) ** 2, axis=0)) > 1.5).all()
    assert (np.asarray(enough.sweeps) > 2).all()
    assert "max_sweeps" in names(few)  # too few passes are reported
    close = np.abs(errors(few, CORRECTED) / unit).max(axis=1) < 6
    assert close[names(few) == "successful"].all()


@pytest.mark.parametrize(("model_class", "channels", "free"), [(PUBLISHED, "rates", True), (CORRECTED, "all", False)])
def test_history_ends_at_the_answer(model_class, channels, free):
    estimates = noisy(JointEKF, model_class, channels, free)
    np.testing.assert_array_equal(estimates.rollouts, (8 + 3 * free + 1) * estimates.sweeps + 1)
    history = np.asarray(estimates.history)
    assert history.shape == (LANES, 501, 8)
    np.testing.assert_array_equal(history[:, -1], estimates.parameters)
    # The error shrinks on the way.
    off = np.sqrt(np.mean(((history - np.asarray(model_class().alpha)) / HALF) ** 2, axis=(0, 2)))
    assert off[-1] < off[250] < off[60] < off[0]
    if free:  # the start is known better than from its one measurement, with all the flight behind it
        assert (np.sqrt(np.square(estimates.initial_state).mean(axis=0)) < 0.5 * jaxos4.SENSOR_SIGMA[ORDER[:3]]).all()


# Against other ways to the same numbers.


def textbook(states, omega, center, half, sigma, *, start, free, derivative):
    """The filter as a textbook has it: matrix gains, Jacobians by central differences, all channels at once.

    The initial state's prior is three sigma around its measurement where it is free.
    """
    size, count = len(sigma), 8

    def step(z, row):
        full = np.zeros(12)
        full[ORDER[:size]] = z[:size]
        return np.concatenate([(full + DT * derivative(full, row, z[size:]))[ORDER[:size]], z[size:]])

    z = np.concatenate([states[0] if free else start, center])
    p = np.diag(np.concatenate([(3 * sigma if free else 0 * sigma) ** 2, half**2]))
    h = np.eye(size, size + count)
    history = []
    for k, y in enumerate(states):
        if k > 0 or free:
            seen = ~np.isnan(y)
            hs = h[seen]
            gain = p @ hs.T @ np.linalg.inv(hs @ p @ hs.T + np.diag(sigma[seen] ** 2))
            z = z + gain @ (y[seen] - hs @ z)
            p = (np.eye(size + count) - gain @ hs) @ p
        history.append(z[size:])
        scale = np.concatenate([np.ones(size), half]) * 1e-4
        f = np.stack([(step(z + d, omega[k]) - step(z - d, omega[k])) / (2 * d.sum()) for d in np.diag(scale)], axis=1)
        z, p = step(z, omega[k]), f @ p @ f.T
    return np.stack(history), p[size:, size:]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model_class", "channels", "free"),
    [(PUBLISHED, "rates", False), (PUBLISHED, "rates", True), (CORRECTED, "all", False)],
)
def test_agrees_with_the_textbook_filter(model_class, channels, free):
    states = np.array(noisy_states(1, model_class, seed=3, duration=1.0)[0])
    problem = standard_problem(model_class, channels, free=free, duration=1.0)
    order = ORDER[: problem.size]
    states[30:40, order[1]] = np.nan
    states[50, order] = np.nan
    center = np.asarray(random_starts(model_class(), 1, seed=4)[0])
    problem = eqx.tree_at(lambda p: p.flight.states, problem, jnp.asarray(states))
    estimate = JointEKF(passes=1)(problem, jaxos4.Bracket.around(center, HALF))
    arguments = (states[:, order], np.asarray(problem.flight.omega), center, HALF, jaxos4.SENSOR_SIGMA[order])
    settings = {"start": np.zeros(problem.size), "free": free, "derivative": REFERENCES[model_class]}
    history, covariance = textbook(*arguments, **settings)
    std = np.sqrt(np.diagonal(covariance))
    assert estimate.history is not None
    np.testing.assert_allclose(estimate.history / HALF, history / HALF, atol=1e-6)
    np.testing.assert_allclose(estimate.covariance / np.outer(std, std), covariance / np.outer(std, std), atol=1e-6)
    # The comparison can fail: a model with one wrong term, a sigma that is a hundredth off.
    other = REFERENCES[CORRECTED if model_class is PUBLISHED else PUBLISHED]
    for wrong in (
        textbook(*arguments, **{**settings, "derivative": other}),
        textbook(*arguments[:-1], 1.01 * arguments[-1], **settings),
    ):
        assert np.abs(estimate.history / HALF - wrong[0] / HALF).max() > 1e-4


@pytest.mark.slow
def test_agrees_with_shooting():
    """The prior aside, which a wide bracket makes weak, both have the same optimum."""
    problem, states, omega, lower, upper = lanes(noisy_states(LANES, seed=50))
    middle = (lower + upper) / 2
    wide = identify(JointEKF(), problem, states, omega, middle - 5 * HALF, middle + 5 * HALF)
    shot = identify(jaxos4.IBSS(tolerance=1e-4), problem, states, omega, lower, upper)
    assert np.abs((wide.parameters - shot.parameters) / shot.std).max() < 0.02
    np.testing.assert_allclose(wide.std, shot.std, rtol=0.02)
    np.testing.assert_allclose(wide.cost, shot.cost, rtol=1e-5)


RATES = [7, 9, 11]


@pytest.mark.slow
def test_history_is_what_was_averaged_and_other_channels_do_not_matter():
    estimates = noisy(SVSF)
    history = np.asarray(estimates.history)
    assert history.shape == (LANES, 501, 8)
    late = np.arange(501) >= 0.5 * 501
    np.testing.assert_allclose(history[:, late].mean(axis=1), estimates.parameters, rtol=1e-9, atol=1e-12)
    assert (np.asarray(estimates.rollouts) == 4 * 12 + 1).all()
    _, states, _, lower, upper = lanes(noisy_states(LANES, seed=50))
    alone = SVSF()(standard_problem(channels="all", states=states[1]), jaxos4.Bracket(lower[1], upper[1]))
    assert (np.abs(alone.parameters - estimates.parameters[1]) / bound()).max() < 1e-6
    np.testing.assert_allclose(alone.covariance, estimates.covariance[1], rtol=1e-5, atol=1e-15)
    assert alone.initial_state.shape == (12,)


@pytest.mark.slow
@pytest.mark.parametrize(("free", "covered"), [(True, 0.95 - 4 * np.sqrt(0.95 * 0.05 / LANES)), (False, 0.87)])
def test_a_free_start_or_missing_samples_only_cost_precision(free, covered):
    states = noisy_states(LANES, seed=50) if free else lost(noisy_states(LANES, seed=7))
    estimates = identify(SVSF(), *lanes(states, free=free))
    assert (names(estimates) == "successful").mean() > (0.99 if free else 0.9)
    error = errors(estimates)
    assert np.sqrt(np.mean((error / bound(free=free)) ** 2, axis=0)).max() < (6 if free else 5)
    assert np.mean(np.abs(error) < 1.96 * np.asarray(estimates.std)) > covered
    if free:  # the flights begin at rest: what is not 0 is error
        first = np.asarray(states[:, 0, RATES])
        assert np.sqrt(np.mean(np.square(estimates.initial_state))) < 0.8 * np.sqrt(np.mean(first**2))


# The corrections themselves.


def plain(states, omega, center, *, rates_layer, parameter_layer, damping, equilibration):
    """One pass in plain NumPy from the printed equations, with derivatives by finite differences."""
    sigma = jaxos4.SENSOR_SIGMA[RATES]

    def step(x, u, row):
        full = np.zeros(12)
        full[RATES] = x
        return x + DT * published_derivative(full, row, center + u * HALF)[RATES]

    x, u, phi, energy, history = np.zeros(3), np.zeros(8), np.zeros((3, 8)), np.zeros(8), []
    for k, y in enumerate(states):
        seen = ~np.isnan(y) & (k > 0)
        e = np.where(seen, y - x, 0.0)
        energy = energy + (np.where(seen[:, None], phi, 0) ** 2).sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            unit = np.where(energy > 0, np.minimum(np.sqrt(energy.max() / energy), equilibration), equilibration)
        scaled = np.where(seen[:, None], phi * unit, 0)
        damped = damping**2 * (energy.max() / (k + 1) if energy.max() > 0 else 1.0)
        inverse = scaled.T @ np.linalg.inv(scaled @ scaled.T + damped * np.eye(3))
        w = inverse @ e
        layer = parameter_layer * np.sqrt((inverse**2) @ sigma**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            sat = np.where(layer > 0, np.clip(w / layer, -1, 1), 0)
        gain = np.minimum(np.abs(e) / (rates_layer * sigma), 1)
        x = x + gain * e
        u = np.clip(u + unit * np.abs(w) * sat, -4, 4)
        history.append(center + u * HALF)
        by_x = np.stack([(step(x + d, u, omega[k]) - step(x - d, u, omega[k])) / 2 for d in np.eye(3)], axis=1)
        by_u = np.stack([(step(x, u + d, omega[k]) - step(x, u - d, omega[k])) / 2 for d in np.eye(8)], axis=1)
        phi = by_u + by_x @ ((1 - gain)[:, None] * phi)
        x = step(x, u, omega[k])
    return np.stack(history)


@pytest.mark.slow
def test_agrees_with_plain_numpy():
    states = np.array(noisy_states(1, seed=3, duration=1.0)[0])
    states[30:40, RATES[1]] = np.nan
    states[50] = np.nan
    center = np.asarray(random_starts(PUBLISHED(), 1, seed=4)[0])
    problem = standard_problem(channels="rates", duration=1.0, states=jnp.asarray(states))
    # Narrow layers, so that corrections leave them too.
    settings = {"rates_layer": 2.0, "parameter_layer": 2.0, "damping": 8.0, "equilibration": 20.0}
    history = SVSF(**settings, passes=1)(problem, jaxos4.Bracket.around(center, HALF)).history
    assert history is not None
    expected = plain(states[:, RATES], np.asarray(problem.flight.omega), center, **settings)
    np.testing.assert_allclose(history / HALF, expected / HALF, atol=1e-9)
    assert np.abs((expected[-1] - center) / HALF).max() > 0.05
    # The comparison can fail.
    for name, value in settings.items():
        other = plain(states[:, RATES], np.asarray(problem.flight.omega), center, **{**settings, name: 1.1 * value})
        assert np.abs(other / HALF - history / HALF).max() > 1e-6, name
