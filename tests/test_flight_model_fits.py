"""Rotors of `FlightModel`, derivatives of its likelihood, and the truth from two recordings of one vehicle."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from flight_model_reference import FULL, VALUES, VOLTS, battery, commands, truth
from helpers import first_state, forcing_of, local_model

import jaxos4
from jaxos4.flight import Inputs, Stretches
from jaxos4.models.rotors import Batch, Grid, Motor, commanded_speeds
from jaxos4.models.state import CASCADE_ORDER


@pytest.mark.parametrize("counts", [(1,), (37,), (5, 1, 20, 11), (64, 64)])
def test_the_filter_is_the_recursion(counts):
    samples, dt, lag = sum(counts), 0.004, 0.05
    omega = np.random.default_rng(0).uniform(100, 400, (samples, 4))
    stretch = np.repeat(np.arange(len(counts)), counts)
    model = jaxos4.FlightModel(FULL, terms=("lag", "reaction", "accelerometer"))
    values = truth(model).at[model.parameter_names.index("rotor_lag")].set(lag)
    stretches = None if len(counts) == 1 else Stretches.of(jnp.asarray(stretch))
    found = forcing_of(model, Inputs(jnp.asarray(omega), jnp.asarray(dt), stretches=stretches), values)
    decay, here = np.exp(-dt / lag), np.empty_like(omega)
    for k in range(samples):
        restart = k == 0 or stretch[k] != stretch[k - 1]
        here[k] = omega[k] if restart else decay * here[k - 1] + (1 - decay) * omega[k - 1]
    following = decay * here + (1 - decay) * omega
    squares = (here**2 + here * following + following**2) / 3
    b, m, spins = float(FULL.thrust_coefficient), float(FULL.mass), np.asarray(FULL.rotor_spins)
    torques = squares @ np.asarray(FULL.mixer).T
    for value, expected in (
        (found.sensed_specific_thrust, b / m * (here**2).sum(axis=1)),
        (found.mean_specific_thrust, b / m * squares.sum(axis=1)),
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
        thrust = np.asarray(plain.mean_specific_thrust)
        assert np.abs(found.mean_specific_thrust - thrust)[5:].max() < 0.1 * np.ptp(thrust)


@jax.jit
def delayed(omega, delay, dt=0.01, stretch=None):
    model = jaxos4.FlightModel(terms=("delay",))
    inputs = Inputs(jnp.asarray(omega), jnp.asarray(dt), stretches=None if stretch is None else Stretches.of(stretch))
    return model.forcing(inputs, model.alpha.at[8].set(delay)).residual_speed


@pytest.mark.parametrize("samples", [-3, 0, 1, 7])
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


@pytest.mark.parametrize("delay", [0.0, 0.0004])
def test_later_speeds_have_no_influence(delay):
    """They hold what the controller answers to a measurement, which a prediction must not know; nor may its slopes."""
    speeds, known = np.random.default_rng(0).uniform(100, 400, (10, 4, 4)), 6
    other = np.concatenate([speeds[:known], speeds[known:] + 50])
    model = jaxos4.FlightModel(terms=("delay", "reaction"))

    @jax.jit
    def forced(within):
        inputs = Inputs(within.mean(axis=1), jnp.asarray(0.004), within=within)
        at = model.alpha.at[8].set(delay)
        return jax.jvp(lambda parameters: model.centered_forcing(inputs, parameters), (at,), (jnp.eye(at.size)[8],))

    (found, slopes), (others, other_slopes) = (forced(jnp.asarray(each)) for each in (speeds, other))
    for one, another in zip(*map(jax.tree.leaves, ((found, slopes), (others, other_slopes))), strict=True):
        np.testing.assert_array_equal(one[:known], another[:known])
    for one, another in ((found, others), (slopes, other_slopes)):
        assert (one.spin_up[known:] != another.spin_up[known:]).any()


@pytest.mark.slow
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
        rows = jnp.arange(omega.shape[0])
        grid = Grid(jnp.asarray(dt / finer), 0 * rows, 0 * rows, 0 * rows + rows.size - 1, 0.0 * rows)
        speeds = eqx.filter_jit(commanded_speeds)(omega, motor, Batch(grid, rows, jnp.zeros(4)))
        return np.abs(np.asarray(speeds.begin[::finer, 0]) / 500 - exact).max()

    u = commands[0, 0] / 500
    w, exact = 2 * u / (0.7 + np.sqrt(0.49 + 1.2 * u)), []
    for k in range(60):
        exact.append(float(np.squeeze(w)))
        inside = (k * dt + 1e-7, (k + 1) * dt - 1e-7)
        w = scipy.integrate.solve_ivp(slope, inside, np.atleast_1d(w), rtol=1e-10, atol=1e-12).y[:, -1]
    coarse, fine = error(1), error(4)
    assert coarse < 3e-3
    assert fine < coarse / 10


RIGID = ("alpha1", "alpha2", "alpha4", "alpha5", "alpha7")


def two_flights(model, *, windows=2, dt=0.01, seconds=2.0, noise=0.0, channels="rates"):
    """Two stretches, flown by the model itself and seen by its sensors."""
    parts, rng = [], np.random.default_rng(0)
    alone = jaxos4.FlightModel(model.airframe, terms=model.terms, battery_voltage=model.battery_voltage)
    values = dict(zip(model.parameter_names, truth(model).tolist(), strict=True))
    for i, recording in enumerate(model.recordings if len(model.recordings) == 2 else (0, 0)):
        omega = commands(seconds, dt, hold=dt)[:: 1 - 2 * i][:-1]
        time, voltage = dt * np.arange(omega.shape[0]), battery(omega.shape[0], dt) - 0.5 * i
        own = jnp.array([values.get(n, values.get(f"{n}_{recording + 1}")) for n in alone.parameter_names])
        states, force = np.full((time.size, 12), np.nan), np.full((time.size, 3), np.nan)
        blank = jaxos4.Flight(time, omega, states, voltage=voltage)
        problem = jaxos4.ShootingProblem(alone, blank, sigma=np.ones(12), channels=channels)
        found = np.asarray(problem.predict(own, jnp.zeros(problem.size)))
        states[:, CASCADE_ORDER[: problem.size]] = found[:, : problem.size]
        force[:, list(alone.force_axes)] = found[:, problem.size :]
        states, force = states + rng.normal(0, noise, states.shape), force + rng.normal(0, 10 * noise, force.shape)
        parts.append(jaxos4.Flight(time, omega, states, force, voltage=voltage))
    flight = jaxos4.join(parts, length=round(2 * seconds / dt / windows))
    return jaxos4.ShootingProblem(model, flight, sigma=jaxos4.SENSOR_SIGMA, channels=channels, windows=windows)


MOTORS = ("offset", "motor", "delay", "accelerometer", "gyro_bias")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("terms", "recordings", "channels"),
    [(MOTORS, (0, 0), "rates"), (MOTORS, (0, 1), "rates"), (("velocity",), (0,), "all"), (("drag",), (0,), "all")],
)
def test_gradient_and_information_are_the_residuals_derivatives(terms, recordings, channels):
    """Also where the structure of a model says that they are zero. A velocity that makes torque feeds back."""
    model = jaxos4.FlightModel(FULL, terms=terms, recordings=recordings)
    problem = two_flights(model, windows=4, noise=0.01, channels=channels)
    count = len(problem.model.parameter_names)
    parameters = truth(problem.model) * 1.03
    unknowns = jnp.concatenate([parameters, first_state(problem)])

    def residuals(u):
        found = problem.residuals(u[:count], u[count:])
        return found, found

    jacobian, errors = map(np.asarray, jax.jit(jax.jacfwd(residuals, has_aux=True))(unknowns))
    scale = np.linalg.norm(jacobian, axis=0)
    found = local_model(problem, parameters, unknowns[count:])
    own = problem.size
    for w in range(4):
        columns = np.r_[:count, count + w * own : count + (w + 1) * own]
        rows = np.repeat(np.nonzero(problem.window_samples()[1])[0] == w, problem.columns.size)
        expected = jacobian[rows][:, columns]
        size = np.outer(scale[columns], scale[columns])
        np.testing.assert_allclose(found.information[w] / size, expected.T @ expected / size, atol=1e-10)
        gradient = expected.T @ errors[rows] / scale[columns] / np.linalg.norm(errors)
        np.testing.assert_allclose(found.gradient[w] / scale[columns] / np.linalg.norm(errors), gradient, atol=1e-10)
        assert float(found.cost[w]) == pytest.approx(0.5 * float(errors[rows] @ errors[rows]), rel=1e-10)


def held_rigid(problem, values):
    """The problem with the parameters of `RIGID` held at their values."""
    return problem.hold({name: values[problem.unknowns.names.index(name)] for name in RIGID})


def assert_held(found, values):
    """The parameters of `RIGID` have their values and no error."""
    places = [int(name[-1]) - 1 for name in RIGID]
    np.testing.assert_array_equal(found.parameters[np.array(places)], values[np.array(places)])
    assert not np.asarray(found.covariance)[places].any()


@pytest.mark.slow
def test_the_truth_is_found_without_noise():
    """The offsets of two recordings differ, and each is found. The attitude tells them from biases of the gyro."""
    model = jaxos4.FlightModel(FULL, terms=("offset", "gyro_bias"), recordings=(0, 1))
    whole, half_width = truth(model), model.half_width
    problem = held_rigid(two_flights(model, channels="attitude"), whole)
    off = 0.4 * jnp.cos(jnp.arange(whole.size)) * half_width
    found = jaxos4.IBSS()(problem, jaxos4.Bracket.around(whole + off, half_width))
    np.testing.assert_array_less(np.abs(found.parameters - whole) / half_width, 1e-4)
    assert_held(found, whole)


@pytest.mark.slow
def test_the_centre_of_mass_and_the_effect_of_the_voltage_are_found():
    model = jaxos4.FlightModel(FULL, terms=("offset", "center_of_mass", "voltage", "delay"), battery_voltage=VOLTS)
    whole = truth(model)
    problem = held_rigid(two_flights(model, seconds=3.0, noise=1e-4), whole)
    problem = eqx.tree_at(lambda p: p.sigma, problem, jnp.full_like(problem.sigma, 1e-4))
    found = jaxos4.OutputError()(problem)
    assert np.all(found.std < 0.1 * model.half_width)
    assert np.all(np.abs(found.parameters - whole) <= 4 * found.std)
    assert_held(found, whole)
    alpha, mass = jaxos4.CorrectedOS4(FULL).alpha, float(FULL.mass)
    expected = {
        "x": VALUES["pitch_thrust"] / (float(alpha[5]) * mass),
        "y": -VALUES["roll_thrust"] / (float(alpha[2]) * mass),
    }
    coordinates = jaxos4.center_of_mass(model.parameter_names, found.parameters, found.covariance, FULL)
    assert [c.axis for c in coordinates] == ["x", "y"]
    for c in coordinates:
        assert abs(c.value - expected[c.axis]) < 4 * c.std
        assert c.std < 0.05 * abs(c.value)
    assert jaxos4.center_of_mass(model.parameter_names[:2], whole[:2], np.eye(2), FULL) == ()


@pytest.mark.slow
def test_the_error_of_the_centre_of_mass_is_that_of_the_quotient():
    names, values = ("pitch_thrust", "roll_thrust", "alpha6", "alpha3"), np.array([0.9, -0.5, 133.0, 120.0])
    rng = np.random.default_rng(0)
    spread = rng.normal(size=(4, 4)) * values[:, None] * 0.01
    covariance = spread @ spread.T
    draws = rng.multivariate_normal(values, covariance, 200_000)
    expected = draws[:, 0] / draws[:, 2] / 0.65, -draws[:, 1] / draws[:, 3] / 0.65
    for found, sample in zip(jaxos4.center_of_mass(names, values, covariance, FULL), expected, strict=True):
        assert found.value == pytest.approx(sample.mean(), rel=1e-3)
        assert found.std == pytest.approx(sample.std(), rel=0.02)
