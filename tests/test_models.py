"""Laws of all models; the OS4 models against their equations written a second time and against rigid-body mechanics."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    OS4,
    REFERENCES,
    euler_trajectory,
    forcing_of,
    published_derivative,
    standard_flight,
    standard_problem,
)
from scipy.spatial.transform import Rotation

import jaxos4
from jaxos4.flight import Inputs
from jaxos4.models.state import CASCADE_ORDER, Rates

every_os4 = pytest.mark.parametrize("model_class", REFERENCES)
VEHICLE = jaxos4.FlightModel(terms=("offset", "damping", "lag", "delay", "accelerometer", "drag", "gyro_bias"))
MODELS = {
    "published": jaxos4.PublishedOS4(),
    "corrected": jaxos4.CorrectedOS4(jaxos4.VOOS),
    "no terms": jaxos4.FlightModel(terms=()),
    "vehicle": VEHICLE,
}
every_model = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)

BODY_RATE, ANGLE, PITCH, LENGTH = 5.0, 4.0, 1.4, 20.0
LARGEST = np.array([*[LENGTH] * 6, ANGLE, BODY_RATE, PITCH, BODY_RATE, ANGLE, BODY_RATE])
LARGEST_ALPHA = np.array([2.0, 0.2, 300.0, 2.0, 0.2, 300.0, 1.0, 200.0])
derivative = eqx.filter_jit(lambda model, *args: model.derivative(*args))
derivatives = eqx.filter_jit(lambda model, *args: jax.vmap(model.derivative)(*args))


def random_points(count, seed=0):
    """States, rotor speeds and parameters, spread far beyond what flies."""
    rng = np.random.default_rng(seed)
    state = rng.uniform(-1, 1, (count, 12)) * LARGEST
    return state, rng.uniform(0, 400, (count, 4)), rng.uniform(-1, 1, (count, 8)) * LARGEST_ALPHA


def assert_same(actual, expected):
    """To 1e-12 of each state's own derivative, or of its largest term where terms cancel."""
    scale = np.maximum(np.abs(expected), np.abs(expected).max(axis=0, keepdims=True) if expected.ndim > 1 else 1.0)
    np.testing.assert_array_less(np.abs(np.asarray(actual) - expected), 1e-12 * scale + 1e-13)


def differs(actual, expected):
    with pytest.raises(AssertionError):
        assert_same(actual, expected)
    return True


@every_os4
@pytest.mark.parametrize("seed", [None, 0, 1, 2])
def test_agrees_for_any_constants(model_class, seed):
    """`None`: those of the OS4."""
    rng, constants = np.random.default_rng(seed), OS4
    if seed is not None:
        constants = {name: value * rng.uniform(0.3, 3) for name, value in OS4.items()}
    names = {"mass": "m", "thrust_coefficient": "b", "drag_coefficient": "d", "gravity": "g"}
    given = {name: constants[symbol] for name, symbol in names.items()}
    airframe = dataclasses.replace(jaxos4.OS4, rotor_positions=jaxos4.plus_layout(constants["L"]), **given)
    points = random_points(2000, seed or 0)
    assert_same(derivatives(model_class(airframe), *points), REFERENCES[model_class](*points, constants))


@every_os4
def test_the_whole_standard_flight_agrees(model_class):
    model, flight = model_class(), standard_flight(model_class)
    assert flight.states.shape == (501, 12)
    expected = euler_trajectory(REFERENCES[model_class], np.asarray(model.alpha), flight.omega)
    scale = np.abs(expected).max(axis=0)
    assert (np.abs(flight.states - expected) / scale).max() < 1e-12
    predicted = standard_problem(model_class).predict(model.alpha, flight.states[0, CASCADE_ORDER])
    assert (np.abs(predicted - expected[:, CASCADE_ORDER]) / scale[CASCADE_ORDER]).max() < 1e-12


# The tests above can fail: they reject each of these wrong references.


def test_the_models_differ_in_three_places():
    points = random_points(2000)
    different = np.abs(derivatives(jaxos4.CorrectedOS4(), *points) - published_derivative(*points)).max(axis=0) > 1e-6
    assert set(np.array(jaxos4.STATE_NAMES)[different]) == {"vx", "vy", "p", "q"}


@every_os4
@pytest.mark.parametrize("wrong", [*range(8), *OS4])
def test_an_error_of_a_millionth_fails(model_class, wrong):
    """In a parameter, or in a constant."""
    (state, omega, alpha), constants = random_points(2000), dict(OS4)
    off = alpha * (1 + 1e-6 * (np.arange(8) == wrong))
    if wrong in constants:
        constants[wrong] *= 1 + 1e-6
    expected = REFERENCES[model_class](state, omega, alpha, constants)
    assert differs(derivatives(model_class(), state, omega, off), expected)


# The corrected model is a rigid body: textbook mechanics, with vectors and matrices.


def rotation(phi, theta, psi):
    """Body to earth, of angles that may be complex: yaw about z, then pitch about y, then roll about x."""
    (cx, sx), (cy, sy), (cz, sz) = ((np.cos(angle), np.sin(angle)) for angle in (phi, theta, psi))
    yaw, pitch = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]), np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return yaw @ pitch @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])


ODD_LAYOUT = jaxos4.Airframe(
    mass=0.7,
    inertia=(0.0071, 0.0083, 0.0127),
    rotor_positions=[(0.21, 0.02), (-0.01, -0.25), (-0.19, 0.03), (0.05, 0.22)],
    rotor_spins=(-1.0, 1.0, -1.0, 1.0),
    thrust_coefficient=2.7e-5,
    drag_coefficient=9e-7,
    rotor_inertia=5e-5,
    gravity=9.7,
)


@pytest.mark.parametrize("airframe", [jaxos4.OS4, ODD_LAYOUT], ids=["os4", "odd"])
def test_the_corrected_model_is_a_rigid_body(airframe):
    model = jaxos4.CorrectedOS4(airframe)
    states, omegas, _ = random_points(100, seed=1)
    actual = derivatives(model, states, omegas, np.tile(model.alpha, (100, 1)))
    inertia, arms = np.diag(airframe.inertia), np.pad(airframe.rotor_positions, ((0, 0), (0, 1)))
    up, spins = np.array([0.0, 0.0, 1.0]), np.asarray(airframe.rotor_spins)
    for dx, x, omega in zip(np.asarray(actual), states, omegas, strict=True):
        angles, rates, close = x[[6, 8, 10]], x[[7, 9, 11]], {"rtol": 1e-12, "atol": 1e-11}
        body = rotation(*angles)
        np.testing.assert_allclose(body, Rotation.from_euler("ZYX", angles[::-1]).as_matrix(), atol=1e-14)
        force = airframe.thrust_coefficient * omega[:, None] ** 2 * up
        drag = -spins[:, None] * airframe.drag_coefficient * omega[:, None] ** 2 * up
        acceleration = body @ force.sum(axis=0) / airframe.mass - airframe.gravity * up
        np.testing.assert_allclose(dx[[1, 3, 5]], acceleration, **close)
        # Euler's equations, with the angular momentum of the rotors.
        momentum = inertia @ rates + airframe.rotor_inertia * (spins @ omega) * up
        torque = np.cross(arms, force).sum(axis=0) + drag.sum(axis=0)
        acceleration = np.linalg.solve(inertia, torque - np.cross(rates, momentum))
        np.testing.assert_allclose(dx[[7, 9, 11]], acceleration, **close)
        # dR/dt = R [rates]x, with R's derivative by a complex step.
        turning = np.imag(rotation(*(angles + 1e-30j * dx[[6, 8, 10]]))) / 1e-30
        np.testing.assert_allclose(body.T @ turning, np.cross(np.eye(3), rates), atol=1e-12)


# Laws of every model.


@every_model
def test_the_table_of_parameters_is_complete(model):
    size = len(model.parameters)
    assert len(set(model.parameter_names)) == len(model.parameter_units) == size
    for values in (model.alpha, model.half_width):
        assert (values.shape, values.dtype) == ((size,), jnp.float64)
        assert np.isfinite(values).all()
    assert (np.asarray(model.half_width) > 0).all()


@every_model
def test_the_table_says_what_the_parameters_do(model):
    """The forcing depends on the parameters that say so, and the rates linearly on all others that say so."""
    inputs = Inputs(standard_flight().omega[:20], jnp.asarray(0.01), velocity=jnp.ones((20, 3)))
    at = model.alpha + 0.1 * model.half_width
    slopes = jax.tree.leaves(jax.jit(jax.jacfwd(lambda x: model.forcing(inputs, x)))(at))
    acting = {i for i in range(at.size) if any((np.asarray(slope)[..., i] != 0).any() for slope in slopes)}
    assert acting == set(model.forcing_parameters)
    row = jax.tree.map(lambda leaf: np.asarray(leaf)[3], forcing_of(model, inputs, at))
    rates = Rates(*jnp.array([0.3, -0.2, 0.1]))
    bend = jax.jit(jax.hessian(lambda x: jnp.stack(model.angular_acceleration(rates, row, x))))(at)
    half_width = np.asarray(model.half_width)
    bend = np.abs(bend * half_width * half_width[:, None]).max(axis=0)
    assert (np.delete(np.diagonal(bend), list(acting)) <= 1e-12).all()


@every_os4
def test_parameters_have_names_units_and_the_thesis_values(model_class):
    model, published = model_class(), model_class is jaxos4.PublishedOS4
    assert model.parameter_names == tuple(f"alpha{i}" for i in range(1, 9))
    assert model.parameter_units[1] == model.parameter_units[4] == ("1/s" if published else "1")
    second = 6e-5 / 7.5e-3 * (7.5e-7 if published else 1)
    expected = [-5.5 / 7.5, second, 1 / 7.5e-3, 5.5 / 7.5, second, 1 / 7.5e-3, 0, 1 / 1.3e-2]
    np.testing.assert_allclose(model.alpha, expected, rtol=1e-14)
    np.testing.assert_array_equal(model.half_width, jaxos4.DEFAULT_HALF_WIDTH)
    # Half-widths scale with another airframe.
    share, inertia = model_class(jaxos4.VOOS).half_width / model.half_width, jaxos4.OS4.inertia / jaxos4.VOOS.inertia
    np.testing.assert_allclose(share, [1, 1, inertia[0], 1, 1, inertia[1], 1, inertia[2]])
