"""`simulate`: orders of convergence, zero-order hold, batches, failures; and its sine and cosine."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DT, REFERENCES, standard_flight
from jax.test_util import check_grads
from scipy.integrate import solve_ivp

import jaxos4
from jaxos4.rotations import sincos
from jaxos4.simulation import METHODS

every_method = pytest.mark.parametrize("method", METHODS)
THETA, Q = jaxos4.STATE_NAMES.index("theta"), jaxos4.STATE_NAMES.index("q")
SUCCESS, SINGULAR, NONFINITE = "successful", "attitude_singularity", "nonfinite_trajectory"


def name(flight):
    return jaxos4.result_names(flight.result).tolist()


SAMPLES, LANES = 26, 6  # one size, so that each method compiles once
COARSE, STEPS = 0.04, (1, 2, 4)


@pytest.fixture(scope="module", params=REFERENCES, ids=lambda c: c.__name__)
def refinements(request):
    """Errors of each method at the coarse samples, for smaller and smaller steps of the same input."""
    model = request.param()
    alpha = model.alpha.at[6].set(0.2)  # makes yaw nonlinear
    omega = jaxos4.multisine(model.airframe, duration=1.0, dt=COARSE)

    def fly(method, refinement):
        held = np.repeat(np.asarray(omega)[:-1], refinement, axis=0)
        # As many rows for every refinement: one program.
        rows = len(held) + 1 if method == "diffrax" else STEPS[-1] * len(omega)
        held = np.concatenate([held, np.repeat(np.asarray(omega)[-1:], rows - len(held), axis=0)])
        flight = jaxos4.simulate(model, alpha, jnp.asarray(held), dt=COARSE / refinement, method=method)
        return np.asarray(flight.states)[::refinement][: len(omega)]

    exact = fly("diffrax", 1)
    errors = {
        method: np.stack([np.abs(fly(method, n) - exact).max(axis=0) for n in STEPS]) for method in ("euler", "rk4")
    }
    return model, np.asarray(alpha), np.asarray(omega), exact, errors


@pytest.mark.slow
@pytest.mark.parametrize(("method", "order"), [("euler", 1), ("rk4", 4)])
def test_converges_at_its_order(refinements, method, order):
    model, _, _, exact, errors = refinements
    slopes = np.log2(errors[method][:-1] / errors[method][1:])
    np.testing.assert_allclose(slopes[-1], order, atol=0.15)
    relative = np.linalg.norm(errors[method] / np.abs(exact).max(axis=0), axis=1)
    np.testing.assert_allclose(np.log2(relative[:-1] / relative[1:]), order, atol=0.04)


@pytest.mark.slow
def test_diffrax_agrees_with_another_library_on_other_equations(refinements):
    model, alpha, omega, exact, _ = refinements
    derivative, state, states = REFERENCES[type(model)], np.zeros(12), [np.zeros(12)]
    for row in omega[:-1]:
        solution = solve_ivp(
            lambda _, x, row=row: derivative(x, row, alpha), (0, COARSE), state, "DOP853", rtol=1e-12, atol=1e-14
        )
        state = solution.y[:, -1]
        states.append(state)
    np.testing.assert_allclose(exact, np.stack(states), rtol=0, atol=2e-9)


@every_method
def test_each_row_is_held_until_the_next(method):
    """Without coupling the rates are sums of torques, and the vertical speed a sum of thrusts, whatever the method."""
    model = jaxos4.PublishedOS4()
    # Rotor speeds that jump at every sample, in no regular pattern.
    jumps = np.random.default_rng(0).choice([-1.0, 1.0], (SAMPLES, 4))
    omega, dt = jnp.asarray(model.airframe.hover_speed + 40 * jumps), 0.05
    gains = jnp.array([0.0, 0.0, 120.0, 0.0, 0.0, 110.0, 0.0, 60.0])
    flight = jaxos4.simulate(model, gains, omega, dt=dt, method=method)
    assert name(flight) == SUCCESS

    w, arm = np.asarray(omega).T ** 2, 0.23 * 3.13e-5
    yaw = 60.0 * 7.5e-7 * (w[3] + w[1] - w[2] - w[0])
    torque = np.stack([120.0 * arm * (w[3] - w[1]), 110.0 * arm * (w[2] - w[0]), yaw], axis=-1)
    rates = np.asarray(flight.states)[:, [7, 9, 11]]
    held = np.concatenate([np.zeros((1, 3)), dt * np.cumsum(torque[:-1], axis=0)])
    np.testing.assert_allclose(rates, held, atol=1e-12)
    # A method that read the next sample, or the mean of both, would fail.
    for wrong in (dt * np.cumsum(torque[1:], axis=0), dt * np.cumsum(torque[1:] + torque[:-1], axis=0) / 2):
        assert np.abs(rates[1:] - wrong).max() > 0.01
    # The last row drives nothing.
    again = jaxos4.simulate(model, gains, omega.at[-1].set(jnp.nan), dt=dt, method=method)
    np.testing.assert_array_equal(again.states, flight.states)
    assert name(again) == SUCCESS


@every_method
def test_begins_at_the_initial_state_and_a_loop_is_a_batch(method):
    model, omega = jaxos4.PublishedOS4(), standard_flight().omega[:SAMPLES]
    alphas, start = model.alpha * jnp.linspace(0.8, 1.2, LANES)[:, None], jnp.linspace(-0.3, 0.4, 12)

    def fly(alpha, start, omega=omega):
        return jaxos4.simulate(model, alpha, omega, dt=DT, initial_state=start, method=method)

    batched = batch(method, alphas, np.tile(omega, (LANES, 1, 1)), np.tile(start, (LANES, 1)))
    each = [fly(alpha, start) for alpha in alphas]
    np.testing.assert_allclose(batched.states, [one.states for one in each], rtol=1e-12, atol=1e-14)
    flight = each[0]
    np.testing.assert_array_equal(flight.states[0], start)
    np.testing.assert_allclose(flight.time, DT * np.arange(SAMPLES))
    assert float(flight.dt) == pytest.approx(DT)
    later = jnp.concatenate([omega[5:], omega[:5]])
    resumed = fly(alphas[0], flight.states[5], later)
    np.testing.assert_allclose(resumed.states[:-5], flight.states[5:], rtol=1e-13, atol=1e-14)


def batch(method, *arguments):
    """Flights of lanes of parameters, rotor speeds and initial states: the tests share its program."""

    def fly(alpha, omega, start):
        return jaxos4.simulate(jaxos4.PublishedOS4(), alpha, omega, dt=DT, initial_state=start, method=method)

    return eqx.filter_vmap(fly)(*map(jnp.asarray, arguments))


# Nose up without roll: pitch passes 90 degrees after 0.025 s. With any roll, Euler angles turn sharply before that.
OVER = np.zeros(12)
OVER[THETA], OVER[Q] = np.pi / 2 - 0.05, 2.0
PLANE = np.array([0.0, 0.0, 133.0, 0.0, 0.0, 133.0, 0.0, 77.0])


@every_method
def test_a_failing_lane_ends_where_it_fails_and_leaves_its_neighbours_alone(method):
    """Over the top on both sides, a NaN in an input and in the start, an overflow; each beside a good flight."""
    omega = np.full((LANES, SAMPLES, 4), jaxos4.OS4.hover_speed)
    alpha, start = np.tile(PLANE, (LANES, 1)), np.tile(OVER / 2, (LANES, 1))
    valid = batch(method, alpha, omega, start)
    assert name(valid) == [SUCCESS] * LANES
    start[1], start[2], start[3] = OVER, -OVER, np.nan
    omega[4, 4, 2] = np.nan
    omega[5] = 1e200 * standard_flight().omega[:SAMPLES]
    mixed = batch(method, alpha, omega, start)
    assert name(mixed) == [SUCCESS, SINGULAR, SINGULAR, NONFINITE, NONFINITE, NONFINITE]
    np.testing.assert_array_equal(mixed.states[0], valid.states[0])
    ended = np.isnan(mixed.states)
    assert (ended.any(axis=2) == np.maximum.accumulate(ended.all(axis=2), axis=1))[:5].all()
    assert np.argmax(ended.any(axis=2), axis=1).tolist()[:5] == [0, 3, 3, 0, 5]
    assert (np.abs(np.asarray(mixed.states)[1:3, :3, THETA]) < np.pi / 2).all()
    assert not ended[5, 0].any()
    assert ended[5, 3:].all()


SINGLE, DOUBLE = np.float32, np.float64


@pytest.mark.parametrize(("dtype", "turns"), [(DOUBLE, 1), (DOUBLE, 1e3), (DOUBLE, 1e5), (SINGLE, 1), (SINGLE, 1e3)])
def test_agrees_with_the_library_to_about_one_ulp(dtype, turns):
    rng = np.random.default_rng(0)
    anywhere = rng.uniform(-turns, turns, 20_000)
    quarters = np.round(rng.uniform(-4 * turns, 4 * turns, 2_000)) / 4
    angle = (2 * np.pi * np.concatenate([anywhere, quarters])).astype(dtype)
    exact, eps = angle.astype(DOUBLE), np.finfo(dtype).eps
    for found, expected in zip(sincos(jnp.asarray(angle)), (np.sin(exact), np.cos(exact)), strict=True):
        assert found.dtype == dtype
        np.testing.assert_allclose(found, expected, rtol=0, atol=1.5 * eps)
        if dtype == DOUBLE and turns <= 1e3:  # and near the zeros, in their own units
            np.testing.assert_allclose(found, expected, rtol=3 * eps)
        with pytest.raises(AssertionError):  # a coarser one would be caught
            np.testing.assert_allclose(found * (1 + 10 * eps), expected, rtol=0, atol=1.5 * eps)


def test_derivatives_of_any_order_and_mode_and_nan_for_infinity():
    angle = jnp.array([-4.0, -0.3, 0.0, 0.78, np.pi / 2, 2.5, 100.0])
    check_grads(lambda x: sincos(jnp.asarray(x)), (angle,), order=3, modes=("fwd", "rev"))
    for part, slope in ((0, np.cos(angle)), (1, -np.sin(angle))):
        np.testing.assert_allclose(jax.vmap(jax.grad(lambda x, part=part: sincos(x)[part]))(angle), slope, atol=1e-15)
    bad = jnp.array([jnp.nan, jnp.inf, -jnp.inf])
    for value in (*sincos(bad), *jax.jvp(lambda x: sincos(x)[0], (bad,), (jnp.ones(3),))):
        assert np.isnan(value).all()
