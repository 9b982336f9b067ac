"""The frequency response of modelled to measured acceleration: known systems, closed loops, and its own errors."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import standard_flight
from scipy import signal

import jaxos4
from jaxos4.analysis.frequency_response import response

DT = 0.004
MODEL = jaxos4.FlightModel(terms=("offset", "damping", "lag"))


def test_the_response_is_that_of_a_known_filter():
    rng = np.random.default_rng(0)
    u = signal.lfilter([0.1], [1, -0.9], rng.normal(size=8000))
    y = signal.lfilter([0.5, 0.2], [1, -0.4], u) + rng.normal(0, 0.02, u.size)
    usable = np.arange(u.size) < 6000
    y[6000:] = 1e6
    found = response(u, y, usable, DT)
    expected = signal.freqz([0.5, 0.2], [1, -0.4], found.frequency, fs=1 / DT)[1]
    within = found.frequency < 30
    np.testing.assert_allclose(found.gain[within], np.abs(expected[within]), rtol=0.03)
    np.testing.assert_allclose(found.phase[within], np.angle(expected[within]), atol=0.03)
    assert found.averages == pytest.approx(6000 * DT, rel=0.01)


def fly_in_gusts(trials, gain):
    """20 s of one axis in closed loop, in gusts: the torque, what was measured over time, and the sample time."""
    rng, dt, lag, gust_time = np.random.default_rng(1), 0.008, 0.05, 0.25
    samples = round(20 / dt)
    noise, push = rng.normal(0, 0.02, (samples + 1, trials)), rng.normal(size=(samples, trials))
    wanted = np.repeat(rng.normal(size=(samples // 100 + 1, trials)), 100, axis=0)
    rate, torque, gust = np.zeros((3, trials))
    u, measured = np.empty((2, samples, trials))
    for k in range(samples):
        measured[k] = rate + noise[k]
        change = (1 - math.exp(-dt / lag)) * (12 * (wanted[k] - measured[k]) - torque)
        u[k], torque = torque + change / 2, torque + change
        gust += -dt / gust_time * gust + 5 * math.sqrt(2 * dt / gust_time) * push[k]
        rate = rate + dt * (gain * u[k] + gust)
    return u, np.diff(measured, axis=0, append=rate[None] + noise[-1:]) / dt, dt


@pytest.mark.slow
@pytest.mark.parametrize("gain", [1.0, 1.5])
def test_intervals_hold_the_truth_although_a_controller_answers_gusts(gain):
    trials = 200
    u, y, dt = fly_in_gusts(trials, gain)
    found = [response(u[:, i], y[:, i], np.ones(len(u), dtype=bool), dt).agreement() for i in range(trials)]
    logs, errors = np.log([each.ratio / gain for each in found]), np.array([each.error for each in found])
    assert np.mean(np.abs(logs) < 1.96 * errors) == pytest.approx(0.95, abs=3 * np.sqrt(0.05 * 0.95 / trials))
    assert abs(logs.mean()) < 0.25 * np.median(errors)
    assert np.median(errors) < 0.15
    # The ratio of spectra is biased by more than twice that.
    frequency, cross = signal.csd(u.T, y.T, fs=1 / dt, nperseg=125)
    ratio = np.abs(cross / signal.welch(u.T, fs=1 / dt, nperseg=125)[1])[:, (frequency >= 4) & (frequency <= 20)]
    assert abs(np.log(ratio / gain).mean()) > 2 * np.median(errors)


@pytest.mark.slow
def test_intervals_hold_one_for_the_right_vehicle():
    """Whole flights in closed loop: rotors, all axes, and a gyro that the controller answers."""
    trials, vehicle = 24, jaxos4.load_airframe("crazyflie")
    loop = jaxos4.ClosedLoop(vehicle, gust=5.0)

    def fly_one(key):
        first, second = jax.random.split(key)
        references = jaxos4.random_references(duration=20.0, dt=DT, key=first)
        return jaxos4.fly_closed_loop(loop, references, dt=DT, key=second)

    flights = eqx.filter_vmap(fly_one)(jax.random.split(jax.random.key(48), trials))
    model = jaxos4.FlightModel(vehicle, terms=("lag", "delay", "reaction"))
    known = dict(zip(model.parameter_names, model.alpha, strict=True)) | {"rotor_lag": 0.05, "rotor_delay": 0.01}
    values, found = jnp.array([known[name] for name in model.parameter_names]), []
    for i in range(trials):
        flight = jax.tree.map(lambda leaf, i=i: leaf[i], flights)
        problem = jaxos4.ShootingProblem(model, flight, sigma=np.ones(12), channels="rates", method="rk4")
        found.append([axis.agreement() for axis in jaxos4.frequency_response(problem, values)])
    logs = np.array([[math.log(each.ratio) for each in row] for row in found])
    errors = np.array([[each.error for each in row] for row in found])
    held = np.mean(np.abs(logs) < 1.96 * errors)
    assert held == pytest.approx(0.95, abs=3 * np.sqrt(0.05 * 0.95 / logs.size))
    # No bias: the mean deviation of each axis, in standard deviations.
    assert np.all(np.abs((logs / errors).mean(axis=0)) < 3 / np.sqrt(trials))
    assert np.all(np.median(errors, axis=0) < 0.3)


def fly(*, gyro, excited=(True, True, True)):
    """30 s of noise on the torques of some axes, with the rates that the model says and gyro noise [rad/s]."""
    rng, mixer = np.random.default_rng(0), np.asarray(MODEL.airframe.mixer)
    samples, square = round(30 / DT) + 1, float(jaxos4.OS4.hover_speed) ** 2
    slow = signal.lfilter([0.05], [1, -0.95], rng.normal(size=(samples, 3)), axis=0)
    torque = 0.04 * square * np.abs(mixer[:3]).max(axis=1) * excited * slow / slow.std(axis=0)
    omega = np.sqrt(square + np.linalg.solve(mixer, np.pad(torque, ((0, 0), (0, 1))).T).T)
    values = MODEL.alpha.at[8:].set(jnp.array([0.1, -0.1, 0.05, 4.0, 4.0, 2.0, 0.05]))
    blank = jaxos4.Flight(DT * np.arange(samples), omega, np.full((samples, 12), np.nan), commanded=True)
    problem = jaxos4.ShootingProblem(
        MODEL, blank, sigma=np.ones(12), channels="rates", method="rk4", initial_state=np.zeros(12)
    )
    states = np.full((samples, 12), np.nan)
    states[:, [7, 9, 11]] = problem.predict(values, jnp.zeros(3)) + rng.normal(0, gyro, (samples, 3))
    flight = eqx.tree_at(lambda f: f.states, blank, jnp.asarray(states))
    return jaxos4.ShootingProblem(MODEL, flight, sigma=jaxos4.SENSOR_SIGMA, channels="rates", method="rk4"), values


@pytest.fixture(scope="module")
def flown():
    return fly(gyro=0.002)


@pytest.mark.parametrize("gyro", [0.002, 0.01])
def test_an_axis_that_is_hardly_excited_has_no_clear_response(gyro):
    """The gyro's noise, which damping brings into the model's acceleration too, is no answer to torque."""
    roll, pitch, yaw = jaxos4.frequency_response(*fly(gyro=gyro, excited=(True, False, 0.01)))
    assert math.isnan(pitch.agreement().ratio)
    assert math.isnan(yaw.agreement().ratio)
    assert not (pitch.clear | yaw.clear)[pitch.frequency >= 4].any()
    assert abs(math.log(roll.agreement().ratio)) < 4 * roll.agreement().error + 2e-3


def test_only_clear_frequencies_count_and_each_as_much_as_its_gain_is_known():
    frequency = np.arange(1.0, 31.0)
    gain = np.select([frequency <= 8, frequency <= 14], [2.0, 1.0], 100.0)
    error = np.select([frequency <= 8, frequency <= 14], [0.05, 0.2], 1.0)
    axis = jaxos4.AxisResponse(frequency, gain, 0 * gain, 0 * gain, np.diag(error**2), 40.0)
    assert axis.agreement().high == 14
    assert axis.agreement(1, 6).ratio == pytest.approx(2.0)
    assert axis.agreement(1, 4).error == pytest.approx(0.025)
    # Standard deviations of the gain: 0.1 at three frequencies, 0.2 at three others.
    assert axis.agreement(6, 11).ratio == pytest.approx(2 ** (3 * 100 / (3 * 100 + 3 * 25)))
    assert math.isnan(axis.agreement(16, 30).ratio)


def test_the_right_model_has_gain_one_and_phase_zero_and_a_late_one_a_negative_phase(flown):
    problem, values = flown
    for axis in [*jaxos4.frequency_response(problem, values)][:2]:
        agreement = axis.agreement()
        assert abs(math.log(agreement.ratio)) < 4 * agreement.error + 2e-3
        assert agreement.error < 0.02
        clear = axis.clear & (axis.frequency >= 2) & (axis.frequency <= 20)
        assert np.all(np.abs(axis.phase[clear]) < 5 * axis.error[clear] + 0.01)
    axis = jaxos4.frequency_response(problem, values.at[-1].set(0.03)).roll  # the true lag is 0.05 s
    at = np.argmin(np.abs(axis.frequency - 3))
    expected = math.atan(2 * math.pi * 3 * 0.03) - math.atan(2 * math.pi * 3 * 0.05)
    assert axis.phase[at] == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize(("name", "factor", "axis"), [("alpha3", 2.0, "roll"), ("alpha6", 0.5, "pitch")])
def test_a_wrong_inertia_shows_as_its_factor(flown, name, factor, axis):
    problem, values = flown
    wrong = values.at[MODEL.parameter_names.index(name)].mul(factor)
    found = jaxos4.frequency_response(problem, wrong)
    agreement = getattr(found, axis).agreement()
    assert agreement.ratio * factor == pytest.approx(1.0, abs=0.06)
    low, high = agreement.interval
    assert not low < 1 < high
    other = found.pitch if axis == "roll" else found.roll
    assert other.agreement().ratio == pytest.approx(1.0, abs=0.05)


def test_gaps_and_stretches_are_not_crossed(flown):
    """Gaps and ends of stretches take segments away; rubbish beside them changes nothing else."""
    problem, values = flown
    states = np.array(problem.flight.states)
    states[1000:1010] = np.nan
    states[2500:, [7, 9, 11]] += 5.0  # a jump where the second stretch begins
    stretch = jnp.asarray((np.arange(states.shape[0]) >= 2500).astype(int))
    model = jaxos4.FlightModel(terms=MODEL.terms, recordings=(0, 0))
    flight = eqx.tree_at(lambda f: f.states, problem.flight, jnp.asarray(states))
    flight = eqx.tree_at(lambda f: f.stretch, flight, stretch, is_leaf=lambda x: x is None)
    cut = eqx.tree_at(lambda p: (p.model, p.flight), problem, (model, flight), is_leaf=lambda x: x is None)
    found, whole = jaxos4.frequency_response(cut, values), jaxos4.frequency_response(problem, values)
    assert 0 < found.roll.averages < whole.roll.averages
    assert found.roll.agreement().ratio == pytest.approx(whole.roll.agreement().ratio, abs=0.03)


def test_too_short_a_flight_has_no_answer():
    short = jax.tree.map(lambda leaf: leaf[:80] if jnp.ndim(leaf) else leaf, standard_flight())
    problem = jaxos4.ShootingProblem(jaxos4.CorrectedOS4(), short, sigma=jaxos4.SENSOR_SIGMA, channels="rates")
    for axis in jaxos4.frequency_response(problem, problem.model.alpha):
        assert (axis.averages, axis.clear.any()) == (0, False)
        assert math.isnan(axis.agreement().ratio)
