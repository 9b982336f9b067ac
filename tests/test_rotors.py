"""The rotors of `FlightModel`: lag and delay are the recursions and shifts that their equations say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from helpers import forcing_of
from test_flight_model import FULL, commands, truth

import jaxos4
from jaxos4.flight import Inputs, Stretches
from jaxos4.models.rotors import Grid, Motor, driven


@pytest.mark.parametrize("counts", [(1,), (2,), (37,), (5, 1, 20, 11), (1, 1, 1), (64, 64)])
def test_the_filter_is_the_recursion(counts):
    samples, dt, lag = sum(counts), 0.004, 0.05
    omega = np.random.default_rng(0).uniform(100, 400, (samples, 4))
    stretch = np.repeat(np.arange(len(counts)), counts)
    model = jaxos4.FlightModel(FULL, terms=("lag", "reaction", "accelerometer"))
    values = dict(zip(model.parameter_names, truth(model).tolist(), strict=True)) | {"rotor_lag": lag}
    given = None if len(counts) == 1 else jnp.asarray(stretch)
    inputs = Inputs(jnp.asarray(omega), jnp.asarray(dt), stretches=None if given is None else Stretches.of(given))
    found = forcing_of(model, inputs, jnp.array(list(values.values())))
    decay, here = np.exp(-dt / lag), np.empty_like(omega)
    for k in range(samples):
        restart = k == 0 or stretch[k] != stretch[k - 1]
        here[k] = omega[k] if restart else decay * here[k - 1] + (1 - decay) * omega[k - 1]
    following = decay * here + (1 - decay) * omega
    squares = (here**2 + here * following + following**2) / 3
    b, m, spins = float(FULL.thrust_coefficient), float(FULL.mass), np.asarray(FULL.rotor_spins)
    torques = squares @ np.asarray(FULL.mixer).T
    for value, expected in (
        (found.specific_thrust, b / m * (here**2).sum(axis=1)),
        (found.thrust, b / m * squares.sum(axis=1)),
        (found.spin_up, (following - here) @ spins / dt),
        (found.residual_speed, (here + following) @ spins / 2),
        *zip((found.roll, found.pitch, found.yaw), torques.T[:3], strict=True),
    ):
        np.testing.assert_allclose(value, expected, rtol=1e-11, atol=1e-11 * np.abs(expected).max() + 1e-15)


def test_a_lag_below_the_shortest_is_the_shortest():
    model = jaxos4.FlightModel(terms=("lag",))
    omega = jnp.asarray(commands(0.5, 0.01))
    inputs, plain = Inputs(omega, jnp.asarray(0.01)), jaxos4.CorrectedOS4()
    plain = forcing_of(plain, inputs, plain.alpha)
    for lag in (-1.0, 0.0, 1e-6):
        found = forcing_of(model, inputs, model.alpha.at[8].set(lag))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found) if leaf is not None)
        # The difference is the straight line over the sample in which the command changes.
        assert np.abs(found.thrust - plain.thrust)[5:].max() < 0.1 * np.ptp(np.asarray(plain.thrust))


@jax.jit
def delayed(omega, delay, dt=0.01, stretch=None):
    model = jaxos4.FlightModel(terms=("delay",))
    inputs = Inputs(jnp.asarray(omega), jnp.asarray(dt), stretches=None if stretch is None else Stretches.of(stretch))
    return model.forcing(inputs, model.alpha.at[8].set(delay)).residual_speed


@pytest.mark.parametrize("samples", [-3, -1, 0, 1, 2, 7])
def test_whole_delays_are_exact(samples):
    counts = (30, 12, 1, 4)
    omega = np.random.default_rng(0).uniform(100, 400, (sum(counts), 4))
    begin, end = (np.repeat(ends, counts) for ends in (np.cumsum((0, *counts[:-1])), np.cumsum(counts) - 1))
    row = np.clip(np.arange(sum(counts)) - samples, begin, end)
    found = delayed(omega, 0.01 * samples, stretch=jnp.asarray(np.repeat(np.arange(4), counts)))
    np.testing.assert_allclose(found, omega[row] @ np.asarray(jaxos4.OS4.rotor_spins), rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("delay", [0.0031, 0.0149, 0.0377, -0.0121])
def test_parabolas_are_delayed_exactly(delay):
    def speeds(t):
        return np.stack([200 + 30 * t, 210 - 500 * t**2, 190 + 100 * t**2, 200 + 0 * t], axis=1)

    t = 0.01 * np.arange(60)
    expected = speeds(t - delay) @ np.asarray(jaxos4.OS4.rotor_spins)
    np.testing.assert_allclose(delayed(speeds(t), delay)[8:-8], expected[8:-8], rtol=1e-10, atol=1e-9)


def test_the_delay_has_a_continuous_derivative():
    omega = np.random.default_rng(0).uniform(100, 400, (40, 4))
    slope = jax.jit(jax.jacfwd(lambda delay: delayed(omega, delay)))
    size = np.abs(slope(0.0123)).max()
    for whole in (0.0, 0.01, 0.02, -0.01):
        below, above = slope(whole - 1e-9), slope(whole + 1e-9)
        np.testing.assert_allclose(below, above, atol=1e-5 * size)
        np.testing.assert_allclose(delayed(omega, whole - 1e-9), delayed(omega, whole + 1e-9), atol=1e-3)
    middle = 0.0137
    difference = (delayed(omega, middle + 1e-7) - delayed(omega, middle - 1e-7)) / 2e-7
    np.testing.assert_allclose(slope(middle), difference, rtol=1e-5, atol=1e-5 * size)


def test_a_motor_is_its_equation():
    """Its steps are of second order, with a load and with weak braking, and agree with scipy's integration."""
    motor, dt = Motor(lag=0.06, curve=0.7, braking=0.2, full=500.0), 0.02
    commands = np.random.default_rng(0).uniform(50, 450, (60, 4))

    def slope(t, w):
        u = commands[min(int(t / dt + 1e-9), 59), 0] / 500
        x = u - 0.7 * w
        torque = np.where(x < 0, 0.2 * x - 0.8 * 0.005 * (1 - np.exp(np.minimum(x, 0) / 0.005)), x)
        return (torque - 0.3 * w * w) / 0.06

    def error(finer):
        omega = jnp.asarray(np.repeat(commands, finer, axis=0))
        samples, zeros = omega.shape[0], jnp.zeros(omega.shape[0], dtype=int)
        grid = Grid(jnp.asarray(dt / finer), zeros, zeros, zeros + samples - 1, jnp.zeros(samples))
        return np.abs(np.asarray(jax.jit(driven)(omega, motor, grid).begin[::finer, 0]) / 500 - exact).max()

    u = commands[0, 0] / 500
    w, exact = 2 * u / (0.7 + np.sqrt(0.49 + 1.2 * u)), []
    for k in range(60):
        exact.append(float(np.squeeze(w)))
        inside = (k * dt + 1e-7, (k + 1) * dt - 1e-7)
        w = scipy.integrate.solve_ivp(slope, inside, np.atleast_1d(w), rtol=1e-10, atol=1e-12).y[:, -1]
    coarse, fine = error(1), error(4)
    assert coarse < 3e-3
    assert fine < coarse / 10
