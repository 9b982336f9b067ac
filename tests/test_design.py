"""Designs of rotor speeds and of references: what they tell, the limits that they keep, and the command."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    CRAZYFLIE,
    CRAZYFLIE_TOML,
    DT,
    euler_trajectory,
    output_of,
    published_derivative,
    refused,
    standard_flight,
)

import jaxos4
from jaxos4 import design
from jaxos4.design import Envelope
from jaxos4.design.fleet import LANES as BATCH, Fleet, batch_of, fly_batch
from jaxos4.design.rotor_speeds import drawn, fly_finely
from jaxos4.design.task import CRITERIA, criterion_of, design as search
from jaxos4.flight import RATES
from jaxos4.study import load_study
from jaxos4.study.cell import setup_of

pytestmark = pytest.mark.usefixtures("all_optimised")

MODEL = jaxos4.PublishedOS4()
BRACKET = jaxos4.Bracket.default(MODEL)
SECONDS = 2.0
LOOP = jaxos4.ClosedLoop(CRAZYFLIE, gust=5.0)
LOOP_BRACKET = jaxos4.Bracket.default(design.model_of(LOOP))
LOOP_DT, LOOP_SECONDS = 0.004, 4.0
CLOSED = ("--closed-loop", "--airframe", "mine.toml")


OPEN_SETTINGS = {"duration": SECONDS, "dt": 0.01, "channels": "all", "criterion": "A", "start_is_known": True}
LOOP_SETTINGS = {"duration": LOOP_SECONDS, "dt": LOOP_DT, "criterion": "D"}


@pytest.fixture(scope="module")
def speeds():
    """Rotor speeds of 2 s."""
    return design.design_input(MODEL, bracket=BRACKET, **OPEN_SETTINGS, compare=True, key=0)


@pytest.fixture(scope="module")
def references():
    """References of 4 s."""
    return design.design_references(LOOP, bracket=LOOP_BRACKET, **LOOP_SETTINGS, compare=True, key=0)


@pytest.fixture
def command(run, tmp_path, monkeypatch):
    """Runs `jaxos4 design`: it asks the library for these settings and no others. Returns what it prints and asks."""

    def call(function, found, bracket, settings, *options):
        asked = []
        monkeypatch.setattr(jaxos4, function, lambda subject, **given: asked.append((subject, given)) or found)
        (tmp_path / "mine.toml").write_text(CRAZYFLIE_TOML)
        out = output_of(run("design", *options, "--out", "new.csv", "--figure", "new.svg"))
        assert (tmp_path / "new.svg").read_text().count("<svg") == 1
        ((subject, given),) = asked
        given.pop("progress")
        for end in ("lower", "upper"):
            np.testing.assert_array_equal(getattr(given["bracket"], end), getattr(bracket, end))
        assert given == settings | {"limits": {}, "bracket": given["bracket"], "compare": True, "key": 0}
        return out, subject

    return call


# Rotor speeds.


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


@pytest.mark.slow
def test_the_bounds_are_those_of_an_independent_fisher_information(speeds):
    for one in (speeds.designed, speeds.standard["multisine"]):
        np.testing.assert_allclose(one.bounds, numpy_bounds(one.inputs), rtol=1e-3)
        np.testing.assert_array_equal(one.bounds, one.history[-1])
    # The shortest flight is the first sample at which the bounds are small enough.
    designed = speeds.designed
    np.testing.assert_allclose(designed.shortest(designed.history[120, :3]), 1.2, rtol=1e-9)
    np.testing.assert_allclose(designed.shortest(designed.bounds / 3), 9 * SECONDS, rtol=1e-9)


def test_a_designed_input_tells_more_than_the_standard_inputs(speeds):
    own = geometric_mean(numpy_bounds(speeds.designed.inputs))
    standard = np.asarray(standard_flight(duration=SECONDS).omega)  # its own envelope, at its full amplitude
    assert own < 0.5 * geometric_mean(numpy_bounds(standard))
    assert own < 0.5 * min(geometric_mean(one.bounds) for one in speeds.standard.values())


@pytest.mark.slow
def test_other_vehicles_of_the_bracket_keep_the_limits_between_samples_too(speeds):
    others, designed, limits = drawn(BRACKET, jax.random.key(77), speeds.task.vehicles), speeds.designed, speeds.task
    states = fly_finely(MODEL, others, jnp.asarray(designed.inputs), jnp.asarray(DT, float))
    shares = limits.envelope.shares(designed.inputs, states, float(DT))
    assert max(shares.values()) <= 1
    assert 0.9 < max(designed.uses.values()) <= 1


@pytest.mark.slow
def test_the_command_writes_an_input_that_simulate_and_a_study_fly(speeds, command, run, tmp_path):
    out, _ = command("design_input", speeds, BRACKET, OPEN_SETTINGS, "--initial-state", "known", "--duration", "2")
    for words in ("x multisine", "x chirp", "of 200 vehicles", "fly it", "criterion A"):
        assert words in out
    omega = speeds.designed.inputs
    np.testing.assert_allclose(design.read_input(tmp_path / "new.csv", 0.01), omega, rtol=1e-9)
    assert run("simulate", "--speeds", "new.csv", "--out", "flight.csv")[0] == 0
    refused(run("simulate", "--speeds", "new.csv", "--out", "x.csv", "--duration", "5"), "--duration: ")
    np.testing.assert_allclose(np.asarray(jaxos4.read_flight("flight.csv").omega), omega, rtol=1e-6)
    study = 'excitations = ["best"]\ndurations = [{}]\n[input]\nbest = "new.csv"\n'
    (tmp_path / "study.toml").write_text(study.format(2))
    loaded = load_study(tmp_path / "study.toml")
    np.testing.assert_allclose(setup_of(loaded, loaded.cell(0).scenario).omega, omega, rtol=1e-9)
    (tmp_path / "study.toml").write_text(study.format(3))
    with pytest.raises(jaxos4.InputError, match="its file lasts 2 s; correct `durations`"):
        load_study(tmp_path / "study.toml")


def relative(designed):
    """Bounds as shares of the half-widths of the default bracket."""
    return designed.bounds / np.asarray(MODEL.half_width)


SUBJECTS = {
    "OS4, seed 0": (jaxos4.OS4, "all", 0),
    "OS4, seed 1": (jaxos4.OS4, "all", 1),
    "VOOS, rates, seed 0": (jaxos4.VOOS, "rates", 0),
    "VOOS, rates, seed 1": (jaxos4.VOOS, "rates", 1),
}


@pytest.mark.parametrize(
    "subject", [pytest.param(name, marks=() if name == "OS4, seed 0" else pytest.mark.slow) for name in SUBJECTS]
)
def test_a_designed_input_is_at_least_as_good_as_all_standard_ones_by_its_criterion(subject):
    """For a known vehicle, whose search used to end long before its optimum: at 0.8 of the multisine's bounds."""
    airframe, channels, seed = SUBJECTS[subject]
    model = jaxos4.PublishedOS4(airframe)
    known = jaxos4.Bracket.around(model.alpha, 1e-3 * np.asarray(model.half_width))
    found = design.design_input(
        model, bracket=known, duration=SECONDS, channels=channels, start_is_known=True, compare=True, key=seed
    )
    own = np.square(relative(found.designed)).mean()
    assert own < 0.25 * min(np.square(relative(one)).mean() for one in found.standard.values())
    assert max(found.designed.uses.values()) <= 1


def test_a_search_watches_the_vehicle_that_uses_most_of_a_limit(speeds):
    task = speeds.task
    coefficients = 0.01 * jax.random.normal(jax.random.key(1), (task.size,))
    fly = jax.vmap(lambda a: jaxos4.simulate(MODEL, a, task._omega(coefficients), dt=0.01).states[:, RATES[0]])
    most = task.fleet[jnp.abs(fly(task.fleet)).max(axis=1).argmax()]
    assert (task.watching(coefficients).watched == most).all(axis=1).any()


@pytest.mark.slow
def test_vehicles_that_would_turn_over_are_watched_from_the_start():
    """If they are watched only after two stages, this search ends at 0.62 of the multisine's bounds."""
    gain, excited = design.design_input(MODEL, compare=True, key=1).gain("multisine")
    assert excited == 8
    assert gain < 0.2


@pytest.mark.slow
def test_each_criterion_is_lowest_for_the_design_that_minimises_it(speeds):
    """`"A"` has the smaller marginal bounds, and `"D"` the smaller determinant of the covariance."""
    other = design.design_input(MODEL, bracket=BRACKET, **OPEN_SETTINGS | {"criterion": "D"}, key=0)
    by = {"A": speeds, "D": other}
    task = speeds.task

    def measured(found, criterion):
        slopes = np.asarray(jax.jit(lambda omega: task._sense(omega, MODEL.alpha))(jnp.asarray(found.designed.inputs)))
        information = np.einsum("tsu,tsv->uv", slopes, slopes)
        return float(jax.jit(criterion_of, static_argnums=2)(information, np.asarray(task.scale), criterion))

    assert measured(by["A"], "A") < measured(by["D"], "A")
    assert measured(by["D"], "D") < measured(by["A"], "D")
    np.testing.assert_allclose(
        measured(speeds, "A"), np.log(np.square(relative(speeds.designed)).mean()) / 2, rtol=1e-6
    )


# References.


@pytest.mark.slow
def test_designed_references_tell_twice_as_much_as_3211(references):
    """With the same length and no larger values; the bounds are standard deviations."""
    found = references
    assert found.gain("3211")[0] < 0.5
    assert max(found.gain(name)[0] for name in found.standard) < 0.6
    for one in (found.designed, found.standard["3211"]):
        assert (np.abs(one.inputs).max(axis=0) <= np.array([0.3, 0.3, 0.3, 1.5]) * (1 + 1e-9)).all()
        assert one.inputs.shape == (1001, 4)
    period = round(found.designed.period / LOOP_DT)
    np.testing.assert_allclose(found.designed.inputs[period:], found.designed.inputs[:-period], atol=1e-9)


@pytest.mark.slow
def test_how_the_sensors_are_mounted_changes_no_references(references):
    mounted = eqx.tree_at(lambda loop: loop.airframe.sensor_rotation, LOOP, np.array([10.0, -5.0, 45.0]))
    found = design.design_references(mounted, bracket=LOOP_BRACKET, **LOOP_SETTINGS, key=0)
    np.testing.assert_array_equal(found.designed.inputs, references.designed.inputs)


@pytest.mark.slow
def test_other_vehicles_in_other_gusts_keep_the_limits(references):
    """The limits of rates and angles are mostly used by gusts, whose largest value is random."""
    assert max(references.designed.uses.values()) <= 1
    others = Fleet.of(LOOP, LOOP_BRACKET, LOOP_DT, jax.random.key(77))
    uses = others.uses(references.designed.inputs, references.task.envelope)
    assert max(uses[name] for name in ("fastest", "slowest", "velocity", "distance")) <= 1
    assert max(uses[name] for name in ("angle", "rate")) < 1.15


def test_a_criterion_that_is_not_finite_is_an_error(references):
    lost = dataclasses.replace(references.task, added=np.full_like(references.task.added, np.nan))
    with pytest.raises(jaxos4.InputError, match="accuracy after these references is not a finite number"):
        search(lost, compare=False, key=jax.random.key(0), progress=lambda _: None)


@pytest.mark.slow
def test_the_bounds_are_those_of_filter_error(references):
    """The bounds of an identified flight, whose filters know neither the noise nor the parameters."""
    designed = references.designed
    flight = jaxos4.fly_closed_loop(LOOP, jnp.asarray(designed.inputs), dt=LOOP_DT, key=jax.random.key(5))
    settings = jaxos4.VehicleSettings(holdout=0.0, begin=0.0, end=LOOP_SECONDS)
    estimate = jaxos4.identify(flight, CRAZYFLIE, settings=settings)
    constants = [estimate.rigid_body.constants[name] for name in ("Ix", "Iy", "Iz")]
    known = [estimate.parameters[name] for name in ("alpha3", "alpha6", "alpha8")]
    # An interval is wider than the bound if parts of the flight disagree by chance.
    bounds = np.array([one.std * alpha.bound / alpha.std for one, alpha in zip(constants, known, strict=True)])
    errors = np.array([one.estimate for one in constants]) - np.asarray(CRAZYFLIE.inertia)
    np.testing.assert_allclose(bounds / designed.bounds[:3], 1, atol=0.35)
    assert np.abs(errors / designed.bounds[:3]).max() < 4


@pytest.mark.slow
def test_repeated_references_add_the_same_information(references):
    """Half of the flight without references leaves half of what they add: bounds fall with the root of the duration."""
    fleet, designed = references.task.fleet, references.designed
    quiet = dataclasses.replace(LOOP, gust=0.0, gyro_noise=0.0, attitude_noise=0.0, force_noise=0.0)
    period = round(designed.period / LOOP_DT)
    some = np.zeros((BATCH, *designed.inputs.shape))
    whole = designed.inputs.shape[0] // period
    for repeats in range(1, whole + 1):
        some[repeats, : repeats * period] = designed.inputs[: repeats * period]
    flights = fly_batch(batch_of(quiet), jnp.asarray(some), jnp.asarray(LOOP_DT), jax.random.key(0))
    information = np.asarray(fleet.informations(flights)[1])[: whole + 1].sum(axis=1)
    added = np.diff(np.stack([np.diagonal(one)[[2, 5, 7]] for one in information]), axis=0)
    # The first period begins, and the last one ends, with a step.
    np.testing.assert_allclose(added / added.mean(axis=0), 1, atol=0.1)
    np.testing.assert_allclose(designed.shortest(designed.bounds[:3] / 2), 4 * LOOP_SECONDS, rtol=1e-9)


@pytest.mark.slow
def test_the_command_writes_references_that_simulate_flies(references, command, run, tmp_path):
    out, loop = command("design_references", references, LOOP_BRACKET, LOOP_SETTINGS, *CLOSED, "--duration", "4")
    for words in ("x 3211", "of 64 vehicles", "known to 5 %: Ix after", "criterion D"):
        assert words in out
    assert jax.tree.structure(loop) == jax.tree.structure(LOOP)
    for one, other in zip(jax.tree.leaves(loop), jax.tree.leaves(LOOP), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)
    written, dt = design.read_references(tmp_path / "new.csv")
    assert dt == pytest.approx(LOOP_DT)
    np.testing.assert_allclose(written, references.designed.inputs, atol=1e-6)
    out = output_of(run("simulate", *CLOSED, "--references", "new.csv", "--out", "flight.csv"))
    assert "1001 samples of 0.004 s" in out


@pytest.mark.parametrize(
    ("read", "text", "said"),
    [
        ("input", "t,omega1,omega2,omega3,omega4\n0,1,1,1,1\n0.01,1,1,1,1\n", r"is not sampled every 0.02 s"),
        ("input", "t,omega1,omega2,omega3\n0,1,1,1\n0.02,1,1,1\n", r"column omega4: is missing"),
        ("input", "t,omega1,omega2,omega3,omega4\n0,1,1,1,1\n0.02,1,1,,1\n", r"omega3: a cell is empty"),
        ("input", "t,omega1,omega2,omega3,omega4\n0,1,1,1,1\n0.02,1,1,-1,1\n", r"has a negative cell"),
        ("references", "t,roll_reference\n0,0\n1,0\n", r"column pitch_reference: is missing"),
        ("references", "t,{}\n0,0,0,0,0\n1,0,0,,0\n", r"a cell is empty"),
        ("references", "t,{}\n0,0,0,0,0\n1,0,0,0,0\n3,0,0,0,0\n", r"not sampled at equal times"),
    ],
)
def test_a_file_is_refused_in_one_line(tmp_path, read, text, said):
    path = tmp_path / "new.csv"
    path.write_text(text.replace("{}", "roll_reference,pitch_reference,yaw_reference,az_reference"))
    with pytest.raises(jaxos4.InputError, match=f"new.csv: .*{said}"):
        design.read_input(path, 0.02) if read == "input" else design.read_references(path)


# Criteria and envelopes.


def test_criteria_are_means_of_the_relative_bounds_without_the_nuisances():
    factor, half_width = np.random.default_rng(0).normal(size=(7, 7)), np.array([1.0, 2.0, 0.5])
    information = factor @ factor.T
    relative = np.linalg.inv(information)[:3, :3] / np.outer(half_width, half_width)
    criterion = jax.jit(criterion_of, static_argnums=2)
    value = {name: float(criterion(information, half_width, name)) for name in CRITERIA}
    np.testing.assert_allclose(value["D"], np.log(np.linalg.det(relative)) / 6, rtol=1e-9)
    np.testing.assert_allclose(value["A"], np.log(np.trace(relative) / 3) / 2, rtol=1e-9)
    worst = np.log(np.diagonal(relative).max()) / 2
    assert worst <= value["worst"] <= worst + np.log(3) / 16


def test_an_envelope_is_just_kept_by_its_flight_and_a_limit_must_be_a_positive_number():
    flight = standard_flight()
    envelope, flown = Envelope.of(flight.omega, flight.states, float(DT)), (flight.omega, flight.states, float(DT))
    uses = jax.jit(Envelope.uses)(envelope, *flown)
    np.testing.assert_allclose([np.abs(use).max() for use in uses.values()], 1, rtol=1e-6)
    assert set(envelope.shares(*flown).values()) == {1.0}
    half = envelope.limited({"slowest": float(envelope.slowest) / 2, "angle": 2 * envelope.angle, "velocity": 1e3})
    shares = half.shares(*flown)
    assert (shares["slowest"], shares["angle"], shares["rate"]) == pytest.approx((0.5, 0.5, 1))
    failed = envelope.shares(flight.omega, flight.states.at[200:].set(np.nan), float(DT))
    assert failed["angle"] == failed["distance"] == np.inf
    for name, value, message in (
        ("angle", [0.1, 0.2], "one number or 3 "),
        ("distance", np.inf, "positive and finite"),
        ("slowest", 300.0, "below `fastest`"),
    ):
        with pytest.raises(jaxos4.InputError, match=message):
            envelope.limited({name: value})
