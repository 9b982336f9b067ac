"""`hold`: a model with held parameters is the inner model with the values in their places."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import curvatures, forcing_of, standard_flight

import jaxos4
from jaxos4.flight import Inputs
from jaxos4.models.state import Rates

FLIGHT_MODEL = jaxos4.FlightModel(terms=("offset", "damping", "lag", "delay", "accelerometer", "gyro_bias"))
# The inner model, and the held values.
CASES = [
    (jaxos4.PublishedOS4(), {"alpha2": 0.01}),
    (jaxos4.CorrectedOS4(), {"alpha7": 0.0, "alpha1": -0.5}),
    (jaxos4.InertialOS4(jaxos4.CorrectedOS4()), {"J_R": 7e-5}),
    (FLIGHT_MODEL, {"rotor_lag": 0.04, "alpha5": 0.009, "yaw_damping": 0.2}),
    (FLIGHT_MODEL, {"rotor_lag": 0.04, "rotor_delay": 0.015}),
    (FLIGHT_MODEL, {}),
]


def whole_of(model, values, rng=None):
    """All parameters of the inner model, the held ones at their values."""
    others = np.asarray(model.alpha) * (1.0 if rng is None else rng.uniform(0.9, 1.1, model.alpha.size))
    return jnp.array([values.get(name, x) for name, x in zip(model.parameter_names, others, strict=True)])


@eqx.filter_jit
def turning(model, rates, forcing, parameters):
    return model.angular_acceleration(rates, forcing, parameters)


def problem_of(model, *, windows=3):
    flight = standard_flight(jaxos4.CorrectedOS4, 1.0)
    force = np.random.default_rng(0).normal(size=(101, 3))
    flight = eqx.tree_at(lambda f: f.specific_force, flight, jnp.asarray(force), is_leaf=lambda leaf: leaf is None)
    return jaxos4.ShootingProblem(model, flight, sigma=jaxos4.SENSOR_SIGMA, channels="attitude", windows=windows)


@pytest.mark.parametrize(("model", "values"), CASES)
def test_a_held_model_is_the_inner_one_with_its_values(model, values):
    held, whole = jaxos4.hold(model, values), whole_of(model, values, np.random.default_rng(1))
    free = held.without(whole)
    assert held.parameters == tuple(p for p in model.parameters if p.name not in values)
    np.testing.assert_array_equal(held.complete(free), whole)
    np.testing.assert_array_equal(held.without(held.complete(free)), free)
    np.testing.assert_array_equal(held.alpha, held.without(model.alpha))
    np.testing.assert_array_equal(held.half_width, held.without(model.half_width))
    assert held.airframe is model.airframe
    assert (held.force_axes, held.observes_states) == (model.force_axes, model.observes_states)
    omega = standard_flight().omega[:20]
    inputs, rates = Inputs(omega, jnp.asarray(0.01)), Rates(*jnp.array([0.3, -0.2, 0.1]))
    forcing = forcing_of(model, inputs, whole)
    row = jax.tree.map(lambda leaf: leaf[3], forcing)
    for one, other in (
        *zip(jax.tree.leaves(forcing_of(held, inputs, tuple(free))), jax.tree.leaves(forcing), strict=True),
        (turning(held, rates, row, tuple(free)), turning(model, rates, row, tuple(whole))),
    ):
        np.testing.assert_array_equal(one, other)
    flights = [jaxos4.simulate(m, x, omega, dt=0.01, method="rk4").states for m, x in ((held, free), (model, whole))]
    np.testing.assert_allclose(*flights, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(("model", "values"), [CASES[0], CASES[3]])
def test_derivatives_are_those_of_the_inner_model(model, values):
    held, whole = jaxos4.hold(model, values), whole_of(model, values)
    part, all_of_it = problem_of(held), problem_of(model)
    start = part.first_state()[0]
    some, everything = curvatures(part, held.without(whole), start), curvatures(all_of_it, whole, start)
    remaining = np.append(held.free, len(whole) + np.arange(part.size))
    information = np.asarray(everything.information)[:, remaining][:, :, remaining]
    gradient = everything.gradient[:, remaining]
    scale = np.sqrt(information.max(axis=0).diagonal()) + 1e-12
    np.testing.assert_allclose(some.shot.cost, everything.shot.cost, rtol=1e-10)
    outer, size = np.outer(scale, scale), np.abs(gradient / scale).max()
    np.testing.assert_allclose(some.information / outer, information / outer, atol=1e-9)
    np.testing.assert_allclose(some.gradient / scale / size, gradient / scale / size, atol=1e-9)


def test_a_model_is_linear_if_its_nonlinear_parameters_are_held():
    chain = {"rotor_lag": 0.05, "rotor_delay": 0.0}
    assert not FLIGHT_MODEL.is_linear
    assert not jaxos4.hold(FLIGHT_MODEL, {"rotor_lag": 0.05}).is_linear
    assert jaxos4.hold(FLIGHT_MODEL, chain).is_linear
    assert jaxos4.hold(FLIGHT_MODEL, chain).forcing_parameters == ()
    inertial = jaxos4.InertialOS4(jaxos4.CorrectedOS4())
    assert not jaxos4.hold(inertial, {"J_R": 6e-5}).is_linear
    assert jaxos4.hold(inertial, {"Ix": 0.0075, "Iy": 0.0075, "Iz": 0.013}).is_linear
    assert jaxos4.hold(jaxos4.CorrectedOS4(), {"alpha7": 0.0}).is_linear


def test_a_held_model_can_be_held_again():
    twice = jaxos4.hold(jaxos4.hold(FLIGHT_MODEL, {"alpha2": 0.5}), {"rotor_lag": 0.02})
    once = jaxos4.hold(FLIGHT_MODEL, {"alpha2": 0.5, "rotor_lag": 0.02})
    assert twice.parameter_names == once.parameter_names
    omega = standard_flight().omega[:30]
    flights = [jaxos4.simulate(m, once.alpha, omega, dt=0.01).states for m in (twice, once)]
    np.testing.assert_array_equal(*flights)


def test_values_are_traced():
    omega = standard_flight().omega[:30]

    @jax.jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def fly(value):
        model = jaxos4.hold(jaxos4.CorrectedOS4(), {"alpha3": value})
        return jaxos4.simulate(model, model.alpha, omega, dt=0.01).states

    values = jnp.array([100.0, 133.0, 160.0])
    each = jnp.stack([fly(value) for value in values])
    np.testing.assert_allclose(jax.vmap(fly)(values), each, rtol=1e-12, atol=1e-14)
    assert np.all(np.diff(np.asarray(each)[:, -1, 7]) != 0)


@pytest.mark.parametrize("estimator", [jaxos4.IBSS(), jaxos4.OutputError(), jaxos4.EquationError()])
def test_the_remaining_parameters_are_estimated(estimator):
    """The truth, without noise, with some parameters held at the truth."""
    model = jaxos4.CorrectedOS4()
    held = jaxos4.hold(model, {"alpha2": model.alpha[1], "alpha7": 0.0})
    flight = standard_flight(jaxos4.CorrectedOS4)
    problem = jaxos4.ShootingProblem(
        held, flight, sigma=jaxos4.SENSOR_SIGMA, initial_state=flight.states[0], channels="rates"
    )
    bracket = jaxos4.Bracket.around(held.alpha + 0.5 * held.half_width, held.half_width)
    found = estimator(problem, bracket)
    assert np.all(np.abs(found.parameters - held.alpha) < 1e-5 * held.half_width)


def test_misuse_is_named():
    with pytest.raises(ValueError, match="`values`: the model has no parameter wind; its parameters are alpha1, "):
        jaxos4.hold(jaxos4.CorrectedOS4(), {"alpha1": 0.0, "wind": 1.0})
    with pytest.raises(ValueError, match="`values` holds all parameters of the model"):
        jaxos4.hold(jaxos4.CorrectedOS4(), dict.fromkeys(jaxos4.CorrectedOS4().parameter_names, 0.0))
