"""Networks: their features, their training, the coverage of their intervals, and the problems that they refuse."""

import functools
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DT, same, standard_flight
from hypothesis import given, settings, strategies as st
from lanes import LANES, lost

import jaxos4
from jaxos4.estimators.hybrid import search_from_seed
from jaxos4.networks.features import FEATURES, Coordinates, Features

PUBLISHED, CORRECTED = jaxos4.PublishedOS4, jaxos4.CorrectedOS4
DURATION = 3.0
SMALL = {"width": 32, "depth": 2, "steps": 1000, "batch": 64, "held_out": 4000}
SHORT = SMALL | {"steps": 5, "held_out": 1000}
BRACKET = jaxos4.Bracket.default(PUBLISHED())
OMEGA = standard_flight(duration=DURATION).omega
MANY = 2000  # flights of a statistical test
LEVELS = (0.5, 0.9, 0.99)


def problem_of(states=None, *, noise=1.0, channels="rates", free=False, model=None, omega=OMEGA, dt=DT, **kwargs):
    states = standard_flight(duration=DURATION).states if states is None else states
    flight = jaxos4.Flight(dt * jnp.arange(len(omega)), omega, states)
    model = PUBLISHED() if model is None else model
    kwargs = {"initial_state": None if free else jnp.zeros(12)} | kwargs
    return jaxos4.ShootingProblem(model, flight, sigma=noise * jaxos4.SENSOR_SIGMA, channels=channels, **kwargs)


@functools.cache
def trained(free=False, seed=0, **changes):
    problem = problem_of(free=free, channels="attitude")
    return jaxos4.NetworkEstimator(**(SMALL | changes)).fit(problem, BRACKET, key=jax.random.key(seed))


def flights(count, *, seed=0, noise=1.0, start_width=(0.0, 0.0, 0.0)):
    """Parameters drawn over the bracket, initial rates over +-`start_width`, and the noisy states of their flights."""
    width = jnp.zeros(12).at[jnp.array([7, 9, 11])].set(jnp.asarray(start_width))
    rest = jax.random.key(seed), jnp.asarray(noise), width
    blocks = [fly(first + np.arange(LANES), *rest) for first in range(0, count, LANES)]  # one program for all numbers
    alpha, states = (np.concatenate(part)[:count] for part in zip(*blocks, strict=True))
    return alpha, jnp.asarray(states)


@eqx.filter_jit
def fly(numbers, key, noise, width):
    def one(i):
        alpha_key, noise_key = jax.random.split(jax.random.fold_in(key, i))
        start = width * jax.random.uniform(jax.random.fold_in(alpha_key, 1), (12,), minval=-1, maxval=1)
        alpha = BRACKET.center + BRACKET.half_width * jax.random.uniform(alpha_key, (8,), minval=-1, maxval=1)
        return alpha, jaxos4.simulate(PUBLISHED(), alpha, OMEGA, dt=DT, initial_state=start), noise_key

    sensors = jaxos4.WhiteNoise(noise * jaxos4.SENSOR_SIGMA)
    alpha, exact, keys = jax.vmap(one)(numbers)
    return alpha, jax.lax.map(lambda pair: sensors(pair[0], key=pair[1]).states, (exact, keys))


def identify(estimator, states, noise=1.0, channels="rates", free=False):
    found = identified(estimator, states, jnp.asarray(noise), channels, free)  # one program for all noises
    return jax.tree.map(np.asarray, found)


@eqx.filter_jit
def identified(estimator, states, noise, channels, free):
    return jax.vmap(lambda s: estimator(problem_of(s, noise=noise, channels=channels, free=free), BRACKET))(states)


@functools.cache
def many(noise):
    """Parameters and noisy states of many flights."""
    return flights(MANY, seed=12, noise=noise)


@functools.cache
def answered():
    """What a small network answers to them at noise 1."""
    return identify(trained(), many(1.0)[1])


@eqx.filter_jit
def half_widths(estimates):
    """For each level, those of each parameter and of all at once."""
    return {x: (estimates.half_width(x), estimates.half_width(x, simultaneous=True)) for x in LEVELS}


def names(estimates):
    return jaxos4.result_names(estimates.result).tolist()


# Features.


@eqx.filter_jit
def features_of(kind, free=False):
    problem = problem_of(free=free)
    return Features.of(kind, problem, Coordinates.of(problem, BRACKET, jnp.asarray(1.0)))


@pytest.mark.parametrize("kind", FEATURES)
@pytest.mark.parametrize("free", [False, True])
def test_simulated_features_are_those_of_the_simulated_flight(kind, free):
    features = features_of(kind, free)

    @eqx.filter_jit
    def both(features, u):
        parameters, start = features.coordinates.split(u, 8)
        initial_state = jnp.zeros(12).at[jnp.array([7, 9, 11])].set(start)
        flight = jaxos4.simulate(PUBLISHED(), parameters, OMEGA, dt=DT, initial_state=initial_state)
        return features.simulated(u), features(problem_of(flight.states, free=free))

    u = np.random.default_rng(1).uniform(-1, 1, features.coordinates.center.shape)
    simulated, (measured, inflation) = both(features, jnp.asarray(u))
    np.testing.assert_allclose(simulated, measured, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(inflation, 1.0, rtol=1e-12)


@pytest.mark.parametrize("kind", FEATURES)
def test_simulated_noise_is_that_of_noisy_flights(kind):
    """The score's noise is drawn in its own space: the same distribution as that of noisy flights."""
    features, scale, count = features_of(kind), 3.0, 4000
    noise = jaxos4.WhiteNoise(scale * jaxos4.SENSOR_SIGMA)
    keys = jax.random.split(jax.random.key(3), count)
    exact = standard_flight(duration=DURATION)
    measure = eqx.filter_jit(lambda features, k: features(problem_of(noise(exact, key=k).states))[0])
    draw = eqx.filter_jit(
        lambda features, k: features.simulated(u) + features.noise(scale * jax.random.normal(k, (features.size,)))
    )
    u = jnp.zeros(features.coordinates.center.shape)
    measured, drawn = (jax.lax.map(lambda k, one=one: one(features, k), keys) for one in (measure, draw))
    picked = slice(None) if kind == "score" else slice(300, 308)
    measured, drawn = np.asarray(measured)[:, picked], np.asarray(drawn)[:, picked]
    unit = np.sqrt(np.diagonal(np.cov(drawn.T)))
    difference = np.cov((measured / unit).T) - np.cov((drawn / unit).T)
    assert np.abs(difference).max() < 5 * np.sqrt(4 / count)
    assert np.abs((measured.mean(axis=0) - drawn.mean(axis=0)) / unit).max() < 5 * np.sqrt(2 / count)


def test_the_score_is_one_gauss_newton_step():
    problem = problem_of()
    alpha = BRACKET.center * 1.001 + 0.001
    states = jaxos4.simulate(PUBLISHED(), alpha, problem.flight.omega, dt=DT).states
    step = eqx.filter_jit(lambda features, states: features(problem_of(states))[0])(features_of("score"), states)
    np.testing.assert_allclose(step * BRACKET.half_width, alpha - BRACKET.center, rtol=0.05, atol=1e-3)


# Training.


@pytest.mark.usefixtures("optimised")
def test_training_learns_and_comes_near_the_bound():
    assert trained().history.shape == (4, 2)
    (alpha, _), estimates = many(1.0), answered()
    bound = np.sqrt(np.diagonal(jax.vmap(lambda a: jaxos4.cramer_rao_bound(problem_of(), a))(alpha), axis1=1, axis2=2))
    assert set(names(estimates)) <= {"successful", "at_bound", "unidentifiable"}
    efficiency = np.sqrt(np.mean(np.square((estimates.parameters - alpha) / bound), axis=0))
    assert (efficiency < 2).all(), efficiency
    assert (efficiency > 0.8).all()


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"features": "raw", "steps": 1},
        {"approximator": "cmac", "steps": 50, "learning_rate": 0.005},
        {"noise": (1.0, 1.0), "steps": 50},
        {"channels": "attitude", "steps": 1},
    ],
    ids=str,
)
@pytest.mark.usefixtures("optimised")
def test_intervals_hold_whatever_the_networks_quality(changes):
    network = trained(**changes)
    for noise in (1.0,) if "noise" in changes else (0.1, 1.0, 7.0):
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


def test_errors_have_the_size_of_the_covariance():
    error = answered().parameters - many(1.0)[0]
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(answered().covariance), error) / 8
    assert abs(squares.mean() - 1) < 0.1


def test_the_same_key_gives_the_same_network_and_another_another():
    small = jaxos4.NetworkEstimator(**SHORT)
    a, b, c = (small.fit(problem_of(), BRACKET, key=jax.random.key(k), progress=k == 1) for k in (0, 0, 1))
    assert same(a, b)
    assert not same(a.regressor, c.regressor)


def test_a_second_training_of_the_same_shapes_compiles_nothing():
    """Other numbers are no reason to compile: bracket, noise, rate, number of steps, key."""
    compiled = []

    def count(event: str, _: float, **__) -> None:
        compiled.append(event == "/jax/core/compile/backend_compile_duration")

    def fit(changes, bracket, key):
        jaxos4.NetworkEstimator(**(SHORT | changes)).fit(problem_of(), bracket, key=jax.random.key(key))

    other = jaxos4.Bracket.around(BRACKET.center + 0.1 * BRACKET.half_width, 0.5 * BRACKET.half_width)
    fit({}, BRACKET, 0)
    jax.monitoring.register_event_duration_secs_listener(count)
    try:
        fit({"noise": (0.5, 2.0), "steps": 300, "learning_rate": 0.01}, other, 1)
    finally:
        jax.monitoring.unregister_event_duration_listener(count)
    assert not any(compiled)


def test_training_stops_early_without_progress():
    network = jaxos4.NetworkEstimator(
        **(SMALL | {"steps": 5000, "learning_rate": 1e-12, "patience": 2, "noise": (1.0, 1.0), "batch": 8})
    ).fit(problem_of(), BRACKET, key=jax.random.key(0))
    assert network.history.shape[0] < 20


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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"features": "fourier"}, r"`features` must be one of score, raw, got 'fourier'"),
        ({"approximator": "forest"}, r"`approximator` must be one of mlp, cmac"),
        ({"channels": "position"}, r"`channels` must be one of rates"),
        ({"features": "raw", "approximator": "cmac"}, r"needs `features` \"score\""),
        ({"steps": 0}, r"`steps` must be an integer of at least 1"),
        ({"held_out": 10}, r"`held_out` must be an integer of at least 1000"),
        ({"learning_rate": np.nan}, r"`learning_rate` must be positive"),
        ({"noise": (1.0, 0.1)}, r"`noise` must be \(lowest, highest\)"),
    ],
)
def test_settings_out_of_range_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        jaxos4.NetworkEstimator(**changes)


@pytest.mark.parametrize(
    ("changes", "bracket", "message"),
    [
        ({}, (BRACKET.lower, BRACKET.upper.at[2].set(BRACKET.lower[2])), "`bracket` of alpha3 must have a positive"),
        ({}, (jnp.zeros(7), jnp.ones(7)), "`bracket` must hold 8 parameters, got 7"),
        ({"channels": "attitude"}, (BRACKET.lower, BRACKET.upper), "`channels` 'attitude' are more than the problem's"),
    ],
)
def test_brackets_and_channels_that_cannot_be_trained_for_are_named(changes, bracket, message):
    with pytest.raises(ValueError, match=message):
        jaxos4.NetworkEstimator(**changes).fit(problem_of(), jaxos4.Bracket(*bracket), key=jax.random.key(0))


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


def test_a_network_takes_held_parameters_as_known():
    network, (alpha, states) = trained(), flights(400, seed=15)
    names_held = ["alpha1", "alpha5"]
    place = [PUBLISHED().parameter_names.index(name) for name in names_held]

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


def test_missing_samples_widen_the_intervals_and_no_more():
    alpha, states = many(1.0)
    fewer = identify(trained(), lost(states, share=0.4, seed=16))
    assert (np.asarray(fewer.std / answered().std) > 1.1).mean() > 0.9
    successful = np.array(names(fewer)) == "successful"
    assert successful.mean() > 0.9
    covered = np.mean((np.abs(fewer.parameters - alpha) < half_widths(fewer)[0.9][0])[successful], axis=0)
    assert np.abs(covered - 0.9).max() < 0.06


def test_a_flight_without_excitation_is_unidentifiable():
    """Hover: no yaw, no roll, no pitch."""
    hover = jnp.full_like(OMEGA, jaxos4.OS4.hover_speed)
    flight = jaxos4.simulate(PUBLISHED(), PUBLISHED().alpha, hover, dt=DT)
    still = problem_of(flight.states, omega=hover)
    network = jaxos4.NetworkEstimator(**SHORT).fit(still, BRACKET, key=jax.random.key(0))
    noisy = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(flight, key=jax.random.key(1))
    assert names(network(problem_of(noisy.states, omega=hover), BRACKET)) == "unidentifiable"


def test_a_column_that_is_missing_is_named_and_one_that_begins_late_is_not_another_start():
    network = trained(free=True)
    _, states = flights(LANES, seed=23)
    with pytest.raises(ValueError, match="it looks at q, which this flight did not measure"):
        network(problem_of(states[0].at[:, 9].set(jnp.nan), free=True), BRACKET)
    late = network(problem_of(states[0].at[:20, 9].set(jnp.nan), free=True), BRACKET)
    assert names(late) != "network_mismatch"
    assert np.isfinite(late.std).all()


def test_a_free_initial_state_is_estimated_too():
    network = trained(free=True)
    # Its intervals are calibrated over all the starts that it was trained for, and hold more often at their middle.
    alpha, states = flights(MANY, seed=17, start_width=network.features.coordinates.width[8:])
    estimates = identify(network, states, free=True)
    assert estimates.initial_state.shape == (MANY, 3)
    assert np.abs(estimates.initial_state).max() < 0.5  # +-0.3 rad/s, 30 standard deviations
    covered = np.mean(np.abs(estimates.parameters - alpha) < half_widths(estimates)[0.9][0], axis=0)
    assert np.abs(covered - 0.9).max() < 4.5 * np.sqrt(0.09 * (1 / MANY + 1 / 4000)) + 0.01


# The file.


def test_a_file_gives_back_the_same_network(tmp_path):
    for number, network in enumerate((trained(), trained(free=True), trained(features="raw", steps=1))):
        path = tmp_path / f"{number}.net"
        jaxos4.save_network(network, path)
        loaded, problem = jaxos4.load_network(path), problem_of(free=number == 1)
        assert same(loaded(problem, BRACKET), network(problem, BRACKET))
        assert same(loaded.history, network.history)
    with np.load(tmp_path / "0.net") as file:
        header = json.loads(str(file["header"]))
    assert header["version"] == jaxos4.__version__
    assert header["model"] == "published"
    assert header["settings"]["steps"] == SMALL["steps"]


def test_a_model_of_ones_own_cannot_be_saved(tmp_path):
    class Own(PUBLISHED):
        pass

    network = eqx.tree_at(lambda n: n.features.problem.model, trained(), Own())
    with pytest.raises(ValueError, match="model Own; only networks for published, corrected can be saved"):
        jaxos4.save_network(network, tmp_path / "own.net")
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def network_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("network") / "whole.net"
    jaxos4.save_network(trained(), path)
    return path


@settings(max_examples=30)
@given(st.data())
def test_a_file_that_was_cut_or_altered_is_refused_or_harmless(network_file, data):
    content = bytearray(network_file.read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        for _ in range(data.draw(st.integers(1, 4))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = network_file.with_name("altered.net")
    path.write_bytes(content)
    message = ""
    try:
        jaxos4.load_network(path)
    except jaxos4.InputError as error:
        message = str(error)
    assert "\n" not in message


class Trap:
    def __reduce__(self):
        return (pytest.fail, ("the file was executed",))


def test_a_file_of_another_version_or_with_objects_is_refused_and_not_run(tmp_path, network_file):
    path = tmp_path / "made.npz"
    with np.load(network_file) as file:
        arrays = dict(file)
    header = json.loads(str(arrays["header"])) | {"format": 2}
    for content, words in (
        (arrays | {"header": np.asarray(json.dumps(header))}, "trained by another version of jaxos4"),
        ({"header": np.array([Trap()], dtype=object)}, "not a whole network file"),
        ({"other": np.zeros(3)}, "not a whole network file"),
    ):
        np.savez(path, **content)
        with pytest.raises(jaxos4.InputError, match=words):
            jaxos4.load_network(path)


# The hybrid.


@pytest.mark.parametrize("seed", ["good", "misses", "outside"])
def test_the_hybrid_finds_what_ibss_finds(seed):
    """Misses: the network was trained in another bracket. Outside: one truth lies outside of the network's bracket."""
    network, (alpha, states) = trained(), flights(LANES, seed=18)
    if seed == "misses":
        aside = jaxos4.Bracket.around(BRACKET.center + 0.5 * BRACKET.half_width, 0.3 * BRACKET.half_width)
        network = jaxos4.NetworkEstimator(**SMALL).fit(problem_of(), aside, key=jax.random.key(0))
    if seed == "outside":
        flight = jaxos4.simulate(PUBLISHED(), BRACKET.center + 1.3 * BRACKET.half_width, OMEGA, dt=DT)
        noisy = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(flight, key=jax.random.key(22)).states
        assert names(network(problem_of(noisy), BRACKET)) in ("at_bound", "unidentifiable")
        states = states.at[5].set(noisy)
    hybrid, alone = (identify(e, states, channels="all") for e in (jaxos4.Hybrid(network), jaxos4.IBSS()))
    assert names(hybrid) == names(alone) == ["successful"] * LANES
    assert np.abs((hybrid.parameters - alone.parameters) / alone.std).max() < 0.1
    hit = ((alpha >= hybrid.seed.lower) & (alpha <= hybrid.seed.upper)).all(axis=1)
    if seed == "good":
        assert hybrid.rollouts.mean() < 0.5 * alone.rollouts.mean()
        assert hit.mean() > 0.95
    if seed == "misses":
        assert hit.mean() < 0.5


def test_the_hybrid_begins_at_the_initial_state_that_the_network_saw():
    """From the first measurement it takes 1.75 sweeps."""
    _, states = flights(LANES, seed=18)
    hybrid = identify(jaxos4.Hybrid(trained(free=True)), states, free=True)
    assert names(hybrid) == ["successful"] * LANES
    assert hybrid.sweeps.mean() < 1.2


def seed_of(result, parameters=BRACKET.center, std=np.inf):
    covariance = np.full((8, 8), np.inf) if np.isinf(std).all() else np.diag(np.square(std))
    numbers = {"parameters": parameters, "covariance": covariance, "initial_state": np.zeros(3)}
    numbers |= {"cost": np.asarray(np.inf), "rollouts": np.asarray(1), "sweeps": np.asarray(0)}
    return jaxos4.Estimate(result=result, **{name: jnp.asarray(value) for name, value in numbers.items()})


@eqx.filter_jit
def seeded(states, seeds):
    @jax.vmap
    def searched(states, seed):
        return search_from_seed(jaxos4.IBSS(), problem_of(states, channels="all").within(BRACKET), seed)

    return searched(states, seeds)


@pytest.mark.parametrize("name", ["network_mismatch", "nonfinite_trajectory", "at_bound", "unidentifiable"])
def test_a_seed_without_an_answer_is_never_passed_on(name):
    """A seed with a small error that is wrong is not believed either."""
    (alpha, states), half_width = flights(LANES, seed=21), np.asarray(BRACKET.half_width)
    seed = seed_of(getattr(jaxos4.RESULTS, name), std=1e-3 * half_width if name == "at_bound" else np.full(8, np.inf))
    sound = seed_of(jaxos4.RESULTS.successful, alpha[1], 1e-2 * half_width)
    stack = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), seed, sound, seed, sound)
    found, best = seeded(states[:4], stack), identify(jaxos4.IBSS(), states, channels="all")
    assert names(found) == ["successful"] * 4
    assert best.calibration is None
    for lane in (0, 2):
        assert np.abs((found.parameters[lane] - best.parameters[lane]) / best.std[lane]).max() < 0.1
        assert found.rollouts[lane] > found.rollouts[1]


def test_a_poisoned_lane_of_the_hybrid_leaves_the_others_alone():
    hybrid, states, others = jaxos4.Hybrid(trained()), flights(LANES, seed=20)[1], np.arange(LANES) != 3
    before, after = (identify(hybrid, s, channels="all") for s in (states, states.at[3, 5, 7].set(jnp.inf)))
    results = np.array(names(after))
    assert results[3] == "nonfinite_trajectory"
    assert set(results[others]) == {"successful"}
    np.testing.assert_array_equal(after.parameters[others], before.parameters[others])


# Intervals.


def test_half_widths_are_gaussian_unless_calibrated():
    estimate = seed_of(jaxos4.RESULTS.successful, std=np.asarray(BRACKET.half_width))
    np.testing.assert_allclose(estimate.half_width(0.95), 1.959963985 * estimate.std, rtol=1e-8)
    assert (estimate.half_width(0.95, simultaneous=True) > estimate.half_width(0.95)).all()
    for level in (0.0, 1.0, -1.0, 95.0):
        with pytest.raises(ValueError, match="`level` must lie between 0 and 1"):
            estimate.half_width(level)
