"""Estimates of `FlightModel`: derivatives of its likelihood, and the truth from two recordings of one vehicle."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import curvatures, first_state
from test_flight_model import FULL, VALUES, VOLTS, battery, commands, truth

import jaxos4
from jaxos4.models.state import CASCADE_ORDER

RIGID = ("alpha1", "alpha2", "alpha4", "alpha5", "alpha7")


def two_flights(model, *, windows=2, dt=0.01, seconds=2.0, noise=0.0, channels="rates"):
    """Two stretches, flown by the model itself and seen by its sensors."""
    parts, rng = [], np.random.default_rng(0)
    recordings = model.recordings if len(model.recordings) == 2 else (0, 0)
    for i, recording in enumerate(recordings):
        omega = commands(seconds, dt, hold=dt)[:: 1 - 2 * i][:-1]
        alone = jaxos4.FlightModel(model.airframe, terms=model.terms, battery_voltage=model.battery_voltage)
        voltage = battery(omega.shape[0], dt) - 0.5 * i
        values = dict(zip(model.parameter_names, truth(model).tolist(), strict=True))
        own = jnp.array([values.get(n, values.get(f"{n}_{recording + 1}")) for n in alone.parameter_names])
        time = dt * np.arange(omega.shape[0])
        blank = jaxos4.Flight(time, omega, np.full((omega.shape[0], 12), np.nan), voltage=voltage)
        problem = jaxos4.ShootingProblem(alone, blank, sigma=np.ones(12), channels=channels)
        found = np.asarray(problem.predict(own, jnp.zeros(problem.size)))
        states, force = np.full((omega.shape[0], 12), np.nan), np.full((omega.shape[0], 3), np.nan)
        states[:, CASCADE_ORDER[: problem.size]] = found[:, : problem.size]
        force[:, list(alone.force_axes)] = found[:, problem.size :]
        states, force = states + rng.normal(0, noise, states.shape), force + rng.normal(0, 10 * noise, force.shape)
        parts.append(jaxos4.Flight(time, omega, states, force, voltage=voltage))
    flight = jaxos4.join(parts, length=round(2 * seconds / dt / windows))
    return jaxos4.ShootingProblem(model, flight, sigma=jaxos4.SENSOR_SIGMA, channels=channels, windows=windows)


@pytest.mark.parametrize("recordings", [(0, 0), (0, 1)])
def test_gradient_and_information_are_the_residuals_derivatives(recordings):
    terms = ("offset", "motor", "delay", "accelerometer", "gyro_bias")
    problem = two_flights(jaxos4.FlightModel(FULL, terms=terms, recordings=recordings), windows=4, noise=0.01)
    count = len(problem.model.parameter_names)
    parameters = truth(problem.model) * 1.03
    unknowns = jnp.concatenate([parameters, first_state(problem)])

    def residuals(u):
        found = problem.residuals(u[:count], u[count:])
        return found, found

    jacobian, errors = map(np.asarray, jax.jit(jax.jacfwd(residuals, has_aux=True))(unknowns))
    scale = np.linalg.norm(jacobian, axis=0)
    found = curvatures(problem, parameters, unknowns[count:])
    own = problem.size
    for w in range(4):
        columns = np.r_[:count, count + w * own : count + (w + 1) * own]
        rows = np.repeat(problem.window_of_samples() == w, problem.columns.size)
        expected = jacobian[rows][:, columns]
        size = np.outer(scale[columns], scale[columns])
        np.testing.assert_allclose(found.information[w] / size, expected.T @ expected / size, atol=1e-10)
        gradient = expected.T @ errors[rows] / scale[columns] / np.linalg.norm(errors)
        np.testing.assert_allclose(found.gradient[w] / scale[columns] / np.linalg.norm(errors), gradient, atol=1e-10)
        assert float(found.shot.cost[w]) == pytest.approx(0.5 * float(errors[rows] @ errors[rows]), rel=1e-10)


def held_rigid(problem, values):
    """The problem with the parameters of `RIGID` held at their values."""
    return problem.hold({name: values[problem.unknowns.names.index(name)] for name in RIGID})


def assert_held(found, values):
    """The parameters of `RIGID` have their values and no error."""
    places = [int(name[-1]) - 1 for name in RIGID]
    np.testing.assert_array_equal(found.parameters[np.array(places)], values[np.array(places)])
    assert not np.asarray(found.covariance)[places].any()


@pytest.mark.parametrize(
    ("estimator", "terms", "channels"),
    [
        (jaxos4.IBSS(), ("offset", "lag", "delay"), "rates"),
        (jaxos4.OutputError(), ("offset", "lag", "delay"), "rates"),
        (jaxos4.IBSS(), ("offset", "gyro_bias"), "attitude"),
    ],
)
def test_the_truth_is_found_without_noise(estimator, terms, channels):
    """The offsets of two recordings differ, and each is found. The attitude tells them from biases of the gyro."""
    model = jaxos4.FlightModel(FULL, terms=terms, recordings=(0, 1))
    whole = truth(model)
    problem, half_width = held_rigid(two_flights(model, channels=channels), whole), model.half_width
    off = 0.4 * jnp.cos(jnp.arange(whole.size)) * half_width
    found = estimator(problem, jaxos4.Bracket.around(whole + off, half_width))
    np.testing.assert_array_less(np.abs(found.parameters - whole) / half_width, 1e-4)
    assert_held(found, whole)


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
