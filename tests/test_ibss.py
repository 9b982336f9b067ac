"""Iterative Bi-Section Shooting: without noise, with it, from brackets that miss, and when things go wrong."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import noisy_states, random_starts, same, standard_flight, standard_problem
from lanes import HALF, LANES, assert_chi_square, assert_covered, bound, errors, identify, information, lost, names

import jaxos4

PUBLISHED, CORRECTED = jaxos4.PublishedOS4, jaxos4.CorrectedOS4

# Model, channels, whether the initial state is free.
CASES = {
    "published-rates": (PUBLISHED, "rates", False),
    "published-all": (PUBLISHED, "all", False),
    "published-all-free": (PUBLISHED, "all", True),
    "corrected-rates": (CORRECTED, "rates", False),
    "corrected-all": (CORRECTED, "all", False),
}
every_case = pytest.mark.parametrize("case", CASES)
SEEDS = {case: seed for seed, case in enumerate(CASES)}


def lanes(case, states, *, offset=0.0, starts=None):
    """Arguments of `identify`: brackets around the truth, their centers off by `offset` half-widths."""
    model_class, channels, free = CASES[case]
    center = np.asarray(model_class().alpha) + offset * np.ones((len(states), 8)) * HALF
    omega = jnp.tile(standard_flight(model_class).omega, (len(states), 1, 1))
    ends = (jnp.asarray(x) for x in (center - HALF, center + HALF, center if starts is None else starts))
    return standard_problem(model_class, channels, free=free), states, omega, *ends


# With the noise of the sensors: a batch of flights, each from its own start in the default bracket.


@functools.cache
def noisy(case):
    model_class, seed = CASES[case][0], SEEDS[case]
    starts = random_starts(model_class(), LANES, seed=100 + seed)
    return identify(jaxos4.IBSS(), *lanes(case, noisy_states(LANES, model_class, seed=seed), starts=starts))


@every_case
def test_errors_are_those_of_the_cramer_rao_bound(case):
    assert names(noisy(case)).tolist() == ["successful"] * LANES
    error = errors(noisy(case), CASES[case][0])
    assert_chi_square(error, information(*CASES[case]))
    error = error / bound(*CASES[case])
    efficiency = np.sqrt(np.mean(error**2, axis=0))
    standard_error = 1 / np.sqrt(2 * LANES)
    assert np.abs(efficiency - 1).max() < 3.5 * standard_error, efficiency
    bias = error.mean(axis=0) * np.sqrt(LANES)
    assert np.abs(bias).max() < 4, bias


@every_case
def test_estimates_know_their_errors_and_their_fit(case):
    estimates = noisy(case)
    np.testing.assert_allclose(np.median(estimates.std / bound(*CASES[case]), axis=0), 1, atol=0.05)
    assert_covered(errors(estimates, CASES[case][0]), estimates.std)
    model_class, channels, free = CASES[case]
    problem = standard_problem(model_class, channels, free=free)
    degrees = problem.size * (501 if free else 500) - 8 - problem.free_size
    cost = np.asarray(2 * estimates.cost / degrees)
    assert abs(cost.mean() - 1) < 4 * np.sqrt(2 / (degrees * LANES))
    assert estimates.initial_state.shape == (LANES, problem.size)
    if not free:
        assert not estimates.initial_state.any()


# Without noise: to rounding, from anywhere in the bracket and from brackets that miss.

SIDES = np.array([side * np.eye(8)[i] for i in range(8) for side in (-1, 1)])
# How far beyond the bracket's edge the truth is, in half-widths; a full width is 2.
BEYOND, FAR = 0.1, 2.0
EXACT, MISSED, NOISY_MISSED, BARELY = (slice(16 * i, 16 * (i + 1)) for i in range(4))


@functools.cache
def mixed(case):
    """16 lanes each: exact from random starts; exact, truth far outside; noisy, far outside; noisy, just outside."""
    model_class, seed = CASES[case][0], SEEDS[case]
    model = model_class()
    exact = np.tile(standard_flight(model_class).states, (32, 1, 1))
    states = jnp.concatenate([exact, noisy_states(32, model_class, seed=200 + seed)])
    offset = np.concatenate([np.zeros((16, 8)), (1 + FAR) * SIDES, (1 + FAR) * SIDES, (1 + BEYOND) * SIDES])
    starts = np.asarray(model.alpha) + offset * HALF
    starts[EXACT] = random_starts(model, 16, seed=300 + seed)
    return identify(jaxos4.IBSS(), *lanes(case, states, offset=offset, starts=starts))


@every_case
def test_exact_flights_give_the_truth(case):
    estimates, alpha = mixed(case), np.asarray(CASES[case][0]().alpha)
    assert set(names(estimates)[EXACT]) == {"successful"}
    scale = np.where(alpha == 0, 1, np.abs(alpha))
    error = (np.abs(errors(estimates, CASES[case][0])) / scale)[EXACT].max(axis=0)
    tiny = alpha == 6e-9  # alpha2 and alpha5 as printed
    assert (error[tiny] < 1e-2).all(), error
    assert (error[~tiny] < 1e-8).all(), error


@every_case
def test_never_succeeds_with_a_wrong_answer(case):
    """Each parameter in turn outside the bracket, on either side, by a tenth of its half-width or by its full width."""
    estimates = mixed(case)
    off = np.abs(errors(estimates, CASES[case][0]) / bound(*CASES[case])).max(axis=1)
    succeeded = names(estimates) == "successful"
    assert off[succeeded].max() < 6
    assert off[MISSED][succeeded[MISSED]].max() < 1e-4  # without noise: the truth itself
    # Few are given up.
    assert succeeded[MISSED].sum() >= 14
    assert succeeded[NOISY_MISSED].sum() >= 14
    assert succeeded[BARELY].all()


@every_case
def test_a_bracket_that_misses_costs_nothing_but_time(case):
    """The noisy flights end where they end from a bracket around the truth: at the least cost."""
    estimates = mixed(case)
    succeeded = names(estimates) == "successful"
    for part in (NOISY_MISSED, BARELY):
        assert_chi_square(errors(estimates, CASES[case][0])[part][succeeded[part]], information(*CASES[case]))


def test_a_truth_beyond_the_hard_limits_is_reported():
    case = "published-rates"
    offset = np.concatenate([4.5 * SIDES] * 4)
    arguments = lanes(case, noisy_states(LANES, seed=1), offset=offset)
    estimates = identify(jaxos4.IBSS(), *arguments)
    assert not (names(estimates) == "successful").any()
    assert np.isfinite(estimates.parameters).all()
    reached = np.abs(np.asarray(estimates.parameters - PUBLISHED().alpha) / HALF - offset)
    assert (reached <= 4 * (1 + 1e-9)).all()
    wider = identify(jaxos4.IBSS(reach=6.0), *arguments)
    off = np.abs(errors(wider) / bound()).max(axis=1)
    assert off[names(wider) == "successful"].max() < 6
    assert (names(wider) == "successful").mean() > 0.8


def test_where_a_start_is_nan_the_search_begins_at_the_center():
    case, seed = "published-rates", SEEDS["published-rates"]
    starts = random_starts(PUBLISHED(), LANES, seed=100 + seed)
    found = [
        identify(jaxos4.IBSS(), *lanes(case, noisy_states(LANES, seed=seed), starts=starts.at[7, 2].set(value)))
        for value in (jnp.nan, PUBLISHED().alpha[2])
    ]
    assert same(*found)
    others = np.arange(LANES) != 7
    np.testing.assert_array_equal(np.asarray(found[0].parameters)[others], np.asarray(noisy(case).parameters)[others])


def test_too_few_sweeps_are_reported():
    case = "published-rates"
    estimates = identify(
        jaxos4.IBSS(max_sweeps=1, tolerance=1e-8),
        *lanes(case, noisy_states(LANES), starts=random_starts(PUBLISHED(), LANES)),
    )
    assert set(names(estimates)) == {"max_sweeps"}
    assert np.isfinite(estimates.parameters).all()
    assert (np.asarray(estimates.sweeps) == 3).all()  # one for each share of the flight


@eqx.filter_jit
def table_of(estimator, problem, states, *ends):
    """An estimate for each flight and each bracket."""

    def one(states, *ends):
        return estimator(eqx.tree_at(lambda p: p.flight.states, problem, states), jaxos4.Bracket(*ends))

    return jax.vmap(jax.vmap(one, in_axes=(None, 0, 0)), in_axes=(0, None, None))(states, *ends)


def test_vmaps_over_brackets_flights_and_both():
    """A table of flights by brackets, in one call, is a row of lanes. That a lane is an estimate: `test_estimators`."""
    case, states, estimator = "published-rates", noisy_states(2), jaxos4.IBSS(tolerance=1e-4)
    shifts = np.array([[0.0], [0.4], [-0.4]]) * np.ones(8)
    centers = np.asarray(PUBLISHED().alpha) + shifts * HALF
    table = table_of(estimator, standard_problem(channels="rates"), states, centers - HALF, centers + HALF)
    assert table.parameters.shape == (2, 3, 8)
    assert table.std.shape == (2, 3, 8)
    sigma = np.asarray(table.std[0, 0])
    flights, offset = (np.resize(x, (LANES, *np.shape(x)[1:])) for x in (np.repeat(states, 3, axis=0), shifts))
    row = identify(estimator, *lanes(case, jnp.asarray(flights), offset=offset))
    np.testing.assert_allclose(table.parameters.reshape(6, 8) / sigma, row.parameters[:6] / sigma, atol=1e-6)
    # Where it began does not matter, and two flights are two estimates.
    assert np.abs((table.parameters - table.parameters[:, :1]) / sigma).max() < 1e-2
    assert np.abs((table.parameters[0] - table.parameters[1]) / sigma).max() > 0.1
    assert set(names(table).ravel()) == {"successful"}
    assert np.abs(errors(table)).max() < 1


# Settings.


def maximum_likelihood(problem):
    """By Gauss-Newton steps on a Jacobian of the residuals."""
    parameters = problem.model.alpha
    for _ in range(6):
        slopes, residuals = jacobian(problem, parameters)
        parameters = parameters - np.linalg.lstsq(slopes, residuals, rcond=None)[0]
    return np.asarray(parameters)


@eqx.filter_jit
def jacobian(problem, parameters):
    """The residuals' derivatives, and the residuals."""
    return jax.jacfwd(lambda x: (problem.residuals(x),) * 2, has_aux=True)(parameters)


@pytest.mark.usefixtures("optimised")
def test_both_kinds_of_directions_reach_the_maximum_of_the_likelihood():
    case, count = "published-rates", 4
    states = noisy_states(LANES, seed=5)
    arguments = lanes(case, states, starts=random_starts(PUBLISHED(), LANES, seed=6))
    flights = [standard_problem(channels="rates", states=s) for s in states[:count]]
    best = np.stack([maximum_likelihood(problem) for problem in flights])
    for directions in ("whitened", "coordinate"):
        estimates = identify(jaxos4.IBSS(directions=directions, tolerance=1e-5), *arguments)
        assert set(names(estimates)) == {"successful"}
        assert np.abs((estimates.parameters[:count] - best) / bound()).max() < 1e-4
        # What the default tolerance allows is far below the noise.
        estimates = identify(jaxos4.IBSS(directions=directions), *arguments)
        assert np.abs((estimates.parameters[:count] - best) / bound()).max() < 0.05


def test_rollouts_are_counted_right():
    """Each simulated step calls back with its torque; the first torque starts a shot, on however many samples."""
    torques = []

    class Counting(PUBLISHED):
        def angular_acceleration(self, rates, forcing, parameters):
            jax.debug.callback(lambda torque: torques.append(float(torque)), forcing.roll)
            return super().angular_acceleration(rates, forcing, parameters)

    flight = standard_flight(duration=0.5)
    states = noisy_states(1, duration=0.5)[0]
    free, slow = None, {"directions": "coordinate", "halvings": 3, "max_sweeps": 5}
    for start, unknowns, most, settings in ((flight.states[0], 8, 2, {}), (free, 11, 3 * 11, slow)):
        problem = jaxos4.ShootingProblem(
            Counting(),
            eqx.tree_at(lambda f: f.states, flight, states),
            sigma=jaxos4.SENSOR_SIGMA,
            channels="rates",
            initial_state=start,
        )
        torques.clear()
        bracket = jaxos4.Bracket.around(PUBLISHED().alpha + 0.5 * HALF, HALF)
        estimate = jaxos4.IBSS(**settings)(problem, bracket)
        jax.effects_barrier()
        rolls = np.asarray(problem.forcing(problem.model.alpha).roll)
        assert (rolls == rolls[0]).sum() == 1
        shots = torques.count(float(rolls[0]))
        sweeps = int(estimate.sweeps)
        assert int(estimate.rollouts) == unknowns * shots  # each shot carries one tangent for every unknown
        assert sweeps > 3
        # A sweep looks around and narrows each bracket; it ends early where the minimum is.
        assert 2 * sweeps <= shots <= 3 + sweeps * (1 + most)


def test_starts_of_another_length_are_named():
    problem = standard_problem(channels="rates", duration=0.1)
    with pytest.raises(ValueError, match=r"`start` must hold 8 unknowns, got shape \(7,\)"):
        jaxos4.IBSS()(problem, jaxos4.Bracket.default(PUBLISHED()), start=jnp.zeros(7))


# Other data.


def test_dropouts_and_channels_that_were_never_measured_only_cost_precision():
    case = "published-all"
    states = lost(noisy_states(LANES, seed=7)).at[:32, :, jaxos4.STATE_NAMES.index("x")].set(jnp.nan)
    estimates = identify(jaxos4.IBSS(), *lanes(case, states, starts=random_starts(PUBLISHED(), LANES, seed=9)))
    assert names(estimates).tolist() == ["successful"] * LANES
    assert (np.asarray(estimates.std) > bound(*CASES[case])).all()
    assert_chi_square(errors(estimates), np.linalg.inv(estimates.covariance))
