"""Predictions of the rates: exact if the model is exact, without skill if the model says that nothing moves."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxos4
from jaxos4.analysis.prediction import Predictions

DT = 0.01
HORIZONS = (0.1, 0.25, 0.5)
RATES = (7, 9, 11)


SAMPLES = 601  # of a simulation; shorter flights are its beginning, so that each model needs one program


def flown(model, *, seconds=6.0, dt=DT):
    omega = np.asarray(jaxos4.multisine(model.airframe, duration=seconds, dt=dt))
    held = np.concatenate([omega, np.repeat(omega[-1:], SAMPLES - len(omega), axis=0)])
    flight = jaxos4.simulate(model, model.alpha, jnp.asarray(held), dt=dt, method="rk4")
    return jaxos4.Flight(*(np.asarray(x)[: len(omega)] for x in (flight.time, flight.omega, flight.states)))


def problem_of(model, flight, **arguments):
    return jaxos4.ShootingProblem(model, flight, sigma=jaxos4.SENSOR_SIGMA, channels="rates", method="rk4", **arguments)


def spread(model, flight):
    return jaxos4.predictions(problem_of(model, flight), model.alpha, horizons=HORIZONS)


def synthetic(errors, changes):
    """Predictions with these errors, of rates that change by `changes`."""
    errors, changes = np.broadcast_arrays(np.asarray(errors, float), np.asarray(changes, float))
    starts = errors.shape[0]
    measured = np.zeros((starts, 1, 3)) + changes
    return Predictions(np.arange(starts), np.array([0.1]), np.zeros((starts, 3)), measured + errors, measured)


@pytest.mark.parametrize("model", [jaxos4.CorrectedOS4(), jaxos4.FlightModel()], ids=["corrected", "flight"])
def test_a_flight_without_noise_is_predicted(model):
    flight = flown(model)
    found = spread(model, flight)
    skill = jaxos4.skill(found)
    np.testing.assert_allclose(found.horizons, HORIZONS)
    # The initial rates are a mean over 0.02 s, which is wrong by the curvature of the rates only.
    off = np.abs(found.initial - np.asarray(flight.states)[found.start][:, RATES]).max()
    assert off < 0.01
    assert np.abs(found.predicted - found.measured).max() < 3 * off
    assert np.all(skill.skill > 1 - 1e-3)
    assert skill.starts == found.start.size == len(found.initial)
    # Windows and channels do not matter.
    arguments = {"sigma": jaxos4.SENSOR_SIGMA, "channels": "all", "method": "rk4", "windows": 5}
    other = jaxos4.predictions(jaxos4.ShootingProblem(model, flight, **arguments), model.alpha)
    np.testing.assert_allclose(other.predicted, found.predicted, rtol=1e-12, atol=1e-13)


def test_at_a_step_so_long_that_the_start_is_one_sample_predictions_are_exact():
    model = jaxos4.CorrectedOS4()
    flight = flown(model, dt=0.025)
    found = spread(model, flight)
    np.testing.assert_array_equal(found.initial, np.asarray(flight.states)[found.start][:, RATES])
    np.testing.assert_allclose(found.predicted, found.measured, atol=1e-12)
    skill = jaxos4.skill(found)
    np.testing.assert_allclose(skill.skill, 1.0, atol=1e-12)
    np.testing.assert_allclose(skill.std, 0.0, atol=1e-12)
    # Horizons are whole samples.
    np.testing.assert_allclose(found.horizons, np.rint(np.array(HORIZONS) / 0.025) * 0.025)


def test_a_model_without_motion_has_no_skill_and_a_gyros_bias_is_not_taken_for_motion():
    model, biased_model = jaxos4.CorrectedOS4(), jaxos4.FlightModel(terms=("gyro_bias",))
    found = jaxos4.predictions(problem_of(model, flown(model)), jnp.zeros(8), horizons=HORIZONS)
    np.testing.assert_array_equal(found.predicted, np.repeat(found.initial[:, None], 3, axis=1))
    skill = jaxos4.skill(found)
    np.testing.assert_array_equal(skill.skill, 0.0)
    np.testing.assert_array_equal(skill.rmse, skill.persistence)
    flight, bias = flown(model, dt=0.025), jnp.array([0.05, -0.03, 0.02])
    biased = jaxos4.Flight(flight.time, flight.omega, flight.states.at[:, jnp.array(RATES)].add(bias))
    found = jaxos4.predictions(problem_of(biased_model, biased), jnp.concatenate([model.alpha, bias]))
    np.testing.assert_allclose(found.predicted, found.measured, atol=1e-12)


def test_no_prediction_crosses_into_another_stretch():
    model = jaxos4.FlightModel()
    rest = flown(model, seconds=4.0)
    # The second stretch has other states: a prediction across the border would be far off.
    away = jaxos4.Flight(rest.time, rest.omega, rest.states + 5.0)
    flight = jaxos4.join([rest, away, rest], length=90)
    stretch = np.asarray(flight.stretch)
    found = spread(model, flight)
    ahead = int(round(max(HORIZONS) / DT))
    assert np.all(stretch[found.start - 1] == stretch[found.start + ahead])
    # No possible start is omitted; they are 0.05 s apart.
    grid = np.arange(1, stretch.size - ahead - 1, 5)
    np.testing.assert_array_equal(found.start, grid[stretch[grid - 1] == stretch[grid + ahead]])
    for i in range(3):
        assert np.count_nonzero(stretch[found.start] == i) > 50


def test_missing_measurements_do_not_count():
    model = jaxos4.CorrectedOS4()
    flight = flown(model)
    states = np.array(flight.states)
    states[200:220, 7] = np.nan
    states[400, 9] = np.nan
    found = spread(model, jaxos4.Flight(flight.time, flight.omega, states))
    near = found.start[:, None] + np.arange(-1, 2)
    assert np.isfinite(states[near][:, :, RATES]).all()
    assert np.isfinite(found.initial).all()
    assert np.isfinite(found.predicted).all()
    at = found.start[:, None] + np.rint(found.horizons / DT).astype(int)
    np.testing.assert_array_equal(found.measured, states[at][:, :, RATES])
    skill = jaxos4.skill(found)
    measured = np.isfinite(found.measured)
    assert measured.sum() < measured.size
    errors = np.where(measured, found.predicted - found.measured, np.nan)
    np.testing.assert_allclose(skill.rmse, np.sqrt(np.nanmean(errors**2, axis=0)), rtol=1e-12)
    assert np.all(skill.skill > 1 - 1e-3)


NEVER = np.where(np.arange(3) == 2, np.nan, 1.0)
# Errors and changes of rates, and the skill of each rate.
SKILLS = {
    "nothing moves": (np.full((30, 1, 3), 0.1), 0.0, -np.inf),
    "a rate that was never measured": (np.zeros((30, 1, 3)), NEVER, [1.0, 1.0, np.nan]),
    "one start": (np.full((1, 1, 3), 0.1), 1.0, 0.99),
}


@pytest.mark.parametrize(("errors", "changes", "expected"), SKILLS.values(), ids=SKILLS)
def test_the_skill_compares_errors_with_changes(errors, changes, expected):
    skill = jaxos4.skill(synthetic(errors, changes))
    np.testing.assert_allclose(skill.skill, np.broadcast_to(expected, (1, 3)))
    assert skill.starts == len(errors)
    assert np.isnan(skill.std).all() or skill.starts > 1
    # A prediction that diverges counts as an error that no gyro could measure.
    skill = jaxos4.skill(synthetic(np.where(np.arange(40) == 7, np.nan, 0.1)[:, None, None], 1.0))
    assert np.all(np.isfinite(skill.skill) & (skill.skill < -1e4))
    np.testing.assert_allclose(skill.rmse, np.sqrt((1e6 + 39 * 0.01) / 40), rtol=1e-2)


def test_the_jackknife_is_the_spread_of_the_skill():
    """For independent errors over many flights, and by its formula for one flight."""
    rng = np.random.default_rng(0)
    skills = [
        jaxos4.skill(synthetic(0.5 * rng.normal(size=(200, 1, 3)), rng.normal(size=(200, 1, 3)))) for _ in range(300)
    ]
    actual = np.std([s.skill for s in skills], axis=0)
    claimed = np.sqrt(np.mean([np.square(s.std) for s in skills], axis=0))
    # The spread of 300 flights is known to 4 %, and the jackknife is a little wide.
    np.testing.assert_allclose(claimed, actual, rtol=0.2)
    one = synthetic(rng.normal(size=(20, 1, 3)), rng.normal(size=(20, 1, 3)))
    errors, changes = one.predicted - one.measured, one.initial[:, None] - one.measured
    without = []
    for part in range(10):
        kept = np.delete(np.arange(20), [2 * part, 2 * part + 1])
        without.append(1 - (errors[kept] ** 2).sum(axis=0) / (changes[kept] ** 2).sum(axis=0))
    expected = np.sqrt(0.9 * np.square(without - np.mean(without, axis=0)).sum(axis=0))
    np.testing.assert_allclose(jaxos4.skill(one).std, expected, rtol=1e-10)


def test_flights_that_are_too_short_or_without_rates_are_refused():
    model = jaxos4.CorrectedOS4()
    long, short = flown(model, seconds=3.0), flown(model, seconds=0.4)
    stretches = jnp.arange(long.time.shape[0]) // 45  # of 0.45 s
    for flight, said in (
        (short, r"`flight` has no stretch .* longer than 0.5 s"),
        (jaxos4.Flight(long.time, long.omega, jnp.full_like(long.states, jnp.nan)), "no stretch with measured rates"),
        (jaxos4.Flight(long.time, long.omega, long.states, stretch=stretches), "longer than 0.5 s"),
    ):
        with pytest.raises(ValueError, match=said):
            spread(model, flight)
