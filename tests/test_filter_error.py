"""Filter error: its filters and its likelihood against NumPy, gaps, recordings and failures.

Flights in closed loop, for which it is made: `test_vehicle.py`. Flights without a disturbance: `test_estimators.py`.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from disturbances import joint_cost, transition
from helpers import CRAZYFLIE, DT, noisy_states, standard_flight, standard_problem
from lanes import LANES, names

import jaxos4
from jaxos4.estimators import FilterError
from jaxos4.flight import RATES
from jaxos4.shooting import InnovationsProblem, pad_flight
from jaxos4.shooting.gains import LogNoise
from jaxos4.shooting.innovations import SETTLING
from jaxos4.shooting.layout import observe_in_segments

MODEL = jaxos4.PublishedOS4()
# Without gyroscopic torques a disturbed rate changes no other channel.
UNCOUPLED = jnp.array([0.0, 0.0, 133.0, 0.0, 0.0, 133.0, 0.0, 77.0])
NOISE = LogNoise(*(jnp.log(jnp.array(x)) for x in ([4.0, 2.0, 1.0], [0.2, 0.05, 1.0], [0.02, 0.01, 0.03])))


@eqx.filter_jit
def observed_in(problem, segments=1):
    """Where filters restart, and which samples count, in segments of about this many samples; by default in one."""
    found = InnovationsProblem(problem, segments=segments)
    rows, observed = found.segmentation.rows, observe_in_segments(found)
    return observed["restart"][:rows, 0], observed["counts"][:rows, 0]


@eqx.filter_jit
def likelihood(problem, parameters, noise, *, segments=1):
    """The innovations of a problem in segments of about this many samples."""
    return InnovationsProblem(problem, segments=segments).innovations(parameters, noise)


def uncoupled_rates(flight):
    """The rates from rest at the parameters `UNCOUPLED`: sums of the torques."""
    forcing = MODEL.forcing(flight.inputs, UNCOUPLED)
    torques = np.stack([forcing.roll, forcing.pitch, forcing.yaw], axis=1)[:-1]
    return np.concatenate([np.zeros((1, 3)), np.cumsum(DT * torques * np.asarray(UNCOUPLED)[[2, 5, 7]], axis=0)])


def disturbed(seed=0):
    """The standard problem from an unknown start, with disturbances, noise, and gaps, one of them in one channel."""
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


def test_the_likelihood_is_that_of_a_joint_gaussian():
    """60 samples with gaps: the dense covariance matrix of the measurements, at a model without gyroscopic coupling."""
    samples = 60
    states = np.array(disturbed(seed=1).flight.states)[40:][:samples]
    states[20:24] = np.nan
    states[30:40, RATES[1]] = np.nan
    longer = np.concatenate([states, np.full((501 - samples, 12), np.nan)])
    problem = standard_problem(channels="rates", free=True, states=jnp.asarray(longer))
    means, total = uncoupled_rates(problem.flight)[:samples], 0.0
    for i, mean in enumerate(means.T):
        strength, tau, sensor = (float(np.exp(x[i])) for x in NOISE[:3])
        first = np.diag([1e6, strength**2])
        total += joint_cost(states[:, RATES[i]] - mean, *transition(strength, tau, DT), first, sensor, seen=0)
    found = likelihood(problem, UNCOUPLED, NOISE).cost.sum()
    np.testing.assert_allclose(found, total, rtol=1e-6)
    # It would see a time constant that is wrong by 1 %.
    wrong = NOISE._replace(time_constant=NOISE.time_constant + 0.01)
    assert abs(likelihood(problem, UNCOUPLED, wrong).cost.sum() - total) > 1e-5 * abs(total)


# The likelihood.


@pytest.mark.slow
def test_derivatives_are_those_of_finite_differences():
    """Also in the noise, all channels together: a channel's noise is taken to change no other channel's innovations."""
    problem, alpha = disturbed(), np.asarray(MODEL.alpha) * 1.1
    gradient = np.asarray(likelihood(problem, alpha, NOISE).gradient.sum(axis=(0, 2)))
    steps = np.concatenate([1e-4 * np.asarray(jaxos4.DEFAULT_HALF_WIDTH), np.full(3, 1e-4)])
    for i, step in enumerate(steps):
        costs = []
        for change in (step, -step):
            noise = LogNoise(*(jnp.asarray(np.asarray(x) + change * (i - 8 == k)) for k, x in enumerate(NOISE[:3])))
            costs.append(float(likelihood(problem, alpha + change * (np.arange(8) == i), noise).cost.sum()))
        slope = (costs[0] - costs[1]) / (2 * step)
        np.testing.assert_allclose(gradient[i], slope, rtol=1e-5, atol=1e-4 / step * 1e-3)


def test_the_information_is_the_covariance_of_the_gradient():
    """Over flights that the filter's own model made: 64 draws, standard error 18 % of each variance."""
    flight, rng = standard_flight(), np.random.default_rng(3)
    strength, tau, sensor = (np.exp(np.asarray(x)) for x in NOISE[:3])
    parts = [np.linalg.cholesky(transition(s, t, DT)[1]) for s, t in zip(strength, tau, strict=True)]
    moves = [transition(s, t, DT)[0] for s, t in zip(strength, tau, strict=True)]
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


@pytest.mark.slow
def test_the_likelihood_does_not_depend_on_the_segments_and_no_trajectory_runs_away_in_a_long_gap():
    problem = disturbed()
    alone, cut = likelihood(problem, MODEL.alpha, NOISE), likelihood(problem, MODEL.alpha, NOISE, segments=4)
    assert (alone.cost.shape, cut.cost.shape) == ((1,), (4,))
    np.testing.assert_allclose(cut.cost.sum(), alone.cost.sum(), atol=0.2)
    np.testing.assert_allclose(cut.gradient.sum(axis=(0, 2)), alone.gradient.sum(axis=(0, 2)), rtol=0.05, atol=1.0)
    # Nothing was measured for 3 s, in which this model would turn faster and faster.
    problem = eqx.tree_at(lambda p: p.flight.states, problem, problem.flight.states.at[150:450].set(jnp.nan))
    found = likelihood(problem, MODEL.alpha.at[1].set(-50.0), NOISE)
    assert bool(found.feasible.all())
    assert all(np.isfinite(leaf).all() for leaf in found)


# Gaps, recordings, failures.


@pytest.mark.slow
def test_a_long_gap_and_another_recording_restart_the_filter_and_a_while_after_does_not_count():
    """Recordings begin in mid-flight, where the controller has answered the disturbance for some time."""
    restart, counts = observed_in(disturbed())
    assert restart.nonzero()[0].tolist() == [0, *range(210, 231)]
    assert counts.nonzero()[0].tolist() == [*range(210), *range(230 + SETTLING, 501)]
    problem = standard_problem(channels="rates", free=True, states=noisy_states(1, seed=4)[0])
    # The second half of the flight as one recording, and then its first half as another.
    flight, order = problem.flight, np.concatenate([np.arange(250, 501), np.arange(250)])
    stretch = jnp.asarray(np.arange(501) > 250, dtype=int)
    joined = dataclasses.replace(flight, omega=flight.omega[order], states=flight.states[order], stretch=stretch)
    problem = eqx.tree_at(lambda p: p.flight, problem, joined)
    restart, counts = observed_in(problem)
    assert restart.nonzero()[0].tolist() == [0, 251]
    assert (~counts).nonzero()[0].tolist() == [*range(SETTLING), *range(251, 251 + SETTLING)]
    found = FilterError()(problem)
    assert names(found) == "successful"
    assert (np.abs(found.parameters - MODEL.alpha) < 4 * found.std).all()


@pytest.mark.slow
def test_a_flight_too_short_to_say_anything_leaves_the_bracket():
    states = noisy_states(1, duration=11 * DT)[0]
    problem = standard_problem(channels="rates", free=True, states=states, duration=11 * DT)
    bracket = jaxos4.Bracket.default(MODEL)
    found = FilterError()(problem, bracket)
    assert jaxos4.result_names(found.result) == "unidentifiable"
    assert (np.abs(found.parameters - bracket.center) < 4 * bracket.half_width).all()
    assert (found.std <= bracket.half_width * 1.001).all()


@pytest.mark.slow
def test_lanes_may_differ_in_everything_and_padding_changes_nothing():
    """Lanes become segments of one filter: each with its own model, sample time, number of samples and noise."""
    problem = disturbed()

    def at(i, fast=400.0, room=700):
        """A problem in segments, whose number `i` changes all data. Rows beyond its length are not summed."""
        flight, inertia = pad_flight(problem.flight, room), problem.model.airframe.inertia
        rows = jnp.arange(room)[:, None] < 501
        flight = eqx.tree_at(lambda f: f.time, flight, flight.time * (1 + 0.1 * i))
        flight = eqx.tree_at(lambda f: f.omega, flight, jnp.where(rows, flight.omega, fast))
        each = eqx.tree_at(lambda p: p.model.airframe.inertia, problem, inertia * (1 + 0.2 * i))
        length = jnp.asarray(501 - 40 * i, dtype=int)
        each = eqx.tree_at(lambda p: (p.flight, p.length), each, (flight, length), is_leaf=lambda leaf: leaf is None)
        noise = LogNoise(*(leaf + 0.1 * i for leaf in NOISE[:3]))
        return InnovationsProblem(each, segments=3, settling=50).innovations(MODEL.alpha * (1 + 0.01 * i), noise)

    together = eqx.filter_jit(eqx.filter_vmap(at))(jnp.arange(3.0))
    one = eqx.filter_jit(at)
    others = [(one(jnp.asarray(float(i))), i) for i in range(3)] + [(one(jnp.asarray(0.0), 200.0, 600), 0)]
    for alone, i in others:
        for name, expected, found in zip(alone._fields, alone, together, strict=True):
            atol = 1e-9 * np.abs(expected).max()
            np.testing.assert_allclose(found[i], expected, rtol=1e-9, atol=atol, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("own_speeds", [False, True])
def test_lanes_look_up_the_forcing_of_their_own_flight(own_speeds):
    """The forcing depends on parameters. Lanes share it, or each has its own, of which the velocity is shared."""
    rng, samples = np.random.default_rng(3), 300
    states = np.full((samples, 12), np.nan)
    states[:, RATES] = 0.1 * rng.normal(size=(samples, 3))
    speeds = float(CRAZYFLIE.hover_speed) * (1 + 0.05 * rng.normal(size=(samples, 4)))
    flight = jaxos4.Flight(DT * np.arange(samples), speeds, states, body_velocity=rng.normal(size=(samples, 3)))
    model = jaxos4.FlightModel(CRAZYFLIE, terms=("offset", "velocity", "lag", "delay"))
    problem = jaxos4.ShootingProblem(model, flight, sigma=np.full(12, 0.02), channels="rates", method="rk4")

    def at(i):
        own, parameters = problem, model.alpha
        if own_speeds:
            own = eqx.tree_at(lambda p: p.flight.omega, own, own.flight.omega * (1 + 0.02 * i))
            parameters = parameters * (1 + 0.1 * i)
        noise = LogNoise(*(leaf + 0.1 * i for leaf in NOISE[:3]))
        return InnovationsProblem(own, segments=3, settling=50).innovations(parameters, noise)

    together, one = eqx.filter_jit(eqx.filter_vmap(at))(jnp.arange(2.0)), eqx.filter_jit(at)
    for i in range(2):
        alone = one(jnp.asarray(float(i)))
        slopes = alone.gradient[:, list(model.forcing_parameters)]
        assert (np.abs(slopes).max(axis=(0, 2)) > 0).all()
        for name, expected, found in zip(alone._fields, alone, together, strict=True):
            atol = 1e-9 * np.abs(expected).max()
            np.testing.assert_allclose(found[i], expected, rtol=1e-9, atol=atol, err_msg=name)
