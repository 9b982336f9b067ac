"""Networks: their training, the coverage of their intervals, and the problems that they refuse."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DT, compiled_programs, same, standard_flight
from lanes import LANES, lost
from small_network import (
    BRACKET,
    CMAC,
    CORRECTED,
    LEVELS,
    MANY,
    OMEGA,
    PUBLISHED,
    SHORT,
    SMALL,
    answered,
    flights,
    half_widths,
    identify,
    many,
    names,
    problem_of,
    trained,
)

import jaxos4

# Training.


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_training_learns_and_comes_near_the_bound():
    assert trained().history.shape == (4, 2)
    (alpha, _), estimates = many(1.0), answered()
    bound = np.sqrt(np.diagonal(jax.vmap(lambda a: jaxos4.cramer_rao_bound(problem_of(), a))(alpha), axis1=1, axis2=2))
    assert set(names(estimates)) <= {"successful", "at_bound", "unidentifiable"}
    efficiency = np.sqrt(np.mean(np.square((estimates.parameters - alpha) / bound), axis=0))
    assert ((efficiency > 0.8) & (efficiency < 2)).all(), efficiency
    error = estimates.parameters - alpha
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(estimates.covariance), error) / 8
    assert abs(squares.mean() - 1) < 0.1  # errors have the size of the covariance


@pytest.mark.slow
def test_cmac_corrects_the_linear_map():
    alpha, states = many(1.0)

    def rmse(**changes):
        return np.sqrt(np.mean(np.square(identify(trained(**changes), states).parameters - alpha), axis=0))

    assert (rmse(**CMAC) < 0.8 * rmse(**(CMAC | {"steps": 1}))).all()
    with pytest.raises(ValueError, match='`architecture` "cmac" needs `features` "score", got \'raw\''):
        jaxos4.NetworkEstimator(architecture="cmac", features="raw")


OTHER_NETWORKS = [
    {},
    {"features": "raw", "steps": 1},
    {"noise": (1.0, 1.0), "steps": 50},
    {"channels": "attitude", "steps": 1},
    CMAC,
]


@pytest.mark.slow
@pytest.mark.parametrize("changes", OTHER_NETWORKS, ids=str)
@pytest.mark.usefixtures("optimised")
def test_intervals_hold_whatever_the_networks_quality(changes):
    network = trained(**changes)
    for noise in (1.0,) if changes else (0.1, 1.0, 7.0):
        alpha, states = many(noise)
        estimates = identify(network, states, noise, channels=network.channels)
        error, intervals = np.abs(estimates.parameters - alpha), half_widths(estimates)
        for level in LEVELS:
            # 4.5 Monte-Carlo errors of these flights and of the 4,000 for calibration, and 0.002 for the interpolation
            # between two calibrated noise scales.
            allowed = 4.5 * np.sqrt(level * (1 - level) * (1 / MANY + 1 / 4000)) + 0.002
            assert np.abs(np.mean(error < intervals[level][0], axis=0) - level).max() < allowed
        together = np.mean((error < intervals[0.9][1]).all(axis=1))
        assert abs(together - 0.9) < 4.5 * np.sqrt(0.09 * (1 / MANY + 1 / 4000)) + 0.002


@pytest.mark.slow
def test_the_same_key_gives_the_same_network_and_other_numbers_compile_nothing():
    """Other numbers are no reason to compile: bracket, noise, rate, number of steps, key."""

    def fit(key, bracket=BRACKET, **changes):
        return jaxos4.NetworkEstimator(**(SHORT | changes)).fit(problem_of(), bracket, key=jax.random.key(key))

    other = jaxos4.Bracket.around(BRACKET.center + 0.1 * BRACKET.half_width, 0.5 * BRACKET.half_width)
    first = fit(0)
    with compiled_programs() as programs:
        again, another = fit(0), fit(1)
        fit(1, other, noise=(0.5, 2.0), steps=300, learning_rate=0.01)
    assert programs == []
    assert same(first, again)
    assert not same(first.regressor, another.regressor)


@pytest.mark.slow
def test_training_stops_early_without_progress_and_a_flight_without_excitation_is_unidentifiable():
    slow = SMALL | {"steps": 5000, "learning_rate": 1e-12, "patience": 2, "noise": (1.0, 1.0), "batch": 8}
    network = jaxos4.NetworkEstimator(**slow).fit(problem_of(), BRACKET, key=jax.random.key(0))
    assert network.history.shape[0] < 20
    hover = jnp.full_like(OMEGA, jaxos4.OS4.hover_speed)
    flight = jaxos4.simulate(PUBLISHED(), PUBLISHED().alpha, hover, dt=DT)
    still = problem_of(flight.states, omega=hover)
    network = jaxos4.NetworkEstimator(**SHORT).fit(still, BRACKET, key=jax.random.key(0))
    noisy = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(flight, key=jax.random.key(1))
    assert names(network(problem_of(noisy.states, omega=hover), BRACKET)) == "unidentifiable"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "off", "message"),
    [
        ({"learning_rate": 1e30}, 0.0, r"diverged .* lower `learning_rate`"),
        ({}, 1e5, r"can be flown to their end: narrow the bracket"),
    ],
)
def test_a_training_that_cannot_succeed_says_why(changes, off, message):
    bracket = jaxos4.Bracket.around(CORRECTED().alpha + off, CORRECTED().half_width)
    with pytest.raises(jaxos4.TrainingError, match=message):
        jaxos4.NetworkEstimator(**(SMALL | changes)).fit(problem_of(model=CORRECTED()), bracket, key=jax.random.key(0))


# Flights that it was not trained for.

OTHER = {
    "rotor speeds": ({"omega": OMEGA.at[50, 2].add(0.1)}, "another series of rotor speeds"),
    "sample time": ({"dt": 0.011}, "another sample time"),
    "start": ({"initial_state": jnp.zeros(12).at[7].set(0.1)}, "another start"),
    "airframe": ({"model": PUBLISHED(jaxos4.OS4_SIMULATOR)}, "another airframe"),
    "model": ({"model": CORRECTED()}, "PublishedOS4, not CorrectedOS4"),
    "method": ({"method": "rk4"}, "method 'euler', not 'rk4'"),
    "free start": ({"free": True}, "initial state that is known"),
    "samples": ({"states": standard_flight(duration=1.0).states, "omega": OMEGA[:101]}, "301 samples, not 101"),
    "channels": ({}, "looks at 'attitude' channels"),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", OTHER)
def test_another_problem_is_an_error_that_says_what_differs(what):
    changes, words = OTHER[what]
    network = trained(channels="attitude", steps=1) if what == "channels" else trained()
    with pytest.raises(ValueError, match=words):
        network(problem_of(**changes), BRACKET)


def test_a_problem_may_be_a_constant_of_a_traced_function_and_an_invalid_bracket_is_a_result():
    network, problem = trained(), problem_of()
    assert names(network(problem, jaxos4.Bracket(BRACKET.upper, BRACKET.lower))) == "bracket_invalid"
    traced = eqx.filter_jit(lambda bracket: (network.mismatch(problem), network(problem, bracket).parameters))
    assert traced(BRACKET)[0] is None
    np.testing.assert_allclose(traced(BRACKET)[1], network(problem, BRACKET).parameters, rtol=1e-12)


@pytest.mark.slow
def test_a_network_takes_held_parameters_as_known():
    network, (alpha, states) = trained(), flights(400, seed=15)
    names_held, place = ["alpha1", "alpha5"], [0, 4]

    @eqx.filter_jit
    def answers(states, alpha):
        def one(states, alpha):
            problem = problem_of(states)
            return network(problem.hold(dict(zip(names_held, alpha[np.array(place)], strict=True)))), network(problem)

        return jax.vmap(one)(states, alpha)

    held, free = jax.tree.map(np.asarray, answers(states, jnp.asarray(alpha)))
    others = np.setdiff1d(np.arange(8), place)
    np.testing.assert_array_equal(held.parameters[:, place], alpha[:, place])
    np.testing.assert_array_equal(held.std[:, place], 0)
    # alpha1 and alpha2 share an axis, and alpha4 and alpha5 do.
    assert (held.std[:, others] <= free.std[:, others] * (1 + 1e-9)).all()
    scaled = ((held.parameters - alpha) / np.where(held.std > 0, held.std, 1.0))[:, others]
    spread = np.sqrt(np.square(scaled).mean(axis=0))
    # Intervals are calibrated for errors that are not quite Gaussian.
    assert np.all(np.abs(spread - 1) < 4 / np.sqrt(2 * 400) + 0.1)


@pytest.mark.slow
def test_in_a_batch_each_lane_has_its_own_result_and_leaves_the_others_alone():
    network, lanes = trained(), 8
    states = flights(LANES, seed=14)[1][:lanes]
    omega = jnp.tile(OMEGA, (lanes, 1, 1))
    noise = jnp.ones(lanes)

    @eqx.filter_jit
    @jax.vmap
    def answers(states, omega, noise):
        return network(problem_of(states, omega=omega, noise=noise), BRACKET)

    before = jax.tree.map(np.asarray, answers(states, omega, noise))
    assert names(before) == ["successful"] * lanes
    states = states.at[1, 7, 7].set(jnp.inf).at[3].set(jnp.nan).at[5].multiply(4.0)
    broken = jax.tree.map(np.asarray, answers(states, omega.at[2, 9, 1].add(1.0), noise.at[4].set(20.0)))
    results = names(broken)
    assert results[1] == "nonfinite_trajectory"
    assert results[2] == results[3] == results[4] == "network_mismatch"
    assert results[5] in ("at_bound", "unidentifiable")
    for lane in (0, 6, 7):
        assert same(*(jax.tree.map(lambda x, lane=lane: x[lane], e) for e in (before, broken)))
    for lane in (1, 2, 3, 4):
        assert np.isfinite(broken.parameters[lane]).all()
        assert np.isinf(np.diagonal(broken.covariance[lane])).all()


@pytest.mark.slow
def test_missing_samples_widen_the_intervals_and_no_more():
    alpha, states = many(1.0)
    fewer = identify(trained(), lost(states, share=0.4, seed=16))
    assert (np.asarray(fewer.std / answered().std) > 1.1).mean() > 0.9
    successful = np.array(names(fewer)) == "successful"
    assert successful.mean() > 0.9
    covered = np.mean((np.abs(fewer.parameters - alpha) < half_widths(fewer)[0.9][0])[successful], axis=0)
    assert np.abs(covered - 0.9).max() < 0.06


@pytest.mark.slow
def test_a_free_initial_state_is_estimated_too_and_a_column_may_begin_late_but_not_lack():
    network = trained(free=True)
    # Its intervals are calibrated over all the starts that it was trained for, and hold more often at their middle.
    alpha, states = flights(MANY, seed=17, start_width=network.features.coordinates.width[8:])
    estimates = identify(network, states, free=True)
    assert estimates.initial_state.shape == (MANY, 3)
    assert np.abs(estimates.initial_state).max() < 0.5  # +-0.3 rad/s, 30 standard deviations
    covered = np.mean(np.abs(estimates.parameters - alpha) < half_widths(estimates)[0.9][0], axis=0)
    assert np.abs(covered - 0.9).max() < 4.5 * np.sqrt(0.09 * (1 / MANY + 1 / 4000)) + 0.01
    with pytest.raises(ValueError, match="it looks at q, which this flight did not measure"):
        network(problem_of(states[0].at[:, 9].set(jnp.nan), free=True), BRACKET)
    late = network(problem_of(states[0].at[:20, 9].set(jnp.nan), free=True), BRACKET)
    assert names(late) != "network_mismatch"
    assert np.isfinite(late.std).all()
