"""The frequency response of modelled to measured acceleration: against SciPy, known systems, and its own errors."""

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

DT, LENGTH = 0.004, 250
MODEL = jaxos4.FlightModel(terms=("offset", "damping", "lag"))


def begins(samples):
    return list(range(0, samples - LENGTH + 1, LENGTH // 2))


def test_spectra_are_those_of_scipy():
    rng = np.random.default_rng(0)
    u = rng.normal(size=2000)
    y = signal.lfilter([0.5, 0.2], [1, -0.4], u) + rng.normal(0, 0.3, u.size)
    found = response(u, y, begins(u.size), LENGTH, DT)
    window = np.sin(np.pi * (np.arange(LENGTH) + 0.5) / LENGTH) ** 2
    settings = {"fs": 1 / DT, "window": window, "nperseg": LENGTH, "noverlap": LENGTH // 2, "detrend": "constant"}
    frequency, cross = signal.csd(u, y, **settings)
    power = signal.welch(u, **settings)[1]
    np.testing.assert_allclose(found.frequency, frequency[1:-1], rtol=1e-12)
    np.testing.assert_allclose(found.gain * np.exp(1j * found.phase), (cross / power)[1:-1], rtol=1e-9)
    np.testing.assert_allclose(found.coherence, signal.coherence(u, y, **settings)[1][1:-1], rtol=1e-9)
    assert found.averages == pytest.approx(0.947 * len(begins(u.size)), rel=1e-3)


def test_bands_hold_the_truth_as_often_as_they_say():
    """A system with a flat response, so that the resolution does not bias it; coherences of 0.67 and 0.95."""
    rng, trials, truth = np.random.default_rng(1), 400, 0.5
    gains, phases, logs, ratios = [], [], [], []
    for k in range(trials):
        u = rng.normal(size=12 * LENGTH)
        y = truth * u + rng.normal(0, 0.5 * (0.7 if k % 2 else 0.23), u.size)
        found = response(u, y, begins(u.size), LENGTH, DT)
        gains.append(np.abs(found.gain / truth - 1) < found.half_width * found.gain / truth)
        phases.append(np.abs(found.phase) < found.half_width)
        agreement = found.agreement()
        logs.append(math.log(agreement.ratio / truth) / agreement.error)
        ratios.append(agreement.interval[0] < truth < agreement.interval[1])
    for inside in (gains, phases):
        # Neighbouring frequencies are correlated: the trial is the unit.
        share = np.mean(inside, axis=1)
        assert abs(share.mean() - 0.95) < 3 * share.std() / np.sqrt(trials) + 0.01
    assert abs(np.mean(logs)) < 4 / np.sqrt(trials)
    assert np.std(logs) == pytest.approx(1.0, abs=4 / np.sqrt(2 * trials))
    assert np.mean(ratios) == pytest.approx(0.95, abs=4 * np.sqrt(0.05 * 0.95 / trials))


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


def test_only_coherent_frequencies_count_and_each_as_much_as_its_coherence():
    frequency = np.arange(1.0, 31.0)
    coherence = np.select([frequency <= 8, frequency <= 14], [0.9, 0.7], 0.1)
    gain = np.select([frequency <= 8, frequency <= 14], [2.0, 1.0], 100.0)
    axis = jaxos4.AxisResponse(frequency, gain, 0 * gain, coherence, 0.1 / coherence, 0.2 / coherence, 40.0)
    assert axis.agreement().high == 12
    assert axis.agreement(1, 6).ratio == pytest.approx(2.0)
    # Coherences as means over five frequencies: 0.9, 0.86, 0.82; 0.78, 0.74, 0.7.
    assert axis.agreement(6, 11).ratio == pytest.approx(2 ** (2.58 / 4.8))
    assert math.isnan(axis.agreement(16, 30).ratio)


def test_the_right_model_has_gain_one_and_phase_zero_and_a_late_one_a_negative_phase(flown):
    problem, values = flown
    for axis in jaxos4.frequency_response(problem, values)[:2]:
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
