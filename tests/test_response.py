"""Delays of the sensors after the rotors, in soft flight, where most of the torque answers gusts."""

import numpy as np
import pytest
from helpers import CRAZYFLIE

from experiments.verdicts.faults import late
from jaxos4.flight import RATES
from jaxos4.recording import Recording
from jaxos4.recording.checks import self_checks
from jaxos4.recording.checks.response import rotor_response

STEP, SECONDS, LAG, GAIN, INFLOW = 0.001, 40.0, 0.025, 28.0, 0.8
INERTIA, FORCE = np.array([1.7e-5, 1.9e-5]), np.array([12, 13, 14])


def soft_flight(seed, gust):
    """A rate controller of high gain in gusts of `gust` [rad/s^2], with slow references and with inflow."""
    rng, count = np.random.default_rng(seed), round(SECONDS / STEP)
    hover = float(CRAZYFLIE.mass * CRAZYFLIE.gravity)
    noise, gusts = 0.01 * rng.normal(size=(count, 2)), np.zeros((count, 2))
    for k in range(1, count):
        gusts[k] = gusts[k - 1] * (1 - STEP / 0.25) + gust * np.sqrt(2 * STEP / 0.25) * rng.normal(size=2)
    phases, time = rng.uniform(0, 6.3, (3, 4)), STEP * np.arange(count)
    frequencies = 2 * np.pi * np.array([0.35, 0.8, 1.5, 2.6])
    wanted = (np.array([0.6, 0.7, 0.8, 0.6]) * np.sin(frequencies * time[:, None, None] + phases)).sum(axis=2)
    rates, climb, forced = np.zeros(2), 0.0, np.array([0.0, 0.0, hover])
    log = np.zeros((count, 6))
    for k in range(count):
        felt = forced[2] / float(CRAZYFLIE.mass) - INFLOW * climb
        log[k] = [*forced, *(rates + noise[k]), felt]
        torque = INERTIA * GAIN * (0.5 * wanted[k, :2] - rates - noise[k])
        asked = np.array([*torque, hover + float(CRAZYFLIE.mass) * (wanted[k, 2] - climb)])
        forced = forced + STEP / LAG * (asked - forced)
        rates = rates + STEP * (forced[:2] / INERTIA + gusts[k] - 0.5 * rates)
        climb += STEP * (felt - float(CRAZYFLIE.gravity))
    rows = slice(None, None, 2)
    wrench = np.insert(log[rows, :3], 2, 0.0, axis=1)
    omega = np.sqrt(np.linalg.solve(np.asarray(CRAZYFLIE.mixer, dtype=float), wrench.T).T)
    states = np.full((len(omega), 12), np.nan)
    states[:, RATES] = np.column_stack([log[rows, 3:5], np.zeros(len(omega))])
    force = np.column_stack([0.2 * rng.normal(size=(len(omega), 2)), log[rows, 5] + 0.3 * rng.normal(size=len(omega))])
    return Recording(time[rows], omega, states, force, name="soft.csv")


@pytest.fixture(scope="module")
def soft():
    return [soft_flight(seed, gust=2.0) for seed in range(3)]


@pytest.mark.slow
def test_a_controller_and_inflow_make_no_sensor_late(soft):
    """By cross-spectra alone, the gyro seems 11 ms late, and the accelerometer 6 ms early."""
    for flight in soft:
        response = rotor_response([flight], CRAZYFLIE)
        assert response is not None
        _, (late, error), _ = response.delays.T
        assert abs(late) < 3 * error
        assert self_checks(flight, CRAZYFLIE) == ()


@pytest.mark.parametrize(("sensor", "seconds", "name"), [(FORCE, 0.04, "accelerometer"), (RATES, -0.03, "gyro")])
def test_a_late_sensor_is_found_in_soft_flight(soft, sensor, seconds, name):
    for flight in soft:
        (found,) = self_checks(late(sensor)(flight, seconds), CRAZYFLIE)
        assert f"the {name} is recorded" in found.cause
        assert found.contradicted
