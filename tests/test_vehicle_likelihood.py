"""A vehicle in closed loop: its sample time, means of specific force, the weight, shifted clocks."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
from helpers import CRAZYFLIE, compiled_programs
from scipy.spatial.transform import Rotation

import jaxos4
from jaxos4.flight import STATE_NAMES
from jaxos4.identification import answers, fit, intervals, prepare_vehicle as preparation
from jaxos4.identification.answers import VehicleAnswer, vehicle_constants
from jaxos4.identification.data import Data
from jaxos4.identification.fit import chosen_place, moved, sample_time_of, search_sample_times
from jaxos4.identification.intervals import corrected
from jaxos4.identification.prepare_vehicle import prepare_vehicle
from jaxos4.identification.results import Constant, FixedParameter, SampleTime
from jaxos4.identification.search import (
    USUAL_DELAY,
    USUAL_DELAY_OF_COMMANDS,
    Optimum,
    _lowest_in_delay,
    _without_negative,
    search_all,
)
from jaxos4.logs import as_recordings
from jaxos4.recording import averaged
from jaxos4.recording.prepared import finest, prepare
from jaxos4.results import RESULTS
from jaxos4.shooting import InnovationsProblem
from jaxos4.shooting.gains import LogNoise
from jaxos4.shooting.innovations import SETTLING

pytestmark = pytest.mark.usefixtures("all_optimised")  # a search computes for longer than it compiles

DT, SAMPLES = 0.004, SETTLING + 8 * 384
ANGLES_AND_RATES = [STATE_NAMES.index(name) for name in ("phi", "theta", "psi", "p", "q", "r")]
TERMS = ("offset", "lag", "delay", "accelerometer")


@functools.cache
def flown():
    keys = jax.random.split(jax.random.key(2))
    references = jaxos4.random_references(duration=DT * (SAMPLES - 1), dt=DT, key=keys[0])
    return jaxos4.fly_closed_loop(jaxos4.ClosedLoop(CRAZYFLIE, gust=2.0), references, dt=DT, key=keys[1])


def problem_of(flight):
    model = jaxos4.FlightModel(CRAZYFLIE, terms=TERMS)
    shooting = jaxos4.ShootingProblem(model, flight, sigma=np.full(12, 0.02), channels="rates", method="rk4")
    return InnovationsProblem(shooting)


@eqx.filter_jit
def cost_of(problem, parameters, noise):
    return problem.innovations(parameters, noise).cost.sum()


SOLVER = jaxos4.FilterError(tolerance=1e-3)


def data_of(flight, sample_time):
    """As `jaxos4.identify` prepares it, so that all fits are one program."""
    settings = jaxos4.VehicleSettings(terms=TERMS, sample_time=sample_time, holdout=0.0)
    return prepare_vehicle(as_recordings(flight), CRAZYFLIE, settings)[0]


@eqx.filter_jit
def centered_forcing_of(model, inputs, parameters):
    return model.centered_forcing(inputs, parameters)


# The choice of the sample time.


def table(*rows):
    """Answers at 4, 8, 16 ms and so on. A row: Ix and Iy with a standard deviation of 1, and the correlation."""
    return [
        SampleTime(
            DT * 2**i,
            {name: Constant(value, 1.0, "kg m^2") for name, value in zip(("Ix", "Iy"), values, strict=False)},
            correlation,
            samples=5000 // 2**i,
        )
        for i, (values, correlation) in enumerate(rows)
    ]


A, B, C = (10.0, 20.0), (13.0, 20.0), (10.0, 25.0)
PLATEAUS = {
    "one": ([(A, 0.0)], 0),
    "plateau": ([(A, 0.1), (A, 0.0), (A, 0.0)], 0),
    "later plateau": ([(A, 0.1), (B, 0.0), (B, 0.0)], 1),
    "plateau of Iy": ([(A, 0.1), (C, 0.0), (C, -0.1)], 1),
    "beyond chance": ([(A, 0.12), (A, 0.1), (A, 0.1)], 1),
    "negative": ([(A, -0.5), (A, 0.1), (A, 0.1)], 1),
    "none white": ([(A, 0.9), (A, 0.8), (A, 0.7)], 2),
    "last alone": ([(A, 0.9), (A, 0.8), (A, 0.1)], 2),
    "no plateau": ([(A, 0.1), (B, 0.1), (A, 0.1)], 0),
    "no answer": ([((), 0.1), (A, 0.1), (A, 0.1)], 1),
    "no answer beside it": ([(A, 0.0), ((), 0.0), (B, 0.0), (B, 0.0)], 2),
    "nothing shared": ([((10.0,), 0.0), ((), 0.0), ((10.0,), 0.0), ((10.0,), 0.0)], 0),
}


@pytest.mark.parametrize(("rows", "place"), PLATEAUS.values(), ids=PLATEAUS)
def test_the_shortest_white_sample_time_of_a_plateau_is_chosen(rows, place):
    """Answers agree within two standard deviations and three percent."""
    assert chosen_place(table(*rows)) == place
    own, near, far = (table((values, 0.0))[0] for values in (A, (12.2, 20.0), (12.4, 20.0)))
    assert moved(own, near) == []
    assert moved(own, far) == moved(far, own) == ["Ix"]


@pytest.mark.parametrize(
    ("logged", "commands", "shortest"),
    [
        (0.001, 0.0, 0.002),
        (0.002, 0.0, 0.002),
        (0.005, 0.0, 0.005),
        (0.0005, 0.0005, 0.002),
        (0.00101, 0.00101, 0.00202),
    ]
    + [(0.00125, 0.00125, 0.00375), (0.002, 0.002, 0.004), (0.001, 0.004, 0.004), (0.005, 0.005, 0.005)],
)
def test_the_shortest_samples_hold_single_rows_of_speeds_and_two_new_commands(logged, commands, shortest):
    assert finest(logged, commands=commands) == pytest.approx(shortest)


KINDS = {
    "white": ((0.1, 0.0), (0.0, 0.0), "Bb", "bB"),
    "only the shorter is white": ((0.0, 0.15), (0.0, 0.0), "Bb", "bB"),
    "near white": ((0.15, 0.15), (0.0, 0.0), "BbDd", "dD"),
    "far from white": ((0.0, 0.5), (0.0, 0.0), "BDd", "dD"),
    "no kind is white": ((0.2, 0.5), (0.3, 0.3), "BDdb", "bB"),
    "the other is less far": ((0.4, 0.5), (0.3, 0.3), "BDdb", "dD"),
    "no answer": ((0.4, 1.0), (0.0, 0.0), "BbDd", "dD"),
    "one kind": ((0.4, 0.5), (), "Bb", "bB"),
}


class Named(Data, VehicleAnswer):
    """Data with a name, and their answer."""

    contains_answers, optimum = False, Optimum._make(len(Optimum._fields) * [None])

    def __init__(self, name):
        self.__dict__.update(name=name, contains_answers=name in "dD")


@pytest.mark.parametrize(("answered", "hidden", "order", "kept"), KINDS.values(), ids=KINDS)
def test_kinds_of_samples_are_fitted_in_order_until_one_has_white_innovations(
    monkeypatch, answered, hidden, order, kept
):
    """There are two kinds; capitals are the longest samples. Correlations are those of the shorter and the longest."""
    names = dict(zip("bBdD", (*answered, *hidden), strict=False))
    fitted = []

    def searched_all(solver, data):
        fitted.append(data.name)
        return data

    def searched(several, solver, longest, progress):
        for data in reversed(several):
            yield data if data is longest else searched_all(solver, data)

    monkeypatch.setattr(fit, "search_all", searched_all)
    monkeypatch.setattr(fit, "search_sample_times", searched)
    monkeypatch.setattr(fit, "_fitting", lambda data: data.name)
    monkeypatch.setattr(fit, "corrected", lambda data: data)
    monkeypatch.setattr(
        fit, "sample_time_of", lambda data: table((() if names[data.name] == 1.0 else A, names[data.name]))[0]
    )
    found, rows = fit.fit_sample_times([*map(Named, names)], SOLVER, choose=True, progress=lambda _: None)
    assert ("".join(fitted), "".join(each.name for each in found)) == (order, kept)
    assert [row.correlation for row in rows] == [names[name] for name in kept]


@pytest.mark.parametrize("estimator", [fit.DEFAULT, jaxos4.FilterError(tolerance=0.1, max_steps=7)])
def test_filter_error_searches_once_at_each_sample_time_with_its_own_settings(monkeypatch, estimator):
    searches = []

    def search(solver, data, **options):
        searches.append((data.name, solver))
        return data

    def searched(several, solver, longest, progress):
        return (search(solver, data) for data in reversed(several))

    monkeypatch.setattr(fit, "search", search)
    monkeypatch.setattr(fit, "search_sample_times", searched)
    monkeypatch.setattr(fit, "corrected", lambda data: data)
    monkeypatch.setattr(fit, "sample_time_of", lambda data: table((A, 0.0))[0])
    monkeypatch.setattr(fit, "at_lowest", lambda answer, solver, progress: answer)
    several = [*map(Named, "bB")]
    answer, rows = fit.fit_vehicle(several, estimator, choose=True, seed=0, progress=lambda _: None)
    assert searches == [(name, SOLVER if estimator == fit.DEFAULT else estimator) for name in "Bb"]
    assert (answer, len(rows)) == (several[0], 2)


def test_a_sample_time_that_knows_the_inertias_badly_is_not_chosen():
    """Its interval agrees with anything."""
    near = table((A, 0.0), ((10.5, 20.0), 0.0), ((10.5, 20.0), 0.0))
    wide = {name: Constant(row.estimate, 2.0, "kg m^2") for name, row in near[0].constants.items()}
    vague = msgspec.structs.replace(near[0], constants=wide)
    assert chosen_place(near) == 0
    assert chosen_place([vague, *near[1:]]) == 1


def identified(**settings):
    return jaxos4.identify(flown(), CRAZYFLIE, settings=jaxos4.VehicleSettings(terms=TERMS, **settings))


@pytest.fixture(scope="module")
def chosen():
    """The identification at all sample times, each with a profile; its programs; and two at sample times of these."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(intervals, "WELL_KNOWN", 0.0)
        patch.setattr(answers, "NOTED", 1.002)
        # Samples of commands at all sample times hold answers of the controller, so that all are compared.
        patch.setattr(preparation, "UNANSWERED", 0.0)
        with compiled_programs() as programs:
            rule = identified()
        given = {place: identified(sample_time=rule.sample_times[place].sample_time) for place in (0, 2)}
    return rule, programs, given


@pytest.mark.slow
def test_four_sample_times_and_the_profile_need_one_program(chosen):
    """The length of a flight is data. The table of sample times shows the intervals of the answer."""
    found, programs, _ = chosen
    np.testing.assert_allclose([each.sample_time for each in found.sample_times], [0.004, 0.008, 0.016, 0.032])
    searches = [name for name in programs if name is not None and "call" in name.lower()]
    assert len(searches) == 1, programs
    (answer,) = [each for each in found.sample_times if each.sample_time == found.provenance.sample_time]
    assert answer.constants == found.rigid_body.constants
    noted = {name for name, row in found.parameters.items() if "times as long, by the profile" in row.note}
    longer = {name for name, row in found.parameters.items() if row.std is not None and row.std >= 1.002 * row.bound}
    assert longer == noted | set(found.widened) | {"thrust_gain"}  # by the error of the accelerometer's scale
    assert set() < noted <= {"alpha3", "alpha6", "alpha8"}


@pytest.mark.slow
@pytest.mark.parametrize("place", [0, 2])
def test_a_sample_time_that_is_given_has_the_answer_of_the_rule(chosen, place):
    """The same samples, numbers and checks."""
    rule, _, found = chosen
    sample_time, given = rule.sample_times[place].sample_time, found[place]
    assert given.provenance.sample_time == pytest.approx(sample_time)
    assert len(given.sample_times) == len(rule.sample_times) - place
    for one, other in zip(given.sample_times[1:], rule.sample_times[place + 1 :], strict=True):
        for name, row in one.constants.items():
            assert row.estimate == pytest.approx(other.constants[name].estimate, rel=1e-6)
    if sample_time == rule.provenance.sample_time:
        assert given.result == rule.result
        for name, row in given.rigid_body.constants.items():
            assert row.estimate == pytest.approx(rule.rigid_body.constants[name].estimate, rel=1e-6)
            assert row.std == pytest.approx(rule.rigid_body.constants[name].std, rel=1e-4)


@pytest.mark.parametrize(("noise", "count"), [(0.3, 0.0), (0.0, 0.005), (0.001, 0.1)])
def test_the_noise_of_an_accelerometer_is_at_least_its_count_and_half_of_its_second_differences(noise, count):
    force = (
        9.81
        + 0.2 * np.sin(2 * np.pi * 0.5 * DT * np.arange(SAMPLES))
        + noise * np.random.default_rng(0).normal(size=SAMPLES)
    )
    force = count * np.round(force / count) if count else force
    flight = dataclasses.replace(flown(), specific_force=np.stack([np.full(SAMPLES, np.nan)] * 2 + [force], axis=1))
    for prepared in prepare(as_recordings(flight), CRAZYFLIE, holdout=0.0):
        rows = round(float(prepared.fitted.dt) / DT)
        least = max(noise / 2, count) / np.sqrt(rows)
        assert prepared.force_noise[2] == pytest.approx(least, rel=0.1)


@pytest.mark.parametrize(
    ("delay", "compared", "cost", "chosen", "searches"),
    [
        (0.012, None, 1.0, 1, 2),
        (0.012, None, 3.0, 0, 2),
        (0.003, None, 1.0, 0, 0),
        (0.012, 0.011, 1.0, 0, 0),
        (0.012, 0.006, 1.0, 1, 2),
    ],
)
def test_the_search_begins_again_near_the_usual_delay(delay, compared, cost, chosen, searches):
    """The cost has a minimum in the delay for each row of a log: 17 ms instead of 0 made Ix 12 % too large."""
    data, starts = data_of(flown(), DT), []
    likelihood = dataclasses.replace(data.likelihood, answers_within=jnp.array(False))
    names = likelihood.problem.unknowns.names

    def estimate(delay, cost):
        values = np.zeros(likelihood.unknowns.count)
        values[names.index("rotor_delay")] = delay
        counts = jnp.asarray(cost), jnp.asarray(5), jnp.asarray(1)
        covariance = jnp.eye(values.size)
        return jaxos4.Estimate(jnp.asarray(values), covariance, jnp.zeros(0), *counts, RESULTS.successful)

    def estimator(problem):
        place = names.index("rotor_delay")
        starts.append((bool(problem.problem.unknowns.free[place]), float(problem.start[place])))
        return estimate(USUAL_DELAY_OF_COMMANDS, cost)

    found = estimate(delay, 2.0)
    first = Optimum(data, likelihood, found, found, likelihood.problem.unknowns, 0)
    after = _lowest_in_delay(estimator, first, USUAL_DELAY_OF_COMMANDS, compared)
    for other in (after.estimate, after.unrestricted):
        assert (other is not found, after.rollouts, len(starts)) == (bool(chosen), 5 * searches, searches)
    # Searches of shorter samples need not compare this delay again.
    assert after.compared_delay == (None if chosen or delay == 0.003 else compared or delay)
    if starts:
        assert [free for free, _ in starts] == [False, True]
        assert starts[1][1] == USUAL_DELAY_OF_COMMANDS


@pytest.mark.parametrize(
    ("at_zero", "result", "other", "chosen"),
    [
        (2.5, RESULTS.successful, 1.0, False),
        (3.5, RESULTS.successful, 1.0, True),
        (3.0, RESULTS.successful, 1.0, True),  # the search at 0 ended near the usual delay
        (3.5, RESULTS.nonfinite_trajectory, 1.0, False),
        (3.5, RESULTS.successful, -3.0, False),  # both are negative, and the other one costs more then
    ],
)
def test_minima_of_two_delays_are_compared_without_what_is_negative(at_zero, result, other, chosen):
    """At a wrong delay, a negative reaction of the rotors predicted the noise of the gyro: the cost was 279 lower."""
    terms = jaxos4.VehicleSettings(terms=("offset", "damping", "lag", "delay"), sample_time=DT)
    data = prepare_vehicle(as_recordings(flown()), CRAZYFLIE, terms)[0]
    likelihood = dataclasses.replace(data.likelihood, answers_within=jnp.array(False))
    names = likelihood.problem.unknowns.names
    damping = names.index("roll_damping")
    assert float(likelihood.problem.unknowns.center[damping]) == 0  # fixed there, its prior adds nothing

    def estimate(delay, value, cost, result=RESULTS.successful):
        values = jnp.zeros(likelihood.unknowns.count).at[names.index("rotor_delay")].set(delay)
        values, counts = values.at[damping].set(value), map(jnp.asarray, (cost, 5, 1))
        return jaxos4.Estimate(values, jnp.eye(values.size), jnp.zeros(0), *counts, result)

    def estimator(problem):
        if problem.problem.unknowns.free[damping]:
            return estimate(USUAL_DELAY, other, 3.0)
        starts_at_usual = float(problem.start[names.index("rotor_delay")]) == USUAL_DELAY
        return estimate(USUAL_DELAY, 0.0, 4.0) if starts_at_usual else estimate(0.012, 0.0, at_zero, result)

    first = Optimum(data, likelihood, *2 * [estimate(0.012, -3.0, 2.0)], likelihood.problem.unknowns, 0)
    after = _lowest_in_delay(estimator, first, USUAL_DELAY)
    assert (after.estimate is not first.estimate) == chosen
    assert after.rollouts == (15 if other > 0 else 20)
    assert after.compared_delay == (None if chosen else 0.012)


@pytest.mark.parametrize("result", [RESULTS.successful, RESULTS.nonfinite_trajectory])
def test_what_came_out_negative_is_kept_if_a_search_without_it_fails(result):
    terms = jaxos4.VehicleSettings(terms=("offset", "damping", "lag", "delay"), sample_time=DT)
    data = prepare_vehicle(as_recordings(flown()), CRAZYFLIE, terms)[0]
    likelihood, unknowns = data.likelihood, data.problem.unknowns
    counts, covariance = (jnp.zeros(()), jnp.asarray(5), jnp.asarray(1)), jnp.eye(likelihood.unknowns.count)

    def estimate(damping, result):
        values = jnp.zeros(likelihood.unknowns.count).at[unknowns.names.index("roll_damping")].set(damping)
        return jaxos4.Estimate(values, covariance, jnp.zeros(0), *counts, result)

    before = Optimum(data, likelihood, *2 * [estimate(-3.0, RESULTS.successful)], unknowns, 0)
    after = _without_negative(lambda likelihood: estimate(0.0, result), before, lambda said: None)
    assert after.rollouts == 5
    if result == RESULTS.successful:
        assert after.negative == {"roll_damping": (-3.0, 1.0)}
    else:
        assert after.negative == {}
        assert after.estimate is before.estimate


@pytest.mark.slow
def test_a_search_continues_from_a_known_optimum_of_all_parameters():
    data = data_of(flown(), DT)
    (continued,) = search_sample_times([data], SOLVER, longest=search_all(SOLVER, data))
    (whole,) = search_sample_times([data], SOLVER)
    np.testing.assert_array_equal(continued.values, whole.values)
    assert (continued.rollouts, continued.nominal) == (whole.rollouts, whole.nominal)


@pytest.mark.slow
def test_a_fit_without_a_thrust_is_no_answer_and_its_inertias_are_as_uncertain():
    """The gain of the thrust scales all torques. If it is hardly known, so are the moments of inertia."""
    data = data_of(flown(), DT)
    (optimum,) = search_sample_times([data], SOLVER)
    answer = corrected(optimum)
    assert set(sample_time_of(answer).constants) == {"Ix", "Iy", "Iz"}
    place = answer.problem.model.parameter_names.index("thrust_gain")
    unknown = np.asarray(answer.estimate.covariance).copy()
    unknown[place, place] = 0.45**2
    fixed = {"thrust_gain": FixedParameter(float(answer.estimate.parameters[place]), "1", "not identifiable")}
    estimate = eqx.tree_at(lambda e: e.covariance, answer.estimate, jnp.asarray(unknown))
    weak = dataclasses.replace(answer, estimate=estimate, fixed=fixed)
    for name, row in vehicle_constants(weak).constants.items():
        assert row.estimate == pytest.approx(vehicle_constants(answer).constants[name].estimate)
        assert row.std > 0.4 * row.estimate
    assert not sample_time_of(weak).constants
    # Nor is a fit that says no more than the bracket, as when all samples settle the filters.
    every = dict.fromkeys(answer.problem.unknowns.names, fixed["thrust_gain"])
    unclear = dataclasses.replace(answer, fixed=every)
    assert not sample_time_of(unclear).constants


# The likelihood.


@pytest.mark.slow
@pytest.mark.parametrize("share", [1.0, 0.0])
def test_the_likelihood_of_a_specific_force_is_that_of_means_over_samples(share):
    """The dense covariance of a smoothed Ornstein-Uhlenbeck process, with a gap.

    `share`: of a sample that is averaged. Without any, it is the process at instants.
    """
    samples, strength, tau, sensor, smoothing, rows = 80, 1.3, 0.3, 0.05, 0.03, np.arange(80)
    (recording,), rng = averaged(as_recordings(flown())[0], [DT]), np.random.default_rng(2)
    force = np.full((SAMPLES, 3), np.nan)
    force[:samples, 2] = 9.81 + rng.normal(size=samples)
    force[30:37] = np.nan
    flight = dataclasses.replace(recording.flight, averaging_time=share * DT)
    problem, silent = (
        dataclasses.replace(problem_of(dataclasses.replace(flight, specific_force=each)), segments=1)
        for each in (force, np.full_like(force, np.nan))
    )
    values, noise = (
        np.asarray(problem.initial_guess.starts[0, 0]),
        np.log([[1.0, 1.0, 1.0, 1.0]] * 3 + [[strength, tau, sensor, smoothing]]),
    )
    parameters = values[: problem.problem.unknowns.count]
    noise = LogNoise(*map(jnp.asarray, noise.T))
    of_all, of_rates = (cost_of(each, jnp.asarray(parameters), noise) for each in (problem, silent))
    named = dict(zip(problem.unknowns.names, parameters.tolist(), strict=False))
    forcing = centered_forcing_of(problem.model, flight.inputs, jnp.asarray(parameters))
    expected = named["thrust_gain"] * np.asarray(forcing.sensed_specific_thrust)[rows] + named["az_bias"]
    apart = np.abs(np.subtract.outer(rows, rows))

    def correlation(time):
        """Of an Ornstein-Uhlenbeck process, in means over samples or at instants."""
        ratio, lost = DT / time, 1 - np.exp(-DT / time)
        means = np.where(apart == 0, 2 * (ratio - lost), lost**2 * np.exp(-ratio * (apart - 1))) / ratio**2
        return means if share else np.exp(-ratio * apart)

    smooth = (tau * correlation(tau) - smoothing * correlation(smoothing)) / (tau - smoothing)
    process = strength**2 * smooth
    known = np.isfinite(force[:samples, 2])
    covariance = (process + sensor**2 * np.eye(samples))[np.ix_(known, known)]
    off = (force[:samples, 2] - expected)[known]
    dense = (off @ np.linalg.solve(covariance, off) + np.linalg.slogdet(covariance)[1]) / 2
    np.testing.assert_allclose(of_all - of_rates, dense, rtol=1e-9)
    # It sees whether a sample is averaged.
    other = dataclasses.replace(problem.flight, averaging_time=(1 - share) * DT)
    of_other = cost_of(eqx.tree_at(lambda p: p.problem.flight, problem, other), jnp.asarray(parameters), noise)
    assert abs(of_other - of_all) > 1e-3 * abs(dense)


@pytest.mark.slow
def test_the_weight_tells_the_error_of_the_accelerometer():
    """Not of the thrust: the airframe says 20 % less than there is."""
    flight = flown()
    flight = dataclasses.replace(flight, specific_force=np.asarray(flight.specific_force) + [0.0, 0.0, 0.25])
    prepared, *_ = prepare(as_recordings(flight), CRAZYFLIE, sample_time=DT, holdout=0.0)
    value, error = prepared.level
    assert error < 0.1
    assert abs(value - 0.25) < 3 * error
    weak = eqx.tree_at(lambda a: a.thrust_coefficient, CRAZYFLIE, 0.8 * CRAZYFLIE.thrust_coefficient)
    other, *_ = prepare(as_recordings(flight), weak, sample_time=DT, holdout=0.0)
    assert other.level == prepared.level
    lighter = eqx.tree_at(lambda a: a.gravity, CRAZYFLIE, 9.7)
    other, *_ = prepare(as_recordings(flight), lighter, sample_time=DT, holdout=0.0)
    assert other.level[0] - value == pytest.approx(0.11, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("measured", [ANGLES_AND_RATES, ANGLES_AND_RATES[3:]], ids=["attitude", "rates alone"])
@pytest.mark.parametrize(("tilt", "period"), [(0.0, 12.0), (0.1, 6.0), (0.35, 12.0), (0.35, 6.0), (0.5, 8.0)])
def test_a_vehicle_that_circles_is_carried_by_its_force(measured, tilt, period):
    """Two rounds and more, banked and back. The force exceeds the weight by the accelerometer's error of 0.1."""
    time = np.arange(0.0, 30.0, DT)
    bank = tilt * np.minimum(1.0, np.minimum(time, time[-1] - time))
    turn = 2 * np.pi / period * (bank / tilt if tilt else 0.0)
    states = np.full((time.size, 12), np.nan)
    states[:, ANGLES_AND_RATES] = np.stack(
        [bank, 0 * time, np.cumsum(turn * np.ones_like(time)) * DT, np.gradient(bank, DT), turn * np.sin(bank),
         turn * np.cos(bank)], axis=1,
    )  # fmt: skip
    states[:, [i for i in ANGLES_AND_RATES if i not in measured]] = np.nan
    force = np.stack([0 * time, 0 * time, 9.81 / np.cos(bank) + 0.1], axis=1)
    force += 1e-3 * np.random.default_rng(0).normal(size=force.shape)
    flight = jaxos4.Flight(time=time, omega=np.full((time.size, 4), 1500.0), states=states, specific_force=force)
    prepared, *_ = prepare(as_recordings(flight), CRAZYFLIE, begin=0.0, sample_time=DT, holdout=0.0)
    value, error = prepared.level
    assert abs(value - 0.1) < min(error, 0.06)
    assert error < (0.06 if len(measured) == 6 or not tilt else 0.5)
    upside_down = dataclasses.replace(flight, specific_force=force * [1.0, 1.0, -1.0])
    prepared, *_ = prepare(as_recordings(upside_down), CRAZYFLIE, begin=0.0, sample_time=DT, holdout=0.0)
    assert prepared.level is None  # no calibration: the fit says that the axis points down


@pytest.mark.slow
def test_a_vehicle_that_leans_is_carried_by_its_drag_too():
    """In steady flight all forces carry the weight, whatever the tilt; what is left is the accelerometer's error."""
    samples, tilt = 400, (0.1, -0.2, 0.0)
    states = np.full((samples, 12), np.nan)
    states[:, ANGLES_AND_RATES] = 0.0
    states[:, ANGLES_AND_RATES[:3]] = tilt
    up = Rotation.from_euler("xyz", tilt).as_matrix()[2]
    force = 9.81 * up + [0.0, 0.0, 0.1] + 1e-3 * np.random.default_rng(0).normal(size=(samples, 3))
    flight = jaxos4.Flight(
        time=DT * np.arange(samples), omega=np.full((samples, 4), 1500.0), states=states, specific_force=force
    )
    prepared, *_ = prepare(as_recordings(flight), CRAZYFLIE, begin=0.0, sample_time=DT, holdout=0.0)
    assert abs(prepared.level[0] - 0.1) < 1e-3


@pytest.mark.slow
def test_a_wrong_accelerometer_is_doubted():
    """It is known from the weight, whether the fit estimates it or not."""
    flight = dataclasses.replace(flown(), specific_force=np.asarray(flown().specific_force) + [0.0, 0.0, 1.5])
    found = jaxos4.identify(flight, CRAZYFLIE, settings=jaxos4.VehicleSettings(terms=TERMS, sample_time=0.008))
    value = found.held["az_bias"].value if "az_bias" in found.held else found.parameters["az_bias"].estimate
    assert value == pytest.approx(1.5, abs=0.15)
    assert [d.cause for d in found.issues if "levelled accelerometer" in d.cause] != []


_GYROS_CLOCK = pytest.mark.xfail(
    strict=True, reason="input innovations hold the answers of the controller on the gyro's clock only"
)


@functools.cache
def answer_of(shift):
    """Estimates and standard deviations, with motors that are recorded this many samples late."""
    rows = np.clip(np.arange(SAMPLES) - shift, 0, SAMPLES - 1)
    data = data_of(dataclasses.replace(flown(), omega=np.asarray(flown().omega)[rows]), DT)
    answer = SOLVER(data.likelihood)
    values = zip(answer.parameters.tolist(), answer.std.tolist(), strict=True)
    return dict(zip(data.problem.model.parameter_names, values, strict=False))


@pytest.mark.slow
@pytest.mark.parametrize("shift", [pytest.param(-5, marks=_GYROS_CLOCK), 5])
def test_shifted_clocks_give_the_same_inertias(shift):
    """The motors are recorded 20 ms early or late: only `rotor_delay` says so."""
    for name in ("alpha3", "alpha6"):
        (value, std), (own, _) = answer_of(shift)[name], answer_of(0)[name]
        assert abs(value - own) < 0.3 * std, name
    moved = answer_of(shift)["rotor_delay"][0] - answer_of(0)["rotor_delay"][0]
    assert abs(moved + DT * shift) < 1e-3
