"""`FilterError`: its filters and its likelihood against NumPy, and flights in closed loop, for which it is made."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DT, noisy_states, standard_flight, standard_problem
from lanes import LANES, assert_chi_square, bound, errors, identify, lanes, names

import jaxos4
from jaxos4.estimators import FilterError
from jaxos4.estimators.filter_error import _lanes, _observed
from jaxos4.shooting.filtering import Noise, filter_gains, innovate

MODEL = jaxos4.PublishedOS4()
RATES = jaxos4.models.state.CASCADE_ORDER[:3]
# Without gyroscopic torques a disturbed rate changes no other channel.
UNCOUPLED = jnp.array([0.0, 0.0, 133.0, 0.0, 0.0, 133.0, 0.0, 77.0])
NOISE = Noise(*(jnp.log(jnp.array(x)) for x in ([4.0, 2.0, 1.0], [0.2, 0.05, 1.0], [0.02, 0.01, 0.03])))


@eqx.filter_jit
def likelihood(problem, parameters, noise, lane=10**6):
    """The innovations of a problem whose forcing depends on no parameter; by default in one lane."""
    index = _lanes(problem.flight.time.shape[0], lane)
    observed, place = _observed(problem, index), np.minimum(index, problem.flight.time.shape[0] - 1)
    forcing = jax.tree.map(lambda leaf: leaf[place].T, problem.forcing(parameters))
    step, observe, dt = problem.step, problem.model.observe, problem.flight.dt
    nothing = {"forcing_tangents": None, "forcing_parameters": ()}
    return innovate(step, observe, observed, forcing, parameters, noise, dt, **nothing)


def uncoupled_rates(flight):
    """The rates from rest at the parameters `UNCOUPLED`: sums of the torques."""
    forcing = MODEL.forcing(flight.inputs, UNCOUPLED)
    torques = np.stack([forcing.roll, forcing.pitch, forcing.yaw], axis=1)[:-1]
    return np.concatenate([np.zeros((1, 3)), np.cumsum(DT * torques * np.asarray(UNCOUPLED)[[2, 5, 7]], axis=0)])


def disturbed(seed=0):
    """The standard problem from an unknown start, with disturbances, noise, and gaps: long, short and in one channel."""
    rng, states = np.random.default_rng(seed), np.array(noisy_states(1, seed=seed)[0])
    strength, tau = np.exp(NOISE.strength), np.exp(NOISE.time_constant)
    kept, disturbance = np.exp(-DT / tau), np.zeros((len(states), 3))
    for k in range(1, len(states)):
        fresh = strength * np.sqrt(1 - kept**2) * rng.standard_normal(3)
        disturbance[k] = kept * disturbance[k - 1] + fresh
    states[:, RATES] += 0.1 * DT * np.cumsum(disturbance, axis=0)
    states[100:104] = states[200:230] = np.nan
    states[300:340, RATES[1]] = np.nan
    return standard_problem(channels="rates", free=True, states=jnp.asarray(states))


# The filters.


def transition(strength, tau, dt=DT):
    """State transition and added covariance of a rate and the Ornstein-Uhlenbeck disturbance that drives it."""
    # Van Loan (1978), with a matrix exponential by Taylor series.
    drift, noise = np.array([[0.0, 1.0], [0.0, -1 / tau]]), np.diag([0.0, 2 * strength**2 / tau])
    whole = np.block([[-drift, noise], [np.zeros((2, 2)), drift.T]]) * dt
    power, total = np.eye(4), np.eye(4)
    for k in range(1, 60):
        power = power @ whole / k
        total = total + power
    moved = total[2:, 2:].T
    return moved, moved @ total[:2, 2:]


def textbook(noise, measured, restart):
    """Gain and variance of each innovation by a Kalman filter with full matrices, one channel."""
    strength, tau, sensor = noise
    moved, added = transition(strength, tau)
    see, found, p = np.array([[1.0, 0.0]]), [], np.zeros((2, 2))
    for is_measured, restarts in zip(measured, restart, strict=True):
        if restarts:
            p = np.diag([1e6, strength**2])
        gain, variance = np.zeros(2), 1.0
        if is_measured:
            variance = (see @ p @ see.T).item() + sensor**2
            gain = (p @ see.T / variance)[:, 0]
            rest = np.eye(2) - np.outer(gain, see)
            p = rest @ p @ rest.T + np.outer(gain, gain) * sensor**2
        found.append((*gain, variance))
        p = moved @ p @ moved.T + added
    return np.array(found)


def test_the_gains_are_those_of_a_textbook_filter():
    observed = _observed(disturbed(), _lanes(501))
    (gains, _), measured = filter_gains(observed, NOISE, jnp.asarray(DT)), ~np.isnan(observed.measured)
    assert observed.restart[:, 0].nonzero()[0].tolist() == [0, *range(210, 231)]
    assert observed.counts[:, 0].nonzero()[0].tolist() == [*range(210), *range(230 + 128, 501)]
    for i in range(3):
        noise = [float(np.exp(x[i])) for x in NOISE]
        expected = textbook(noise, measured[:, i, 0], observed.restart[:, 0])
        for found, column in zip(gains, expected.T, strict=True):
            np.testing.assert_allclose(found[:, i, 0], column, rtol=1e-6, atol=1e-9)
        # The reference sees a time constant that is wrong by 1 %.
        wrong = textbook([noise[0], 1.01 * noise[1], noise[2]], measured[:, i, 0], observed.restart[:, 0])
        assert np.abs(wrong - expected)[:, 1].max() > 1e-3 * np.abs(expected[:, 1]).max()


@pytest.mark.parametrize("tau", [0.003, 0.2, 0.34, 30.0])
def test_the_variance_that_a_disturbance_adds_is_exact(tau):
    """Also for time constants of thousands of samples, where its formula is a difference of nearly equal numbers."""
    noise = Noise(*(jnp.log(jnp.array([x, 1.0, 1.0])) for x in (3.0, tau, 1e-9)))
    measured = jnp.array([0.0, 0.0])[:, None, None] * jnp.ones((1, 3, 1))
    first = jnp.zeros((2, 1), dtype=bool)
    observed = _observed(standard_problem(channels="rates", duration=0.1), _lanes(11))
    observed = observed._replace(measured=measured, restart=first)
    gains, _ = filter_gains(observed, noise, jnp.asarray(DT))
    moved, added = transition(3.0, tau)
    start = np.diag([0.0, 9.0])
    expected = (moved @ start @ moved.T + added)[0, 0] + 1e-18
    np.testing.assert_allclose(gains.variance[1, 0, 0], expected, rtol=1e-9)


def test_the_likelihood_is_that_of_a_joint_gaussian():
    """60 samples with gaps: the dense covariance matrix of the measurements, at a model without gyroscopic coupling."""
    samples = 60
    problem = disturbed(seed=1)
    states = np.array(problem.flight.states)[40:][:samples]
    states[20:24] = np.nan
    states[30:40, RATES[1]] = np.nan
    flight = jaxos4.Flight(DT * np.arange(samples), problem.flight.omega[:samples], states)
    problem = eqx.tree_at(lambda p: p.flight, problem, flight)
    means, total = uncoupled_rates(flight), 0.0
    for i, mean in enumerate(means.T):
        strength, tau, sensor = (float(np.exp(x[i])) for x in NOISE)
        moved, added = transition(strength, tau)
        own = [np.diag([1e6, strength**2])]
        for _ in range(samples - 1):
            own.append(moved @ own[-1] @ moved.T + added)
        covariance = np.zeros((samples, samples))
        for k in range(samples):
            ahead = own[k]
            for j in range(k, samples):
                covariance[k, j] = covariance[j, k] = ahead[0, 0]
                ahead = moved @ ahead
        covariance += sensor**2 * np.eye(samples)
        y = states[:, RATES[i]] - mean
        known = ~np.isnan(y)
        dense = covariance[np.ix_(known, known)]
        total += (y[known] @ np.linalg.solve(dense, y[known]) + np.linalg.slogdet(dense)[1]) / 2
    found = likelihood(problem, UNCOUPLED, NOISE).cost.sum()
    np.testing.assert_allclose(found, total, rtol=1e-6)


# The likelihood.


def test_derivatives_are_those_of_finite_differences():
    """Also in the noise, all channels together: a channel's noise is taken to change no other channel's innovations."""
    problem, alpha = disturbed(), MODEL.alpha * 1.1
    at = likelihood(problem, alpha, NOISE)
    gradient = np.asarray(at.gradient.sum(axis=(0, 2)))
    steps = np.concatenate([1e-4 * np.asarray(jaxos4.DEFAULT_HALF_WIDTH), np.full(3, 1e-4)])
    for i, step in enumerate(steps):
        costs = []
        for sign in (1, -1):
            change = sign * step
            parameters = alpha.at[i].add(change) if i < 8 else alpha
            noise = Noise(*(x + change * (i - 8 == k) for k, x in enumerate(NOISE)))
            costs.append(float(likelihood(problem, parameters, noise).cost.sum()))
        slope = (costs[0] - costs[1]) / (2 * step)
        np.testing.assert_allclose(gradient[i], slope, rtol=1e-5, atol=1e-4 / step * 1e-3)


def test_the_information_is_the_covariance_of_the_gradient():
    """Over flights that the filter's own model made: 64 draws, standard error 18 % of each variance."""
    flight, rng = standard_flight(), np.random.default_rng(3)
    strength, tau, sensor = (np.exp(np.asarray(x)) for x in NOISE)
    parts = [np.linalg.cholesky(transition(s, t)[1]) for s, t in zip(strength, tau, strict=True)]
    moves = [transition(s, t)[0] for s, t in zip(strength, tau, strict=True)]
    exact = uncoupled_rates(flight)
    draws = np.tile(np.asarray(flight.states), (LANES, 1, 1))
    state = np.zeros((LANES, 3, 2))
    state[:, :, 1] = strength * rng.standard_normal((LANES, 3))
    for k in range(len(exact)):
        draws[:, k, RATES] = exact[k] + state[:, :, 0] + sensor * rng.standard_normal((LANES, 3))
        fresh = rng.standard_normal((LANES, 3, 2))
        state = np.stack([state[:, i] @ moves[i].T + fresh[:, i] @ parts[i].T for i in range(3)], axis=1)
    problem = standard_problem(channels="rates", free=True)

    @eqx.filter_jit
    @eqx.filter_vmap
    def each(states):
        return likelihood(eqx.tree_at(lambda p: p.flight.states, problem, states), UNCOUPLED, NOISE)

    found = each(jnp.asarray(draws))
    # The torques' parameters, and the three logarithms of each channel.
    for channel, place in enumerate((2, 5, 7)):
        own = np.array([place, 8, 9, 10])
        gradient = np.asarray(found.gradient)[:, channel, own, 0]
        information = np.asarray(found.information)[:, channel][:, own][:, :, own, 0].mean(axis=0)
        scaled = gradient / np.sqrt(np.diagonal(information))
        assert np.abs(scaled.mean(axis=0)).max() < 4 / np.sqrt(LANES), scaled.mean(axis=0)
        np.testing.assert_allclose(np.square(scaled).mean(axis=0), 1, atol=4 * np.sqrt(2 / LANES))


def test_the_likelihood_does_not_depend_on_the_lanes():
    problem = disturbed()
    alone = likelihood(problem, MODEL.alpha, NOISE)
    cut = likelihood(problem, MODEL.alpha, NOISE, 90)
    assert (alone.cost.shape, cut.cost.shape) == ((1,), (4,))
    np.testing.assert_allclose(cut.cost.sum(), alone.cost.sum(), atol=0.2)
    np.testing.assert_allclose(cut.gradient.sum(axis=(0, 2)), alone.gradient.sum(axis=(0, 2)), rtol=0.05, atol=1.0)


# Simulated flights without a disturbance.


def test_it_finds_the_truth_at_nearly_the_bound():
    """White noise and nothing else. The noise is estimated too, and a weak disturbance can never be ruled out.

    So the standard deviations lie above the bound, which knows that there is none: by little for torques, and by up to
    40 % for parameters that act slowly.
    """
    found = identify(FilterError(), *lanes(noisy_states(LANES, seed=50)))
    assert set(names(found)) == {"successful"}
    ratio = np.median(found.std, axis=0) / bound()
    assert (ratio > 0.95).all(), ratio
    assert (ratio < np.array([1.2, 1.4, 1.1, 1.2, 1.4, 1.1, 1.2, 1.1])).all(), ratio
    assert_chi_square(errors(found), np.linalg.inv(found.covariance))


def test_held_parameters_stay_and_cost_no_precision():
    problem = standard_problem(channels="rates", states=noisy_states(1, seed=2)[0])
    bracket, held = jaxos4.Bracket.default(MODEL), np.arange(8) < 2
    shifted = jaxos4.Bracket.around(bracket.center.at[2].add(30.0), bracket.half_width)
    free, some = (FilterError().fit(problem, shifted, held=jnp.asarray(held & wanted)) for wanted in (False, True))
    assert bool(free.done)
    assert bool(some.done)
    np.testing.assert_array_equal(some.parameters[:2], shifted.center[:2])
    assert (np.asarray(some.covariance)[:2] == 0).all()
    assert (np.asarray(some.covariance)[:, :2] == 0).all()
    assert (np.diagonal(some.covariance)[2:] <= np.diagonal(free.covariance)[2:] * 1.02).all()
    assert np.abs((some.parameters - MODEL.alpha)[2:] / bound()[2:]).max() < 4


def test_a_known_start_is_used_in_flights_of_several_lanes():
    """A filter that knows the first rates begins with the rates themselves, and without uncertainty."""
    long = standard_problem(channels="rates")
    start = np.array(long.flight.states[0])
    start[RATES] = 0.3, -0.2, 0.1
    problem = eqx.tree_at(lambda p: p.initial_state, long, jnp.asarray(start))
    observed = _observed(problem, _lanes(501, 90))
    assert observed.restart[0].tolist() == [False, True, True, True]
    np.testing.assert_array_equal(observed.known[:, 0], start[RATES])
    gains, _ = filter_gains(observed, NOISE, jnp.asarray(DT))
    # After one sample only the disturbance is unknown.
    moved, added = transition(4.0, 0.2)
    expected = (moved @ np.diag([0.0, 16.0]) @ moved.T + added)[0, 0] + 0.02**2
    np.testing.assert_allclose(gains.variance[1, 0, 0], expected, rtol=1e-9)


@pytest.mark.parametrize(("samples", "lane"), [(2, 384), (50, 384), (501, 90), (501, 384), (1500, 384), (153_601, 384)])
def test_each_sample_counts_once(samples, lane):
    index = _lanes(samples, lane)
    own = np.concatenate([index[0], index[1:, 128:].ravel()])
    np.testing.assert_array_equal(own[own < samples], np.arange(samples))
    assert (index[:, 0] >= 0).all()
