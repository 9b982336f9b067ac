"""The thrust of a vehicle whose controller answers gusts, simulated by NumPy, and the noise of its accelerometer."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from disturbances import piece
from helpers import CRAZYFLIE

import jaxos4
from jaxos4.flight import RATES
from jaxos4.shooting import InnovationsProblem, noise_unknowns
from jaxos4.shooting.gains import LogNoise

pytestmark = pytest.mark.slow

DT = 0.004


def hovering(rng, levels, samples=3000):
    """A vehicle that a controller keeps at its height through smooth gusts, as its accelerometer and motors log it.

    The controller knows the velocity from the accelerometer alone, as the filter does.
    """
    strength, tau, sensor, smoothing = levels
    moved, added = piece(DT, tau, smoothing)
    drive = strength**2 * (tau + smoothing) / tau
    first = np.array([[strength**2, strength**2], [strength**2, drive]])
    gust, part = np.linalg.cholesky(first) @ rng.normal(size=2), np.linalg.cholesky(drive * added[:2, :2])
    waves = np.exp(1j * np.outer(DT * np.arange(samples), [1.1, 2.3, 4.1, 7.3]))
    wanted = (waves @ (0.3 * rng.normal(size=4) * np.exp(2j * np.pi * rng.random(4)))).real
    mass, gravity = float(CRAZYFLIE.mass), float(CRAZYFLIE.gravity)
    velocity, thrust, force = 0.0, np.full(samples, gravity), np.full((samples, 3), np.nan)
    for k in range(samples):
        thrust[k] = gravity + wanted[k] - 4.0 * velocity
        # At the edge of two rows.
        force[k, 2] = (thrust[k - 1] + thrust[k]) / 2 + gust[0] + sensor * rng.normal()
        velocity += DT * (force[k, 2] - gravity)
        gust = moved[:2, :2] @ gust + part @ rng.normal(size=2)
    force[0], states = np.nan, np.full((samples, 12), np.nan)
    states[:, RATES] = 0.01 * rng.normal(size=(samples, 3))
    speeds = np.sqrt(mass * thrust / (4 * float(CRAZYFLIE.thrust_coefficient)))
    return jaxos4.Flight(DT * np.arange(samples), np.tile(speeds[:, None], 4), states, specific_force=force)


MODEL = jaxos4.FlightModel(CRAZYFLIE, terms=("accelerometer",))
PLACE = MODEL.parameter_names.index("thrust_gain")


def problem_of(flight, **settings):
    problem = jaxos4.ShootingProblem(MODEL, flight, sigma=np.full(12, 0.02), channels="rates", method="rk4")
    return InnovationsProblem(problem, **settings)


@eqx.filter_jit
def likelihood(flight, noise):
    return problem_of(flight, segments=1).innovations(MODEL.alpha, noise)


@pytest.mark.parametrize("averaged", [False, True])
def test_derivatives_in_the_noise_of_a_force_are_those_of_finite_differences(averaged):
    flight = hovering(np.random.default_rng(0), (1.0, 0.5, 0.05, 0.08), samples=300)
    flight = dataclasses.replace(flight, averaging_time=DT) if averaged else flight
    levels = np.log([[1.0] * 3 + [1.2], [0.1] * 3 + [0.4], [0.02] * 3 + [0.06], [1.0] * 3 + [0.05]])
    gradient = likelihood(flight, LogNoise(*jnp.asarray(levels))).gradient
    for i, step in enumerate(np.eye(4)):
        change = 1e-5 * np.outer(step, np.arange(4) == 3)
        costs = [likelihood(flight, LogNoise(*jnp.asarray(levels + sign * change))).cost.sum() for sign in (1, -1)]
        slope = (costs[0] - costs[1]) / 2e-5
        np.testing.assert_allclose(gradient[3, len(MODEL.alpha) + i].sum(), slope, rtol=1e-5)


@eqx.filter_jit
def thrust_of(flight):
    """The gain of the thrust, whose truth is 1, and its standard deviation."""
    found = jaxos4.FilterError(tolerance=1e-3)(problem_of(flight))
    return found.parameters[PLACE], jnp.sqrt(found.covariance[PLACE, PLACE])


@pytest.mark.usefixtures("optimised")
def test_the_thrust_is_right_if_a_controller_answers_smooth_gusts(monkeypatch):
    """Eight flights. Without the filter of the disturbance, the thrust is 20 % too small, and sure of it."""
    rng = np.random.default_rng(1)
    flights = [hovering(rng, (1.0, 0.5, 0.05, 0.08)) for _ in range(8)]
    off = {}
    for name in ("smooth", "abrupt"):
        gain, std = np.array([thrust_of(flight) for flight in flights]).T
        off[name] = (gain - 1) / std
        for constant in ("_SMOOTHING", "_LONGEST_SMOOTHING"):
            monkeypatch.setattr(noise_unknowns, constant, 1e-3)
        jax.clear_caches()
    assert abs(off["smooth"].mean()) < 3 / np.sqrt(len(flights))
    assert 0.2 < np.square(off["smooth"]).mean() < 2.5  # 1 +- 0.5
    assert off["abrupt"].mean() < -3
