"""`ShootingProblem` against residuals of the NumPy equations; its derivatives against finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import noisy_states, numpy_residuals, standard_flight, standard_problem

import jaxos4
from jaxos4.models.state import CASCADE_ORDER, CHANNELS, Attitude

every_channels = pytest.mark.parametrize("channels", CHANNELS)
known_or_free = pytest.mark.parametrize("free", [False, True], ids=["known", "free"])
DURATION = 1.0
SIGMA = jaxos4.SENSOR_SIGMA
THETA = jaxos4.STATE_NAMES.index("theta")


# Each compiles once for each kind of problem, like `cost` and `residuals`.
outputs_of = eqx.filter_jit(lambda problem, parameters: (problem.cost(parameters), problem.residuals(parameters)))
slope_of = eqx.filter_jit(lambda problem, *args: jax.jacfwd(problem.cost)(*args))
local_model_of = eqx.filter_jit(
    lambda problem, *args: jax.tree.map(lambda x: x[0], problem.local_model(problem.join(*args)))
)


def measured(model_class=jaxos4.PublishedOS4):
    return noisy_states(1, model_class, duration=DURATION)[0]


def problem_of(channels="all", *, free=False, states=None, model_class=jaxos4.PublishedOS4, method="euler"):
    states = measured(model_class) if states is None else states
    return standard_problem(model_class, channels, free=free, states=states, duration=DURATION, method=method)


def first_of(problem):
    """Where a search starts if everything was measured."""
    states = problem.flight.states[0] if problem.initial_state is None else problem.initial_state
    return np.asarray(states)[CASCADE_ORDER[: problem.size]]


def off(model_class=jaxos4.PublishedOS4):
    """Parameters where the cost is neither zero nor stationary."""
    return jnp.asarray(model_class().alpha + 0.1 * jaxos4.DEFAULT_HALF_WIDTH * np.tile([1, -1], 4))


# The cost.


PUBLISHED, CORRECTED = jaxos4.PublishedOS4, jaxos4.CorrectedOS4


@pytest.mark.parametrize(
    ("model_class", "channels", "free"),
    [
        *((PUBLISHED, c, f) for c in CHANNELS for f in (False, True)),
        (CORRECTED, "rates", True),
        (CORRECTED, "all", False),
    ],
)
def test_cost_and_residuals_are_the_weighted_mismatch(model_class, channels, free):
    problem = problem_of(channels, free=free, model_class=model_class)
    expected = numpy_residuals(problem, off(model_class), first_of(problem))
    if not free:
        expected[0] = 0  # a known first sample is no data
    cost, residuals = outputs_of(problem, off(model_class))
    assert residuals.shape == (101 * CHANNELS[channels],)
    np.testing.assert_allclose(residuals, expected.ravel(), atol=1e-9)
    assert cost == pytest.approx(0.5 * float(residuals @ residuals), rel=1e-13)
    assert cost == pytest.approx(0.5 * np.sum(expected**2), rel=1e-11)
    assert cost > 1


@known_or_free
def test_missing_measurements_contribute_nothing(free):
    states, lost = measured(), np.random.default_rng(0).random((101, 12)) < 0.3
    lost[0] &= not free
    lost[40:60, THETA] = True
    masked = problem_of("attitude", free=free, states=jnp.where(lost, jnp.nan, states))
    expected = numpy_residuals(masked, off(), masked.first_state()[0])
    expected[0] *= free
    residuals = masked.residuals(off())
    assert residuals.shape == (101 * 6,)
    np.testing.assert_allclose(residuals, np.nan_to_num(expected.ravel()), atol=1e-9)
    assert float(masked.cost(off())) == pytest.approx(0.5 * np.nansum(expected**2), rel=1e-11)
    # The derivatives do not read the missing samples.
    gradient = slope_of(masked, off())
    model = local_model_of(masked, off(), masked.first_state()[0])
    assert np.isfinite(gradient).all()
    np.testing.assert_allclose(model.gradient[:8], gradient, rtol=1e-9)
    assert np.isfinite(model.information).all()


@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_shoots_with_its_own_method_on_fewer_channels_too(method):
    model, flight = jaxos4.PublishedOS4(), standard_flight(duration=DURATION)
    exact = jaxos4.simulate(model, model.alpha, flight.omega, dt=flight.dt, method=method)
    for other in ("euler", "rk4"):
        cost = float(problem_of(states=exact.states, method=other).cost(model.alpha))
        assert cost < 1e-18 if other == method else cost > 0.1
    whole = problem_of(method=method)
    rows = whole.residuals(off()).reshape(101, 12)
    for channels, size in CHANNELS.items():
        part = whole.restrict(channels)
        assert (part.size, part.free_size, part.channels) == (size, 0, channels)
        np.testing.assert_allclose(part.residuals(off()).reshape(101, size), rows[:, :size], atol=1e-12)


# Derivatives.


@eqx.filter_jit
def all_derivatives(problem, parameters, start):
    def cost(u):
        return problem.cost(u[:8], u[8:])

    u = jnp.concatenate([parameters, start])
    return jax.value_and_grad(cost)(u), jax.jacfwd(cost)(u), local_model_of(problem, parameters, start)


@eqx.filter_jit
def costs_of(problem, parameters, start):
    return jax.vmap(problem.cost)(parameters, start)


def central_differences(problem, parameters, start, step):
    """Derivatives by Richardson's extrapolation of central differences over `step` and half of it."""
    point, moves = np.concatenate([parameters, start]), np.diag(step)
    points = np.concatenate([point + share * moves for share in (1, -1, 0.5, -0.5)])
    if problem.method == "euler":
        first = 0 if problem.initial_state is None else 1  # a known first sample is no data
        costs = np.square(numpy_residuals(problem, points[:, :8], points[:, 8:])[:, first:]).sum(axis=(1, 2)) / 2
    else:
        costs = costs_of(problem, points[:, :8], points[:, 8:])
    up, down, half_up, half_down = np.split(np.asarray(costs), 4)
    return (4 * (half_up - half_down) / step - (up - down) / (2 * step)) / 3


CASES = [
    *(
        pytest.param(PUBLISHED, channels, free, "euler", marks=pytest.mark.slow)
        for channels, free in (("rates", False), ("attitude", True), ("all", False))
    ),
    (CORRECTED, "all", True, "euler"),
    (CORRECTED, "rates", False, "rk4"),
]


@pytest.mark.parametrize(("model_class", "channels", "free", "method"), CASES)
def test_forward_and_reverse_mode_equal_finite_differences(model_class, channels, free, method):
    problem = problem_of(channels, free=free, model_class=model_class, method=method)
    # Even if the initial state is known, the cost depends on the one that is given; the local model does not.
    start = jnp.asarray(first_of(problem) + (0.01 if free else 0.0))
    (cost, reverse), forward, model = all_derivatives(problem, off(model_class), start)
    order = CASCADE_ORDER[: problem.size]
    step = np.concatenate([1e-3 * jaxos4.DEFAULT_HALF_WIDTH, 0.1 * SIGMA[order]])
    places = off(model_class), off(model_class) * (1 + 1e-5)
    expected, other = (central_differences(problem, at, start, step) for at in places)
    scale = np.abs(expected * step)
    assert (scale > 0).all()
    for gradient in (reverse, forward):
        np.testing.assert_allclose(gradient * step, expected * step, rtol=1e-6, atol=1e-9 * scale.max())
    assert np.abs(reverse / other - 1).max() > 1e-6  # a wrong derivative would fail
    np.testing.assert_allclose(forward, reverse, rtol=1e-10, atol=1e-12 * np.abs(reverse).max())
    assert float(model.cost) == pytest.approx(float(cost), rel=1e-13)
    assert bool(model.feasible)
    unknowns = 8 + problem.free_size
    assert model.information.shape == (unknowns, unknowns)
    np.testing.assert_allclose(model.gradient, forward[:unknowns], rtol=1e-10)


# One lane, many lanes; failures.


@every_channels
def test_a_loop_is_a_batch_in_which_a_failed_trajectory_costs_infinity_and_changes_no_other_lane(channels):
    """Over parameters, flights and noise levels."""
    flight = standard_flight(duration=DURATION)

    def cost(alpha, states, sigma):
        data = eqx.tree_at(lambda f: f.states, flight, states)
        return jaxos4.ShootingProblem(jaxos4.PublishedOS4(), data, sigma=sigma, channels=channels).cost(alpha)

    alphas = np.asarray(off()) * np.array([[0.9], [1.0], [1.1], [1.2]])
    states, sigmas = np.asarray(noisy_states(4, duration=DURATION)), SIGMA * np.array([[1.0], [2.0], [0.5], [1.0]])
    together = jax.jit(jax.vmap(cost))
    expected = np.asarray(together(alphas, states, sigmas))
    alone = [cost(*map(jnp.asarray, lane)) for lane in zip(alphas, states, sigmas, strict=True)]
    np.testing.assert_allclose(expected, alone, rtol=1e-12)
    alphas[1, 2], alphas[3] = 1e7, np.nan  # the first diverges
    costs = np.asarray(together(alphas, states, sigmas))
    assert costs[[1, 3]].tolist() == [np.inf, np.inf]
    np.testing.assert_array_equal(costs[[0, 2]], expected[[0, 2]])


# Noise levels.


def test_a_batch_of_two_blocks_has_the_derivatives_of_its_lanes():
    problem, direction = problem_of(), jnp.asarray(jaxos4.DEFAULT_HALF_WIDTH)
    points = off() + 0.01 * jnp.arange(20.0)[:, None] * direction

    def derivatives(x):
        return jax.jvp(problem.cost, (x,), (direction,)), jax.grad(problem.cost)(x)

    (costs, slopes), gradients = jax.jit(jax.vmap(derivatives))(points)
    np.testing.assert_allclose(slopes, gradients @ direction, rtol=1e-9)
    for lane in (0, 19):
        (cost, slope), gradient = jax.jit(derivatives)(points[lane])
        np.testing.assert_allclose([costs[lane], slopes[lane]], [cost, slope], rtol=1e-9)
        np.testing.assert_allclose(gradients[lane], gradient, rtol=1e-9)


@pytest.mark.skipif("jax.default_backend() != 'cpu'")
def test_the_sines_of_a_step_are_computed_once():
    """A shot is half as fast if XLA repeats those of an angle for all states that depend on it."""
    program = jax.jit(jax.vmap(problem_of().cost)).lower(jnp.tile(off(), (20, 1))).compile().as_text() or ""
    assert program.count(" conditional(") == len(Attitude._fields)


def test_reweighting_finds_the_noise_level_of_each_channel():
    flight, factor = standard_flight(), jnp.linspace(0.3, 3.0, 12)
    noise = jax.random.normal(jax.random.key(0), (501, 12)) * factor * SIGMA
    states = (flight.states + noise).at[:, 0].set(jnp.nan)
    # What was never measured, and what is no channel of the problem, keeps its sigma.
    for channels, found in (("all", np.arange(1, 12)), ("rates", np.array([7, 9, 11]))):
        problem = standard_problem(channels=channels, states=states)
        ratio = np.asarray(problem.reweighted(problem.residuals(problem.model.alpha)).sigma / SIGMA)
        assert (np.delete(ratio, found) == 1).all()
        np.testing.assert_allclose(ratio[found] / factor[found], 1, atol=4 / np.sqrt(2 * 500))
    # An exact fit gives finite weights.
    problem = standard_problem()
    again = problem.reweighted(problem.residuals(problem.model.alpha))
    assert (np.asarray(again.sigma) > 0).all()
    assert (np.asarray(again.sigma) <= 1e-6 * SIGMA).all()
    assert float(again.cost(problem.model.alpha)) < 12 * 501
    hover = standard_problem(states=jnp.zeros((501, 12)))  # all measurements are zero
    np.testing.assert_array_equal(hover.reweighted(jnp.zeros(501 * 12)).sigma, SIGMA)
