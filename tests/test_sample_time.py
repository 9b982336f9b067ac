"""The rule that chooses the sample time of a vehicle, and what the fits at several sample times share."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from helpers import CRAZYFLIE, compiled_programs

import jaxos4
from jaxos4.identification.answers import vehicle_constants
from jaxos4.identification.results import Constant, HeldParameter, SampleTime
from jaxos4.identification.sample_time import answer_of, fit_at_sample_times, moved, noise_of_speeds, shortest
from jaxos4.identification.vehicle import prepare_vehicle
from jaxos4.recording.pieces import as_recordings


def table(*rows):
    """Answers at 4, 8, 16 ms and so on. A row: Ix and Iy with a standard deviation of 1, and the correlation."""
    return [
        SampleTime(
            0.004 * 2**i,
            {name: Constant(value, 1.0, "kg m^2") for name, value in zip(("Ix", "Iy"), values, strict=False)},
            correlation,
            samples=5000 // 2**i,
        )
        for i, (values, correlation) in enumerate(rows)
    ]


A, B, C = (10.0, 20.0), (13.0, 20.0), (10.0, 25.0)
PLATEAUS = {
    "one": ([(A, 0.0)], 0),
    "plateau": ([(A, 0.1), (A, 0.0), (A, 0.0)], 0),
    "later plateau": ([(A, 0.1), (B, 0.0), (B, 0.0)], 1),
    "plateau of Iy": ([(A, 0.1), (C, 0.0), (C, -0.1)], 1),
    "beyond chance": ([(A, 0.12), (A, 0.1), (A, 0.1)], 1),
    "negative": ([(A, -0.5), (A, 0.1), (A, 0.1)], 1),
    "none white": ([(A, 0.9), (A, 0.8), (A, 0.7)], 2),
    "last alone": ([(A, 0.9), (A, 0.8), (A, 0.1)], 2),
    "no plateau": ([(A, 0.1), (B, 0.1), (A, 0.1)], 0),
    "no answer": ([((), 0.1), (A, 0.1), (A, 0.1)], 1),
}


@pytest.mark.parametrize(("rows", "place"), PLATEAUS.values(), ids=PLATEAUS)
def test_the_shortest_white_sample_time_of_a_plateau_is_chosen(rows, place):
    """Answers agree within two standard deviations and three percent."""
    assert shortest(table(*rows)) == place
    own, near, far = (table((values, 0.0))[0] for values in (A, (12.2, 20.0), (12.4, 20.0)))
    assert moved(own, near) == []
    assert moved(own, far) == moved(far, own) == ["Ix"]


@pytest.mark.parametrize("noise", [0.0, 1.0, 10.0])
def test_noise_of_measured_speeds_is_its_share_of_their_changes(noise):
    """Rotors that follow random levels within 50 ms, with white noise [rad/s], averaged to longer samples."""
    random, time = np.random.default_rng(0), 0.004 * np.arange(16000)
    levels = np.repeat(60 * random.normal(size=(time.size // 100, 4)), 100, axis=0)
    speeds = 1700 + scipy.signal.lfilter([0.08], [1, -0.92], levels, axis=0)
    error = noise * random.normal(size=speeds.shape)
    finest = jaxos4.Flight(time, speeds + error, np.zeros((time.size, 12)))

    def changes(omega):
        torque = np.square(omega) @ np.asarray(CRAZYFLIE.mixer)[:2].T
        return np.median(np.abs(np.diff(torque, axis=0)), axis=0) ** 2

    for longer in (1, 2, 8):
        noisy, wrong = (each.reshape(-1, longer, 4).mean(axis=1) for each in (speeds + error, 1700 + error))
        flight = jaxos4.Flight(time[::longer], noisy, np.zeros((len(noisy), 12)))
        share = np.max(changes(wrong) / changes(noisy))
        assert noise_of_speeds(flight, finest, CRAZYFLIE) == pytest.approx(share, rel=0.3, abs=0.02)
    assert noise_of_speeds(dataclasses.replace(flight, commanded=True), finest, CRAZYFLIE) == 0


def test_four_sample_times_need_one_program():
    """The length of a flight is data."""
    keys = jax.random.split(jax.random.key(0))
    references = jaxos4.random_references(duration=16.0, dt=0.004, key=keys[0])
    flight = jaxos4.fly_closed_loop(jaxos4.ClosedLoop(CRAZYFLIE, gust=2.0), references, dt=0.004, key=keys[1])
    with compiled_programs() as programs:
        settings = jaxos4.VehicleSettings(terms=("offset", "lag", "delay"))
        found = jaxos4.identify(flight, CRAZYFLIE, settings=settings)
    np.testing.assert_allclose([each.sample_time for each in found.sample_times], [0.004, 0.008, 0.016, 0.032])
    searches = [name for name in programs if name is not None and "call" in name.lower()]
    assert len(searches) == 1, programs


def test_a_fit_without_a_thrust_is_no_answer_and_its_inertias_are_as_uncertain():
    """The gain of the thrust scales all torques. If it is hardly known, so are the moments of inertia."""
    keys = jax.random.split(jax.random.key(1))
    references = jaxos4.random_references(duration=8.0, dt=0.008, key=keys[0])
    flight = jaxos4.fly_closed_loop(jaxos4.ClosedLoop(CRAZYFLIE, gust=2.0), references, dt=0.008, key=keys[1])
    settings = jaxos4.VehicleSettings(terms=("offset", "lag", "delay", "accelerometer"), sample_time=0.008, holdout=0.0)
    (case,) = prepare_vehicle(
        as_recordings(flight), CRAZYFLIE, settings, estimator=None, bracket=None, network=None, validate=None
    )
    _, fit, (answer,) = fit_at_sample_times([case], progress=lambda stage: None)
    assert set(answer.constants) == {"Ix", "Iy", "Iz"}
    place = fit.problem.model.parameter_names.index("thrust_gain")
    unknown = np.asarray(fit.estimate.covariance).copy()
    unknown[place, place] = 0.45**2
    held = {"thrust_gain": HeldParameter(float(fit.estimate.parameters[place]), "1", "not identifiable")}
    weak = fit._replace(estimate=eqx.tree_at(lambda e: e.covariance, fit.estimate, jnp.asarray(unknown)), held=held)
    for name, row in vehicle_constants(weak).constants.items():
        assert row.estimate == pytest.approx(vehicle_constants(fit).constants[name].estimate)
        assert row.std > 0.4 * row.estimate
    assert not answer_of(case, weak, case.shooting.flight).constants
    # Noise of rotor speeds widens the intervals by 2.5 times its share, up to the limit of the doubt.
    for share, added in ((0.02, 0.05), (0.5, 0.125)):
        for name, row in vehicle_constants(fit, share).constants.items():
            clear = vehicle_constants(fit).constants[name]
            assert row.std == pytest.approx(np.hypot(clear.std, added * clear.estimate), rel=0.02)
            assert row.estimate == clear.estimate
    # Nor is a fit that says no more than the bracket, as when all samples settle the filters.
    unclear = fit._replace(held=dict.fromkeys(fit.problem.unknowns.names, held["thrust_gain"]))
    assert not answer_of(case, unclear, case.shooting.flight).constants
