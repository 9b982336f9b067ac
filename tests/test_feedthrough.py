"""What the torque tells that the log does not: input innovations, and the likelihood given them."""

import tracemalloc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxos4
from experiments.sample_times.run import VEHICLE as CINERAT
from jaxos4.closed_loop import fly_standard
from jaxos4.identification.prepare_vehicle import prepare_vehicle
from jaxos4.logs import as_recordings
from jaxos4.shooting import InnovationsProblem
from jaxos4.shooting.feedthrough import FEEDTHROUGHS, MEANS, input_innovations, lagged
from jaxos4.shooting.gains import LogNoise

DT, SAMPLES = 0.01, 600
NOISE = LogNoise(*(jnp.log(jnp.full(3, x)) for x in (2.0, 0.1, 0.02)))


@pytest.fixture
def rng():
    """Random numbers, the same for each test."""
    return np.random.default_rng(0)


def in_loop(rng, *, pilot, integral=0.0):
    """Torque in four parts of each sample, and the rates: a controller that answers the two samples before.

    `pilot`: the standard deviation of what the controller adds of its own. `integral`: the gain on a leaky integral of
    the rates, with a time constant of 0.3 s.
    """
    rates = np.cumsum(rng.normal(size=(SAMPLES, 3)), axis=0) / 10
    torque, slow = np.zeros((SAMPLES, 4, 3)), means_of(rates, np.zeros(SAMPLES, int), 0.3)
    for k in range(2, SAMPLES):
        answer = -2 * rates[k - 1] + rates[k - 2] + 0.5 * torque[k - 1, 3] - integral * slow[k - 1]
        torque[k] = answer + pilot * rng.normal(size=(4, 3))
    return torque, rates


def means_of(series, stretch, time):
    """Exponential means up to each sample, by their recursion."""
    found, kept = np.zeros_like(series), np.exp(-DT / time)
    for k in range(len(series)):
        before = found[k - 1] if k and stretch[k] == stretch[k - 1] else 0.0
        found[k] = kept * before + (1 - kept) * series[k]
    return found


def of_axes(torque, rates, stretch, dt=DT, count=FEEDTHROUGHS, **settings):
    """The input innovations about the three axes."""
    each = (input_innovations(torque[:, :, i], rates[:, i], stretch, dt, count, **settings) for i in range(3))
    return np.stack([*each], axis=-1)


def test_a_torque_that_follows_from_the_past_has_no_innovation(rng):
    torque, rates = in_loop(rng, pilot=0.0)
    assert not of_axes(torque, rates, np.zeros(SAMPLES, int)).any()


def test_innovations_are_what_the_past_does_not_tell(rng):
    """They have a mean square of 1 and no correlation with the past, and hold most of what the pilot did."""
    torque, rates = in_loop(rng, pilot=1.0)
    found = of_axes(torque, rates, np.zeros(SAMPLES, int))
    assert found.shape == (SAMPLES, FEEDTHROUGHS, 3)
    assert not found[:10].any()
    for axis in range(3):
        own = found[10:, :, axis]
        np.testing.assert_allclose(own.T @ own / len(own), np.eye(FEEDTHROUGHS), atol=1e-9)
        for lag in range(1, 11):
            past = np.column_stack([torque[10 - lag : SAMPLES - lag, :, axis], rates[10 - lag : SAMPLES - lag, axis]])
            np.testing.assert_allclose(own.T @ past / len(own), 0.0, atol=1e-9)


def test_lagged_innovations_are_those_of_the_samples_before_in_the_same_stretch():
    found = lagged(np.arange(1.0, 8.0), np.array([0, 0, 0, 0, 1, 1, 1]), 3)
    expected = [[1, 0, 0], [2, 1, 0], [3, 2, 1], [4, 3, 2], [5, 0, 0], [6, 5, 0], [7, 6, 5]]
    np.testing.assert_array_equal(found, expected)


def assert_same_directions(found, expected, *, atol):
    """The sign of a direction is arbitrary."""
    np.testing.assert_allclose(found * np.sign(np.sum(found * expected, axis=0)), expected, atol=atol)


@pytest.mark.parametrize(
    ("lags", "times", "speeds", "slow"),
    [(10, (), 0, 0), (3, MEANS, 0, 0), (10, (), 1, 0), (10, (), 0, 2), (3, MEANS, 2, 2)],
)
def test_innovations_are_the_residuals_of_a_regression_within_stretches(rng, lags, times, speeds, slow):
    """Against a regression with the whole matrix. One stretch is too short for a row, and the controller integrates."""
    torque, rates = in_loop(rng, pilot=1.0, integral=1.0)
    speeds, slow = (rng.normal(100.0, 0.3, size=(SAMPLES, signals)) for signals in (speeds, slow))
    torque[1:] += (speeds.sum(axis=1) + slow.sum(axis=1))[:-1, None, None]
    stretch = np.repeat([0, 1, 2], [250, lags - 2, SAMPLES - 248 - lags])
    found = of_axes(torque, rates, stretch, memory=lags * DT, means=times, speeds=[*speeds.T], slow=[*slow.T])
    rows = np.concatenate([np.arange(lags, 250), np.arange(248 + 2 * lags, SAMPLES)])
    assert not np.delete(found, rows, axis=0).any()
    for axis in range(3):
        samples = np.column_stack([torque[:, :, axis], rates[:, axis], speeds])
        both = np.column_stack([torque[:, :, axis].mean(axis=1), rates[:, axis]])
        means = (means_of(both - both.mean(axis=0), stretch, time)[rows - 1] for time in times)
        past = np.column_stack([np.ones(len(rows)), *(samples[rows - lag] for lag in range(1, lags + 1)), *means])
        past = np.hstack([past, slow[rows - 1]])
        now = torque[rows, :, axis]
        rest = now - past @ np.linalg.lstsq(past, now)[0]
        directions = np.sqrt(len(rows)) * np.linalg.svd(rest, full_matrices=False)[0][:, :FEEDTHROUGHS]
        assert_same_directions(found[rows, :, axis], directions, atol=1e-9)


def test_innovations_need_a_measured_past(rng):
    """Where measurements are held out, the flight counts as two stretches."""
    torque, rates = in_loop(rng, pilot=1.0)
    held_out, missing = np.s_[200:300], rates.copy()
    missing[held_out] = np.nan
    found = of_axes(torque, missing, np.zeros(SAMPLES, int))
    kept = np.delete(np.arange(SAMPLES), np.arange(201, 300))
    alone = of_axes(torque[kept], rates[kept], np.repeat([0, 1], [201, SAMPLES - 300]))
    assert not found[201:310].any()
    for axis in range(3):
        assert_same_directions(found[kept, :, axis], alone[:, :, axis], atol=1e-9)


@pytest.mark.parametrize("every", [2, 5])
def test_a_slower_sensor_is_interpolated(rng, every):
    """Gaps that are shorter than the memory cost no innovations."""
    torque, rates = in_loop(rng, pilot=1.0)
    slower = np.full_like(rates, np.nan)
    slower[::every] = rates[::every]
    found, whole = (of_axes(torque, each, np.zeros(SAMPLES, int)) for each in (slower, rates))
    assert (found[10:].any(axis=1)).all()
    for axis in range(3):
        overlap = np.linalg.svd(found[:, :, axis].T @ whole[:, :, axis] / (SAMPLES - 10), compute_uv=False)
        assert (overlap > 0.8).all()


def test_the_past_holds_a_measurement_before_the_torque(rng):
    torque, rates = in_loop(rng, pilot=1.0)
    torque[1:] += rates[1:, None]
    for measured_first in (False, True):
        found = of_axes(torque, rates, np.zeros(SAMPLES, int), measured_first=measured_first)[10:, 0]
        correlations = np.abs(np.mean(found * rates[10:], axis=0))
        assert (correlations < 1e-9).all() == measured_first


@pytest.mark.parametrize("measured_first", [False, True])
def test_innovations_do_not_correlate_with_a_known_slow_signal(rng, measured_first):
    """With `measured_first` the value in the sample itself is past, else that of the sample before."""
    torque, rates = in_loop(rng, pilot=1.0)
    angles = np.cumsum(rates, axis=0) * DT + 0.2 * rng.normal(size=rates.shape)
    answered = angles if measured_first else np.concatenate([angles[:1], angles[:-1]])
    torque -= 5 * answered[:, None]
    for slow, is_known in (([*angles.T], True), ((), False)):
        found = of_axes(torque, rates, np.zeros(SAMPLES, int), slow=slow, measured_first=measured_first)[10:, 0]
        correlations = np.abs(np.mean(found * answered[10:], axis=0))
        assert (correlations < 1e-9 if is_known else correlations > 1e-3).all()


def test_means_count_where_they_explain_more_than_chance_does(rng):
    """Regressors without effect would cost information about the parameters."""
    stretch = np.zeros(SAMPLES, int)
    without, integrates = in_loop(rng, pilot=1.0), in_loop(rng, pilot=1.0, integral=1.0)
    np.testing.assert_array_equal(of_axes(*without, stretch, means=MEANS), of_axes(*without, stretch))
    found, short = (of_axes(*integrates, stretch, memory=3 * DT, means=times) for times in (MEANS, ()))
    assert (found != short).any(axis=(0, 1)).all()


def test_a_slow_signal_with_a_long_gap_is_left_out(rng):
    """The values that fill a gap would act as a regressor."""
    torque, rates = in_loop(rng, pilot=1.0)
    angle = np.cumsum(rates[:, 0])
    torque[1:] -= angle[:-1, None, None]
    for gap, is_left_out in ((8, False), (100, True)):
        lost = np.where(np.abs(np.arange(SAMPLES) - 300) < gap / 2, np.nan, angle)
        found, without = (of_axes(torque, rates, np.zeros(SAMPLES, int), slow=slow) for slow in ([lost], ()))
        assert (found == without).all() == is_left_out


def test_a_slow_signal_of_a_slower_sensor_is_held(rng):
    """Its next value is an answer to the torque in between."""
    torque, rates = in_loop(rng, pilot=1.0)
    angle = np.where(np.arange(SAMPLES) % 5 == 0, np.cumsum(rates[:, 0]), np.nan)
    held = np.repeat(angle[::5], 5)
    found, same = (of_axes(torque, rates, np.zeros(SAMPLES, int), slow=[x]) for x in (angle, held))
    np.testing.assert_array_equal(found, same)


@pytest.mark.parametrize("parts", [[0, 0, 1, 1], [0, 1, 2, 2]])
def test_the_rounding_of_the_log_changes_no_innovation(rng, parts):
    """Commands are held for some parts, so parts are equal but for rounding; those of later samples too."""
    torque, rates = in_loop(rng, pilot=1.0)
    torque, rates = torque[:, parts], np.zeros_like(rates)
    rounded = torque + 1e-11 * rng.normal(size=torque.shape)
    found, again = (of_axes(x, rates, np.zeros(SAMPLES, int)) for x in (torque, rounded))
    assert found[10:].any(axis=(1, 2)).all()
    assert_same_directions(again, found, atol=1e-6)


@pytest.mark.parametrize(("count", "times"), [(FEEDTHROUGHS, ()), (1, MEANS)])
def test_an_hour_of_samples_of_4_ms_needs_less_than_200_megabytes(rng, count, times):
    """Memory is linear in the samples. The matrix of the regression would need five times as much."""
    samples, hour = 50_000, 900_000
    data = rng.normal(size=(samples, 4, 3)), rng.normal(size=(samples, 3)), np.zeros(samples, int)
    of_axes(*(signal[:1000] for signal in data), means=times)  # imports what it needs
    tracemalloc.start()
    try:
        assert of_axes(*data, 0.004, count, means=times)[25:].any(axis=(1, 2)).all()
        assert tracemalloc.get_traced_memory()[1] < 200e6 * samples / hour
    finally:
        tracemalloc.stop()


def test_a_stretch_is_not_told_by_the_stretch_before(rng):
    torque, rates = in_loop(rng, pilot=1.0)
    stretch = np.repeat([0, 1], SAMPLES // 2)
    found = of_axes(torque, rates, stretch)
    begins = SAMPLES // 2 + np.arange(10)
    assert not found[begins].any()
    torque[: SAMPLES // 2], rates[: SAMPLES // 2] = 0.0, 0.0
    alone = of_axes(torque[SAMPLES // 2 :], rates[SAMPLES // 2 :], stretch[SAMPLES // 2 :])
    assert alone[10:].any(axis=(1, 2)).all()


@pytest.mark.parametrize("samples", [3, 12])
def test_a_flight_that_is_too_short_has_none(rng, samples):
    torque, rates = in_loop(rng, pilot=1.0)
    assert not of_axes(torque[:samples], rates[:samples], np.zeros(samples, int)).any()


def standard(rng, *, passed, segments=2):
    """The standard flight with noise, and `passed` input innovations about each axis."""
    model = jaxos4.PublishedOS4()
    omega = jaxos4.multisine(model.airframe, duration=3.0, dt=DT)
    flight = jaxos4.simulate(model, model.alpha, omega, dt=DT)
    noisy = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(flight, key=jax.random.key(0))
    problem = jaxos4.ShootingProblem(model, noisy, sigma=jaxos4.SENSOR_SIGMA, channels="rates")
    innovations = rng.normal(size=(len(omega), passed, 3))
    return InnovationsProblem(problem, segments=segments, settling=50, input_innovations=innovations)


# Without gyroscopic torques a channel's noise changes no other channel, and rates are integrals.
UNCOUPLED = jnp.array([0.0, 0.0, 133.0, 0.0, 0.0, 133.0, 0.0, 77.0])


def test_the_likelihood_compares_innovations_less_the_feedthrough(rng):
    """The cost is quadratic in what input innovations explain; its derivatives are those of finite differences."""
    problem = standard(rng, passed=2)
    names = problem.unknowns.names
    assert names[8:11] == ("log_p_strength", "log_p_time", "log_p_sensor")
    assert names[11:17] == tuple(
        f"p_{of}_{i}" for of in ("rate_gain", "disturbance_gain", "feedthrough") for i in (1, 2)
    )
    own = jnp.concatenate([jnp.stack(NOISE[:3], axis=1), 0.01 * jnp.arange(18.0).reshape(3, 6)], axis=1)
    values = jnp.concatenate([UNCOUPLED, own.ravel()])

    @eqx.filter_jit
    def at(values):
        return problem.local_model(values[None])

    found, step = at(values), 1e-4
    explaining = ("p_feedthrough_2", "r_feedthrough_1", "q_rate_gain_1", "p_rate_gain_2", "r_disturbance_gain_2")
    for name in (*explaining, "alpha3", "log_q_sensor"):
        place = names.index(name)
        change = step * (abs(float(values[place])) + 0.01)
        up, down = (at(values.at[place].add(sign * change)) for sign in (1, -1))
        slope = (up.cost - down.cost) / (2 * change)
        np.testing.assert_allclose(found.gradient[0, place], slope[0], rtol=1e-5, atol=1e-6)
        if name in explaining:
            second = (up.cost - 2 * found.cost + down.cost) / change**2
            np.testing.assert_allclose(found.information[0, place, place], second[0], rtol=1e-3)


@pytest.mark.slow
def test_the_filter_does_not_depend_on_the_feedthrough(rng):
    """Only what is compared does: innovations are e - k v, with e those without feedthrough."""
    problem, k = standard(rng, passed=1), jnp.array([0, 0, 1])[:, None, None] * jnp.array([[0.01], [0.02], [-0.03]])
    parameters = problem.model.alpha
    cost = eqx.filter_jit(lambda passed: problem.innovations(parameters, NOISE, passed).cost.sum())
    one, none, other, twice, opposite = (float(cost(size * k)) for size in (1, 0, -1, 2, -2))
    # The squares of e - k v and e + k v have the same mean as those of e, and of k v, which add up.
    np.testing.assert_allclose(twice + opposite - 2 * none, 4 * (one + other - 2 * none), rtol=1e-9)


def test_gains_correct_the_estimates_of_rate_and_disturbance(rng):
    """Rates that change by what the torque tells have the likelihood of the rates without these changes."""
    problem, dt = standard(rng, passed=1, segments=1), DT
    told = np.asarray(problem.input_innovations)[:, 0]  # (samples, rates)
    kept = np.exp(-dt / np.exp(np.asarray(NOISE.time_constant)))
    reach = np.exp(np.asarray(NOISE.time_constant)) * (1 - kept)
    gains = 0.02 * np.array([1.0, -2.0, 3.0]), 0.5 * np.array([-1.0, 2.0, 1.0])
    moved, rate, disturbance = np.zeros_like(told), np.zeros(3), np.zeros(3)
    for k in range(len(told) - 1):
        rate = rate + reach * disturbance + gains[0] * told[k]
        disturbance = kept * disturbance + gains[1] * told[k]
        moved[k + 1] = rate
    flight = problem.flight
    states = flight.states.at[:, 6 + np.array([1, 3, 5])].add(moved)
    other = eqx.tree_at(lambda p: p.problem.flight.states, problem, states)
    by_input = jnp.stack([*map(jnp.asarray, gains), jnp.zeros(3)])[..., None]
    cost = eqx.filter_jit(lambda problem, by_input: problem.innovations(UNCOUPLED, NOISE, by_input).cost.sum())
    np.testing.assert_allclose(cost(other, by_input), cost(problem, jnp.zeros_like(by_input)), rtol=1e-9)
    assert cost(other, jnp.zeros_like(by_input)) > cost(problem, jnp.zeros_like(by_input)) + 10


def test_without_answers_within_a_sample_feedthroughs_are_fixed_and_gains_are_free(rng):
    problem = standard(rng, passed=1)
    late = InnovationsProblem(
        problem.problem, segments=2, settling=50, input_innovations=problem.input_innovations, answers_within=False
    )
    for each, is_free in ((problem, True), (late, False)):
        free = dict(zip(each.unknowns.names, np.asarray(each.unknowns.free), strict=True))
        assert free["p_feedthrough_1"] == is_free
        assert free["p_rate_gain_1"]
        assert free["r_disturbance_gain_1"]


@pytest.mark.parametrize("is_lagged", [False, True])
def test_only_the_first_of_lagged_innovations_has_a_gain_on_the_disturbance(rng, is_lagged):
    """One sample later, a disturbance is the same less a step of the rate: a second gain would have no information."""
    problem = standard(rng, passed=3)
    each = InnovationsProblem(problem.problem, input_innovations=problem.input_innovations, lagged=is_lagged)
    free = dict(zip(each.unknowns.names, np.asarray(each.unknowns.free), strict=True))
    assert all(free[f"q_rate_gain_{i}"] for i in (1, 2, 3))
    assert [bool(free[f"q_disturbance_gain_{i}"]) for i in (1, 2, 3)] == [True, not is_lagged, not is_lagged]


def test_gains_of_no_input_innovation_are_fixed(rng):
    """Nothing would hold them, and a search would follow them without end."""
    problem = standard(rng, passed=2)
    one = eqx.tree_at(lambda p: p.input_innovations, problem, problem.input_innovations.at[:, 1, 2].set(0.0))
    free = dict(zip(one.unknowns.names, np.asarray(one.unknowns.free), strict=True))
    fixed = [name for name, is_free in free.items() if not is_free]
    assert fixed == ["r_rate_gain_2", "r_disturbance_gain_2", "r_feedthrough_2"]


def test_input_innovations_must_fit_the_flight(rng):
    problem = standard(rng, passed=1).problem
    with pytest.raises(ValueError, match=r"`input_innovations` must have shape \(301, feedthroughs, 3\)"):
        InnovationsProblem(problem, input_innovations=rng.normal(size=(10, 1, 3)))


@pytest.mark.slow
def test_a_search_counts_as_noise_what_the_feedthroughs_that_it_found_explain(rng):
    """A second search, in the likelihood with these feedthroughs, begins at its end."""
    problem, search = standard(rng, passed=1), jaxos4.FilterError()
    found = search(problem)
    passed, nothing = found.parts.noise_feedthrough, np.zeros((3, 1))
    std = found.std[-1]
    assert 0 < np.abs(passed).max() < 5 * std  # noise, as there is no feedthrough
    again = search(problem.with_noise_feedthrough(passed).starting_from(found.parameters))
    assert again.sweeps < found.sweeps
    np.testing.assert_array_equal(again.parts.noise_feedthrough, passed)
    np.testing.assert_allclose(again.cost, found.cost, atol=3e-3)
    assert search(problem.with_noise_feedthrough(nothing)).cost < found.cost


@pytest.mark.parametrize("logged", ["commands", "speeds"])
def test_commands_in_short_samples_have_innovations_of_earlier_samples(logged):
    loop = jaxos4.ClosedLoop(CINERAT, gust=2.0, rotor_lag=0.04, logged=logged)
    every = prepare_vehicle(as_recordings(fly_standard(loop, duration=16.0, seed=0)), CINERAT, jaxos4.VehicleSettings())
    for data in every:
        is_short = logged == "commands" and data.provenance.sample_time <= 0.005
        first, second = np.asarray(data.likelihood.input_innovations)[: data.time.size, :2, 0].T
        assert first.any()
        assert bool(data.likelihood.lagged) == is_short == (second[1:] == first[:-1]).all()
    # All sample times share a program.
    trees = (jax.tree.flatten(data.likelihood) for data in every)
    assert len({(structure, *((leaf.shape, leaf.dtype) for leaf in leaves)) for leaves, structure in trees}) == 1


@pytest.mark.parametrize("logged", ["commands", "speeds"])
def test_past_speeds_and_attitude_predict_the_torque_if_speeds_are_measured(logged):
    """Each row of the rotors also responds to the attitude of the row before, whose noise no past torque predicts."""
    loop = jaxos4.ClosedLoop(CINERAT, gust=2.0, logged=logged, attitude_noise=0.05)
    (recording,) = as_recordings(fly_standard(loop, duration=16.0, seed=0))
    omega, (x, y) = recording.omega.copy(), np.sign(CINERAT.rotor_positions).T
    omega[1:] -= 20 * (recording.states[:-1, [6]] * y - recording.states[:-1, [8]] * x)
    settings = jaxos4.VehicleSettings(holdout=0.0)
    data = prepare_vehicle([recording._replace(omega=omega)], CINERAT, settings)[0]
    flight = data.problem.flight
    phi, theta = np.asarray(flight.states)[1:, [6, 8]].T
    vx, vy, _ = np.asarray(flight.body_velocity)[1:].T
    speeds = np.asarray(flight.within)[:-1].mean(axis=1) @ CINERAT.rotor_spins
    innovations = np.asarray(data.likelihood.input_innovations)[1 : data.time.size, 0]
    for signal, axis in (
        *((each, axis) for axis in (0, 1) for each in (np.cos(theta) * np.sin(phi), np.sin(theta), vx, vy)),
        (speeds, 2),
    ):
        correlation = np.mean(innovations[:, axis] * (signal - signal.mean())) / signal.std()
        assert (abs(correlation) < 1e-6) == (logged == "speeds")


def test_no_torque_before_an_instant_answers_what_is_measured_at_it():
    """Means, and slower logs, hold such answers."""
    flight = fly_standard(jaxos4.ClosedLoop(CINERAT, gust=2.0), duration=16.0, seed=0)
    (every,), slow = as_recordings(flight), as_recordings(flight)[0].rows(slice(None, None, 2))
    own, longer = prepare_vehicle([every], CINERAT, jaxos4.VehicleSettings())[:2]
    slower = prepare_vehicle([slow], CINERAT, jaxos4.VehicleSettings())[0]
    assert not own.likelihood.answers_within
    assert longer.likelihood.answers_within
    assert slower.likelihood.answers_within
    assert float(slower.problem.flight.averaging_time) == 0.0
