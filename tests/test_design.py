"""Designed inputs: what they tell, the limits that they keep, and the command."""

import contextlib
import io
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    DT,
    euler_trajectory,
    measured,
    published_derivative,
    random_starts,
    refused,
    standard_flight,
    standard_problem,
)
from lanes import HALF, LANES, identify

import jaxos4
from jaxos4.cli import main
from jaxos4.cli.design import Criterion
from jaxos4.design import Envelope, design_and_compare, read_input, write_input
from jaxos4.design.criterion import CRITERIA, bounds_of, criterion_of
from jaxos4.design.envelope import largest
from jaxos4.design.fitting import VEHICLES, drawn, fly_finely

MODEL = jaxos4.PublishedOS4()
BRACKET = jaxos4.Bracket.default(MODEL)


SECONDS = 2.0
# What `jaxos4 design --initial-state known --duration 2` asks of the library.
ASKED = {
    "limits": {},
    "duration": SECONDS,
    "dt": 0.01,
    "channels": "all",
    "start_is_known": True,
    "criterion": "D",
    "bandwidth": 4.0,
    "seed": 0,
}


@pytest.fixture(scope="module")
def commanded(tmp_path_factory):
    """A run of the command: its folder, what it prints, what it asks of the library, and what the library finds."""
    folder, printed, calls = tmp_path_factory.mktemp("design"), io.StringIO(), []

    def seen(model, **asked):
        calls.append((asked, design_and_compare(model, **asked)))
        return calls[0][1]

    options = ["--initial-state", "known", "--duration", "2", "--out", "input.csv", "--figure", "input.svg"]
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.chdir(folder)
        patch.setattr("jaxos4.design.design_and_compare", seen)
        patch.setattr(sys, "argv", ["jaxos4", "design", *options])
        with pytest.raises(SystemExit) as stop:
            main()
    assert not stop.value.code
    return folder, printed.getvalue(), *calls[0]


@pytest.fixture(scope="module")
def found(commanded):
    """The input that the command designs."""
    return commanded[-1]


def numpy_bounds(omega):
    """The Cramer-Rao bounds of the standard sensors by NumPy, with slopes by central differences."""
    alpha = np.asarray(MODEL.alpha)
    step = 1e-4 * jaxos4.DEFAULT_HALF_WIDTH
    points = np.concatenate([alpha + np.diag(step), alpha - np.diag(step)])
    states = euler_trajectory(published_derivative, points, omega, start=np.zeros((16, 12)))
    up, down = np.split(states / np.asarray(jaxos4.SENSOR_SIGMA), 2, axis=1)
    weighted = (up - down) / (2 * step[:, None])
    information = np.einsum("tic,tjc->ij", weighted, weighted)
    scale = np.sqrt(np.diagonal(information))
    return np.sqrt(np.diagonal(np.linalg.inv(information / np.outer(scale, scale)))) / scale


def geometric_mean(bounds):
    return np.exp(np.log(bounds).mean())


def test_the_bounds_are_those_of_an_independent_fisher_information(found):
    for one in (found.designed, found.standard["multisine"]):
        np.testing.assert_allclose(one.bounds[-1], numpy_bounds(one.omega), rtol=1e-3)


def test_a_designed_input_tells_more_than_the_standard_inputs(found):
    own = geometric_mean(numpy_bounds(found.designed.omega))
    standard = np.asarray(standard_flight(duration=SECONDS).omega)  # its own envelope, at its full amplitude
    assert own < 0.6 * geometric_mean(numpy_bounds(standard))
    assert own < 0.6 * min(geometric_mean(one.bounds[-1]) for one in found.standard.values())


def test_other_vehicles_of_the_bracket_keep_the_limits_between_samples_too(found):
    others = drawn(BRACKET, jax.random.key(77), VEHICLES)
    states = fly_finely(MODEL, others, jnp.asarray(found.designed.omega), jnp.asarray(DT, float))
    needed = Envelope.of(found.designed.omega, states, float(DT))
    assert float(needed.slowest) >= float(found.envelope.slowest)
    for name in ("fastest", "slew", "angle", "rate", "velocity", "distance"):
        assert (np.asarray(getattr(needed, name)) <= np.asarray(getattr(found.envelope, name))).all(), name
    assert 0.9 < max(found.designed.uses.values()) <= 1


@pytest.mark.usefixtures("quickly_compiled")
def test_many_flights_reach_the_bounds(found):
    """RMSE / bound of each parameter by IBSS, within four standard errors of 1."""
    omega = jnp.asarray(found.designed.omega)
    exact = jaxos4.simulate(MODEL, MODEL.alpha, omega, dt=DT)
    states = measured(jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA), exact, jax.random.split(jax.random.key(5), LANES))
    problem, center = standard_problem(duration=SECONDS), random_starts(MODEL, LANES, seed=150)
    inputs = jnp.asarray(np.tile(omega, (LANES, 1, 1)))
    estimates = identify(jaxos4.IBSS(), problem, states, inputs, center - HALF, center + HALF)
    assert (np.asarray(jaxos4.result_names(estimates.result)) == "successful").all()
    error = np.asarray(estimates.parameters - MODEL.alpha) / found.designed.bounds[-1]
    assert np.abs(np.square(error).mean(axis=0) - 1).max() < 4 * np.sqrt(2 / LANES)


def test_the_command_writes_an_input_that_simulate_and_a_study_fly(commanded, run):
    folder, out, asked, found = commanded
    assert {name: asked[name] for name in ASKED} == ASKED
    np.testing.assert_array_equal(asked["bracket"].lower, BRACKET.lower)
    np.testing.assert_array_equal(asked["bracket"].upper, BRACKET.upper)
    np.testing.assert_allclose(read_input(folder / "input.csv", 0.01), found.designed.omega, rtol=1e-9)
    assert "x multisine" in out
    assert "x chirp" in out
    assert (folder / "input.svg").read_text().count("<svg") == 1
    assert run("simulate", "--speeds", str(folder / "input.csv"), "--out", "flight.csv")[0] == 0
    refused(run("simulate", "--speeds", str(folder / "input.csv"), "--out", "x.csv", "--duration", "5"), "--duration: ")
    flown = jaxos4.read_flight("flight.csv")
    np.testing.assert_allclose(np.asarray(flown.omega), found.designed.omega, rtol=1e-6)
    from jaxos4.study import load_study
    from jaxos4.study.flights import fleet_of

    (folder / "study.toml").write_text('excitations = ["best"]\ndurations = [2]\n[input]\nbest = "input.csv"\n')
    study = load_study(folder / "study.toml")
    np.testing.assert_allclose(fleet_of(study, study.cell(0).scenario).omega, found.designed.omega, rtol=1e-9)
    (folder / "study.toml").write_text('excitations = ["best"]\ndurations = [3]\n[input]\nbest = "input.csv"\n')
    with pytest.raises(jaxos4.InputError, match="its file lasts 2 s; correct `durations`"):
        load_study(folder / "study.toml")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("--duration 0", ("--duration", "must be positive")),
        ("--duration 1000", ("--duration", "50 to 2500 samples")),
        ("--duration 2 --fastest 150", ("cannot hover", "225.7")),
        ("--duration 2 --slowest 230", ("cannot hover",)),
        ("--duration 2 --rate -1", ("--rate must be positive",)),
        ("--accuracy 0", ("--accuracy",)),
        ("--bandwidth 100", ("--bandwidth", "0.2 to 25 Hz")),  # by default 5 s, sampled every 0.01 s
        ("--airframe none", ("none",)),
        ("--figure input.csv", ("--figure", "--out")),
        ("--figure input.png", ("--figure input.png", ".svg")),
    ],
)
def test_mistakes_are_one_line_and_write_nothing(run, tmp_path, line, said):
    refused(run("design", "--initial-state", "known", "--out", "input.csv", *line.split()), *said)
    assert list(tmp_path.iterdir()) == []


def test_an_input_file_is_refused_in_one_line(found, tmp_path):
    path = tmp_path / "input.csv"
    write_input(found.designed, path)
    with pytest.raises(jaxos4.InputError, match=r"is not sampled every 0.02 s"):
        read_input(path, 0.02)
    path.write_text("t,omega1,omega2,omega3\n0,1,1,1\n0.01,1,1,1\n")
    with pytest.raises(jaxos4.InputError, match=r"column omega4 is missing"):
        read_input(path, 0.01)


def test_criteria_are_means_of_the_relative_bounds_without_the_nuisances():
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(7, 7))
    information, half_width = factor @ factor.T, np.array([1.0, 2.0, 0.5])
    covariance = np.linalg.inv(information)[:3, :3]
    relative = covariance / np.outer(half_width, half_width)
    criterion = jax.jit(criterion_of, static_argnums=2)
    found, determinant = jax.jit(bounds_of, static_argnums=1)(information, 3)
    np.testing.assert_allclose(found, covariance, rtol=1e-9)
    np.testing.assert_allclose(determinant, np.log(np.linalg.det(covariance)), rtol=1e-9)
    value = {name: float(criterion(information, half_width, name)) for name in "DA"}
    np.testing.assert_allclose(value["D"], np.log(np.linalg.det(relative)) / 6, rtol=1e-9)
    np.testing.assert_allclose(value["A"], np.log(np.trace(relative) / 3) / 2, rtol=1e-9)
    largest = np.log(np.diagonal(relative).max()) / 2
    worst = float(criterion(information, half_width, "worst"))
    assert largest <= worst <= largest + np.log(3) / 16


@jax.jit
def largest_uses(envelope, omega, states):
    return largest(envelope.uses_of_rotors(omega, jnp.asarray(DT)) | envelope.uses_of_states(states))


def test_a_limit_must_be_a_positive_number():
    flight = standard_flight()
    envelope = Envelope.of(flight.omega, flight.states, float(DT))
    for name, value, message in (
        ("angle", [0.1, 0.2], "one number or three"),
        ("distance", np.inf, "positive and finite"),
        ("slowest", 300.0, "below `fastest`"),
    ):
        with pytest.raises(ValueError, match=message):
            Envelope(**{n: value if n == name else getattr(envelope, n) for n in Envelope.__annotations__})
    uses = largest_uses(envelope, flight.omega, flight.states)
    np.testing.assert_allclose(np.concatenate(list(uses.values())).max(), 1, rtol=1e-6)


def test_the_criteria_of_the_command_are_those_of_the_library():
    assert [str(one) for one in Criterion] == list(CRITERIA)
