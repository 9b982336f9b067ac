"""The smooth variable structure filter: its corrections and its history. Its errors: `test_errors.py`."""

import functools

import jax.numpy as jnp
import numpy as np
from helpers import DT, noisy_states, published_derivative, random_starts, standard_problem
from lanes import HALF, LANES, bound, errors, identify, lanes, lost, names

import jaxos4
from jaxos4.estimators.svsf import SVSF

PUBLISHED = jaxos4.PublishedOS4
RATES = [7, 9, 11]


@functools.cache
def noisy():
    return identify(SVSF(), *lanes(noisy_states(LANES, seed=50)))


def test_history_is_what_was_averaged():
    estimates = noisy()
    history = np.asarray(estimates.history)
    assert history.shape == (LANES, 501, 8)
    late = np.arange(501) >= 0.5 * 501
    np.testing.assert_allclose(history[:, late].mean(axis=1), estimates.parameters, rtol=1e-9, atol=1e-12)
    assert (np.asarray(estimates.rollouts) == 4 * 12 + 1).all()


def test_a_free_initial_state_is_better_than_the_first_measurement():
    states = noisy_states(LANES, seed=50)
    estimates = identify(SVSF(), *lanes(states, free=True))
    start, first = np.asarray(estimates.initial_state), np.asarray(states[:, 0, RATES])
    # The flights begin at rest: what is not 0 is error.
    assert np.sqrt(np.mean(start**2)) < 0.8 * np.sqrt(np.mean(first**2))
    assert set(names(estimates)) == {"successful"}
    error = errors(estimates)
    assert np.sqrt(np.mean((error / bound(free=True)) ** 2, axis=0)).max() < 6
    assert np.mean(np.abs(error) < 1.96 * np.asarray(estimates.std)) > 0.95 - 4 * np.sqrt(0.95 * 0.05 / LANES)


# The corrections themselves.


def plain(states, omega, center, *, gamma, rates_layer, parameter_layer, damping, equilibration):
    """One pass in plain NumPy from the printed equations, with the one-step influence by finite differences."""
    sigma = jaxos4.SENSOR_SIGMA[RATES]

    def step(x, u, row):
        full = np.zeros(12)
        full[RATES] = x
        return x + DT * published_derivative(full, row, center + u * HALF)[RATES]

    x, u, remaining, phi, energy, history = np.zeros(3), np.zeros(8), np.zeros(3), np.zeros((3, 8)), np.zeros(8), []
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
        x = x + (np.abs(e) + gamma * remaining) * np.clip(e / (rates_layer * sigma), -1, 1)
        u = np.clip(u + unit * (np.abs(w) + gamma * np.abs(w)) * sat, -4, 4)
        remaining = np.where(seen, np.abs(y - x), remaining)
        history.append(center + u * HALF)
        phi = np.stack([(step(x, u + d, omega[k]) - step(x, u - d, omega[k])) / 2 for d in np.eye(8)], axis=1)
        x = step(x, u, omega[k])
    return np.stack(history)


def test_agrees_with_plain_numpy():
    states = np.array(noisy_states(1, seed=3, duration=1.0)[0])
    states[30:40, RATES[1]] = np.nan
    states[50] = np.nan
    center = np.asarray(random_starts(PUBLISHED(), 1, seed=4)[0])
    problem = standard_problem(channels="rates", duration=1.0, states=jnp.asarray(states))
    # Narrow layers, so that corrections leave them too.
    settings = {"gamma": 0.3, "rates_layer": 2.0, "parameter_layer": 2.0, "damping": 8.0, "equilibration": 20.0}
    history = SVSF(**settings, passes=1, memory=False)(problem, jaxos4.Bracket.around(center, HALF)).history
    assert history is not None
    expected = plain(states[:, RATES], np.asarray(problem.flight.omega), center, **settings)
    np.testing.assert_allclose(history / HALF, expected / HALF, atol=1e-9)
    assert np.abs((expected[-1] - center) / HALF).max() > 0.05
    # The comparison can fail.
    for name, value in settings.items():
        other = plain(states[:, RATES], np.asarray(problem.flight.omega), center, **{**settings, name: 1.1 * value})
        assert np.abs(other / HALF - history / HALF).max() > 1e-6, name


def test_other_channels_do_not_matter():
    states, (_, _, _, lower, upper) = noisy_states(LANES, seed=50), lanes(noisy_states(LANES, seed=50))
    alone = SVSF()(standard_problem(channels="all", states=states[1]), jaxos4.Bracket(lower[1], upper[1]))
    assert (np.abs(alone.parameters - noisy().parameters[1]) / bound()).max() < 1e-6
    np.testing.assert_allclose(alone.covariance, noisy().covariance[1], rtol=1e-5, atol=1e-15)
    assert alone.initial_state.shape == (12,)


def test_missing_samples_only_cost_precision():
    estimates = identify(SVSF(), *lanes(lost(noisy_states(LANES, seed=7))))
    good = names(estimates) == "successful"
    assert good.mean() > 0.9
    error = errors(estimates)
    assert np.sqrt(np.mean((error / bound()) ** 2, axis=0)).max() < 5
    assert np.mean(np.abs(error) < 1.96 * np.asarray(estimates.std)) > 0.87
