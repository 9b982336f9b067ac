"""`FlightModel`: each term against its equation written a second time, names and brackets, and a new term."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from flight_model_reference import FULL, NAMES, NAMES_XY, VALUES, VOLTS, battery, commands, reference, truth

import jaxos4
from jaxos4.models import default_terms
from jaxos4.models.flight_model import DEFAULT_TERMS
from jaxos4.models.terms import (
    COMMANDS,
    FULL_SCALE,
    LATERAL_FORCE,
    MEASURED_VELOCITY,
    VELOCITY,
    VERTICAL_FORCE,
    VOLTAGE,
)

ALL = tuple(term for term in jaxos4.TERMS if term != "lag")  # the motor has a lag of its own
RATE_TERMS = tuple(term for term in ALL if term not in ("velocity", "inflow", "drag"))


def seen(model, omega, dt, *, method="rk4"):
    """What the model's sensors show, from rest, beside the flight."""
    samples = omega.shape[0]
    blank = jaxos4.Flight(dt * np.arange(samples), omega, np.full((samples, 12), np.nan), voltage=battery(samples, dt))
    problem = jaxos4.ShootingProblem(model, blank, sigma=np.ones(12), initial_state=np.zeros(12), method=method)
    return np.asarray(problem.predict(truth(model), jnp.zeros(12)))


def test_without_terms_it_is_the_corrected_model():
    model, plain = jaxos4.FlightModel(terms=()), jaxos4.CorrectedOS4()
    np.testing.assert_array_equal(model.alpha, plain.alpha)
    np.testing.assert_array_equal(model.half_width, plain.half_width)
    assert model.parameters == plain.parameters
    assert (model.forcing_parameters, model.force_axes, model.observes_states) == ((), (), True)
    omega = jaxos4.multisine(jaxos4.OS4, duration=2.0)
    for method in ("euler", "rk4"):
        flights = [jaxos4.simulate(m, plain.alpha, omega, dt=0.01, method=method).states for m in (model, plain)]
        np.testing.assert_allclose(*flights, rtol=1e-11, atol=1e-12)


TOLERANCES = {
    ("offset", "damping", "velocity", "gyro_bias"): 1e-7,
    ("offset", "center_of_mass"): 1e-7,
    ("voltage", "accelerometer"): 1e-7,
    ("motor", "accelerometer"): 3e-3,
    ("fade", "accelerometer"): 1e-7,
    ("accelerometer", "drag", "inflow"): 1e-7,
    ("accelerometer", "drag"): 1e-7,
    ("lag", "delay", "reaction"): 2e-3,
    ALL: 2e-3,
}


@pytest.mark.parametrize("terms", TOLERANCES)
def test_terms_are_their_equations(terms):
    """Inputs are held, so that without a lag only Runge-Kutta errs; with one, straight lines over samples do."""
    dt = 0.005
    omega = commands(0.8, dt)
    model = jaxos4.FlightModel(FULL, terms=terms, battery_voltage=VOLTS)
    found = seen(model, omega, dt)
    states, force = reference(terms, omega, dt, fine=3)
    expected = np.concatenate([states, force[:, list(model.force_axes)]], axis=1)
    assert found.shape == expected.shape
    errors = np.abs(found - expected).max(axis=0) / np.abs(expected).max(axis=0).clip(1e-3)
    assert errors.max() < TOLERANCES[terms], dict(zip(range(15), errors, strict=False))


def rates_with(velocity, channels):
    """The rates of a flight with a measured velocity."""
    nothing = np.full((51, 12), np.nan)
    flight = jaxos4.Flight(0.01 * np.arange(51), commands(0.5, 0.01), nothing, body_velocity=velocity)
    given = {"sigma": np.ones(12), "channels": channels, "initial_state": np.zeros(12)}
    problem = jaxos4.ShootingProblem(jaxos4.FlightModel(terms=("velocity",)), flight, **given)
    return np.asarray(problem.predict(truth(problem.model), jnp.zeros(problem.size)))[:, :3]


@pytest.mark.parametrize("channels", ["rates", "all"])
def test_a_measured_velocity_acts_in_its_own_step(channels):
    once = np.zeros((51, 3))
    once[7] = x, y, _ = 0.7, -0.4, 0.2
    moved = rates_with(once, channels) - rates_with(np.zeros((51, 3)), channels)
    assert not moved[:8].any()
    expected = [0.01 * VALUES["roll_velocity"] * y, 0.01 * VALUES["pitch_velocity"] * x, 0.0]
    np.testing.assert_allclose(moved[8], expected, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("recordings", [(0,), (0, 1), (1, 0, 2)])
def test_every_parameter_has_a_name_a_unit_and_a_bracket(recordings):
    count = max(recordings) + 1
    assert set(VALUES) == {name for term in NAMES for name in NAMES[term]} | set(NAMES_XY)
    three = itertools.combinations(("offset", "lag", "gyro_bias", "accelerometer", "drag"), 3)
    for terms in ((), *((term,) for term in ALL), *three, DEFAULT_TERMS, RATE_TERMS, ALL):
        model = jaxos4.FlightModel(FULL, terms=terms, recordings=recordings, battery_voltage=VOLTS)
        names = model.parameter_names
        own = [name for term in terms if term in ("offset", "gyro_bias") for name in NAMES[term]]
        shared = [name for term in terms if term not in ("offset", "gyro_bias") for name in NAMES[term]]
        shared += NAMES_XY if {"accelerometer", "drag"} <= set(terms) else ()
        numbered = own if count == 1 else [f"{name}_{i + 1}" for name in own for i in range(count)]
        assert sorted(names) == sorted([*jaxos4.CorrectedOS4().parameter_names, *shared, *numbered])
        assert len(model.parameter_units) == len(names)
        center, half_width = np.asarray(model.alpha), np.asarray(model.half_width)
        assert center.shape == half_width.shape == (len(names),)
        assert np.all(np.isfinite(half_width) & (half_width > 0) & np.isfinite(center))
        chain = {*NAMES["motor"], "rotor_delay", "voltage_exponent", "battery_fade"} & set(names)
        assert {names[i] for i in model.forcing_parameters} == chain
    # The order is that of TERMS, in whatever order they were given, and within a term recording by recording.
    assert jaxos4.FlightModel(terms=("lag", "offset")).parameter_names[8:] == (*NAMES["offset"], "rotor_lag")
    two = jaxos4.FlightModel(terms=("offset",), recordings=(0, 1)).parameter_names[8:]
    # However many stretches there are: flights of one recording share a program.
    assert jaxos4.FlightModel(recordings=(0, 0, 0)).recordings == (0,)
    assert jaxos4.FlightModel(recordings=(0, 0, 1, 1)).recordings == (0, 0, 1)
    assert two == tuple(f"{name}_{i}" for i in (1, 2) for name in NAMES["offset"])


def test_an_estimate_uses_the_terms_that_the_logs_allow():
    basic = ("offset", "center_of_mass", "damping", "delay", "reaction")
    rotors = ("offset", "center_of_mass", "damping", "lag", "delay", "reaction")
    assert default_terms(frozenset()) == default_terms(frozenset({FULL_SCALE})) == basic
    assert default_terms(frozenset({COMMANDS, FULL_SCALE})) == rotors == DEFAULT_TERMS
    force = frozenset({LATERAL_FORCE, VERTICAL_FORCE})
    moving = force | {VELOCITY}
    for available, terms in (
        (force, (*basic, "accelerometer")),
        (moving | {MEASURED_VELOCITY, FULL_SCALE}, (*basic, "velocity", "accelerometer", "inflow", "drag")),
        (moving, (*basic, "velocity", "accelerometer", "inflow")),
        (frozenset({VELOCITY, VOLTAGE}), (*basic, "velocity")),
        (frozenset({COMMANDS, VOLTAGE}), (*rotors, "voltage")),
        (force | {COMMANDS}, (*rotors, "fade", "accelerometer")),
        (force | {COMMANDS, FULL_SCALE}, (*basic, "fade", "motor", "accelerometer")),
        (force | {COMMANDS, FULL_SCALE, VOLTAGE}, (*basic, "voltage", "motor", "accelerometer")),
    ):
        assert set(default_terms(available)) == set(terms)
        assert list(default_terms(available)) == [name for name in jaxos4.TERMS if name in terms]
    assert all(term.description for term in jaxos4.TERMS.values())
