"""`fit_vehicle`: unidentifiable parameters are held and named, the others are found with honest errors."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxos4
from jaxos4.identification.vehicle import SECONDARY

DT, SECONDS, WINDOWS = 0.01, 4.8, 8
MODEL = jaxos4.FlightModel(terms=("offset", "damping"))
NAMES = MODEL.parameter_names
GYRO = 0.02
BRACKET = jaxos4.Bracket.default(MODEL)
GENTLE = {"roll_offset": 0.2, "pitch_offset": -0.1, "roll_damping": 1.2, "pitch_damping": 0.8, "yaw_damping": 0.5}


def problem_of(values, *, amplitude=(1.5, 1.5, 0.5), seed=0, outliers=0.0, excitation=jaxos4.multisine):
    """A flight with a gyro's noise, cut into windows; `values`: where it is not as the airframe says."""
    truth = jnp.array([values.get(name, float(x)) for name, x in zip(NAMES, MODEL.alpha, strict=True)])
    omega = np.asarray(excitation(jaxos4.OS4, duration=SECONDS, dt=DT, amplitude=amplitude))[:-1]
    blank = jaxos4.Flight(DT * np.arange(omega.shape[0]), omega, np.full((omega.shape[0], 12), np.nan))
    arguments = dict(sigma=0.1 * np.ones(12), channels="rates", method="rk4")
    rates = jaxos4.ShootingProblem(MODEL, blank, **arguments).predict(truth, jnp.zeros(3))
    rng = np.random.default_rng(seed)
    rates = rates + rng.normal(0, GYRO, rates.shape) + (rng.uniform(size=rates.shape) < outliers) * 50 * GYRO
    flight = eqx.tree_at(lambda f: f.states, blank, blank.states.at[:, jnp.array([7, 9, 11])].set(rates))
    return jaxos4.ShootingProblem(MODEL, flight, windows=WINDOWS, **arguments), truth


@functools.cache
def fitted(kind):
    values, arguments = {
        "rich": (GENTLE, {}),
        "hover": (GENTLE, {"amplitude": 0.15}),
        "negative": ({**GENTLE, "roll_damping": -0.3}, {}),
    }[kind]
    problem, truth = problem_of(values, **arguments)
    stages = []
    return jaxos4.fit_vehicle(problem, BRACKET, progress=stages.append), truth, stages


@pytest.mark.parametrize("kind", ["rich", "hover"])
def test_identifiable_parameters_are_found_within_their_errors(kind):
    fit, truth, stages = fitted(kind)
    assert fit.answered
    assert str(jaxos4.result_names(fit.estimate.result)) == "successful"
    names = fit.problem.model.parameter_names
    assert set(names).isdisjoint(fit.held)
    assert set(names) | set(fit.held) == set(NAMES)
    values = dict(zip(NAMES, truth, strict=True))
    errors = np.array([fit.estimate.parameters[i] - values[name] for i, name in enumerate(names)]) / fit.estimate.std
    assert np.abs(errors).max() < 4.5
    # The noise is found, less what Huber's scale and its cut make of it.
    np.testing.assert_allclose(fit.problem.sigma[jnp.array([7, 9, 11])], GYRO, rtol=0.15)
    # White noise: the errors are the bound's, a little more for the measurements that are cut.
    ratio = fit.estimate.std / fit.bound
    assert np.all((ratio > 0.6) & (ratio < 1.7))
    assert 0.1 < fit.cut < 0.25
    assert fit.rollouts > 0
    assert stages == [
        "compiling, and fitting the parameters that every flight excites",
        "choosing the identifiable parameters",
        "fitting the identifiable parameters",
        "computing errors",
    ]


def test_a_rich_flight_identifies_the_primary_parameters():
    fit, _, _ = fitted("rich")
    assert set(fit.held) <= set(SECONDARY)


def test_parameters_that_a_hover_cannot_identify_are_held_and_named():
    fit, truth, _ = fitted("hover")
    assert {"alpha1", "alpha4"} <= set(fit.held)
    for name, (value, why) in fit.held.items():
        assert value == pytest.approx(float(BRACKET.center[NAMES.index(name)]), abs=1e-12)
        assert why == "not identifiable from these flights"
    assert {"alpha3", "alpha6"}.isdisjoint(fit.held)
    # The bound of the whole model is wider than the bracket for held parameters, and narrower for the others.
    whole = eqx.tree_at(lambda p: p.model, fit.problem, MODEL)
    std = np.sqrt(np.diagonal(jaxos4.cramer_rao_bound(whole, truth, fit.estimate.initial_state)))
    for i, name in enumerate(NAMES):
        if std[i] > 1.5 * BRACKET.half_width[i]:
            assert name in fit.held
        if std[i] < 0.5 * BRACKET.half_width[i]:
            assert name not in fit.held


def test_a_negative_damping_is_held_at_zero():
    fit, _, _ = fitted("negative")
    assert fit.answered
    assert fit.held["roll_damping"][0] == 0.0
    assert "negative" in fit.held["roll_damping"][1]
    assert {"pitch_damping", "yaw_damping"}.isdisjoint(fit.held)


def test_a_value_for_every_parameter():
    fit, _, _ = fitted("negative")
    every = fit.problem.model.complete(fit.estimate.parameters)
    assert fit.values == dict(zip(NAMES, every.tolist(), strict=True))
    assert fit.values["roll_damping"] == 0.0
    # The model with held parameters predicts as the model with all of them.
    cost = eqx.tree_at(lambda p: p.model, fit.problem, MODEL).cost(every, fit.estimate.initial_state)
    assert float(cost) == pytest.approx(
        float(fit.problem.cost(fit.estimate.parameters, fit.estimate.initial_state)), rel=1e-9
    )


def test_outliers_are_cut_by_default():
    problem, truth = problem_of(GENTLE, outliers=0.05)
    errors = {}
    for huber in (True, False):
        fit = jaxos4.fit_vehicle(problem, BRACKET, huber=huber)
        values = dict(zip(NAMES, truth, strict=True))
        errors[huber] = np.sqrt(
            np.mean(
                [
                    float((fit.estimate.parameters[i] - values[name]) / BRACKET.half_width[NAMES.index(name)]) ** 2
                    for i, name in enumerate(fit.problem.model.parameter_names)
                    if name not in SECONDARY
                ]
            )
        )
        assert (fit.cut > 0.1) == huber
        assert (fit.cut == 0.0) == (not huber)
    assert errors[True] < 0.5 * errors[False]


def test_a_flight_that_the_model_cannot_follow_has_no_answer():
    problem, _ = problem_of(GENTLE)
    wild = eqx.tree_at(lambda p: p.flight.omega, problem, 1e6 * problem.flight.omega)
    fit = jaxos4.fit_vehicle(wild, BRACKET)
    assert not fit.answered
    assert str(jaxos4.result_names(fit.estimate.result)) == "nonfinite_trajectory"
    invalid = jaxos4.Bracket(BRACKET.upper, BRACKET.lower)
    fit = jaxos4.fit_vehicle(problem, invalid)
    assert not fit.answered
    assert str(jaxos4.result_names(fit.estimate.result)) == "bracket_invalid"


def test_a_bracket_of_another_model_is_refused():
    problem, _ = problem_of(GENTLE)
    with pytest.raises(ValueError, match=r"`bracket` must hold 14 parameters, got 8"):
        jaxos4.fit_vehicle(problem, jaxos4.Bracket.default(jaxos4.CorrectedOS4()))


def test_the_estimator_of_the_last_stage_can_be_another():
    problem, _ = problem_of(GENTLE)
    plain, _, _ = fitted("rich")
    fit = jaxos4.fit_vehicle(problem, BRACKET, estimator=jaxos4.OutputError())
    assert set(fit.held) == set(plain.held)
    assert np.abs((fit.estimate.parameters - plain.estimate.parameters) / plain.estimate.std).max() < 0.2
    assert jax.tree.leaves(fit.bound)[0].shape == fit.estimate.parameters.shape
