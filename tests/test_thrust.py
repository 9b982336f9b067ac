"""The gain of the thrust of a vehicle whose controller answers gusts, simulated by NumPy."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from disturbances import piece
from helpers import CRAZYFLIE

import jaxos4
from jaxos4.flight import RATES
from jaxos4.shooting import InnovationsProblem
from jaxos4.shooting.gains import NoiseUnknowns

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


@eqx.filter_jit
def thrust_of(flight, noise_unknowns):
    """The gain of the thrust, whose truth is 1, and its standard deviation."""
    model = jaxos4.FlightModel(CRAZYFLIE, terms=("accelerometer",))
    problem = jaxos4.ShootingProblem(model, flight, sigma=np.full(12, 0.02), channels="rates", method="rk4")
    found = jaxos4.FilterError(tolerance=1e-3)(InnovationsProblem(problem, noise_unknowns=noise_unknowns))
    place = model.parameter_names.index("thrust_gain")
    return found.parameters[place], jnp.sqrt(found.covariance[place, place])


def test_the_thrust_is_right_if_a_controller_answers_smooth_gusts():
    """Eight flights. Without the filter of the disturbance, the thrust is 20 % too small, and sure of it."""
    rng = np.random.default_rng(1)
    flights = [hovering(rng, (1.0, 0.5, 0.05, 0.08)) for _ in range(8)]
    off = {}
    for name, kind in (("smooth", NoiseUnknowns()), ("abrupt", NoiseUnknowns(smoothing=1e-3, longest_smoothing=1e-3))):
        gain, std = np.array([thrust_of(flight, kind) for flight in flights]).T
        off[name] = (gain - 1) / std
    assert abs(off["smooth"].mean()) < 3 / np.sqrt(len(flights))
    assert 0.2 < np.square(off["smooth"]).mean() < 2.5  # 1 +- 0.5
    assert off["abrupt"].mean() < -3
