"""Designed references: what they tell, the limits that they keep, and the command."""

import contextlib
import dataclasses
import io
import shutil
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import CRAZYFLIE, CRAZYFLIE_TOML, refused

import jaxos4
from jaxos4.cli import main
from jaxos4.design import Envelope, design_and_compare_references, model_of, read_references, standard_references
from jaxos4.design.batch import LANES, batch_of, fly_batch
from jaxos4.design.filtered import Filters, informations
from jaxos4.design.fleet import Fleet

DT, SECONDS = 0.004, 10.0
LOOP = jaxos4.ClosedLoop(CRAZYFLIE, gust=5.0)
BRACKET = jaxos4.Bracket.default(model_of(LOOP))
INERTIA = np.asarray(CRAZYFLIE.inertia)


# What `jaxos4 design --closed-loop --duration 10` asks of the library.
ASKED = {"angle": 0.3, "limits": {}, "duration": SECONDS, "dt": DT, "criterion": "D", "bandwidth": 6.0, "seed": 0}
OPTIONS = ("--airframe", "mine.toml", "--closed-loop")


@pytest.fixture(scope="module")
def commanded(tmp_path_factory):
    """A run of the command: its folder, what it prints, its vehicle, what it asks of the library, what that finds."""
    folder, printed, failed, calls = tmp_path_factory.mktemp("design"), io.StringIO(), io.StringIO(), []
    (folder / "mine.toml").write_text(CRAZYFLIE_TOML)

    def seen(loop, **asked):
        calls.append((loop, asked, design_and_compare_references(loop, **asked)))
        return calls[0][-1]

    design = ("--duration", "10", "--out", "references.csv", "--figure", "references.svg")
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(printed),
        contextlib.redirect_stderr(failed),
    ):
        patch.chdir(folder)
        patch.setattr("jaxos4.design.design_and_compare_references", seen)
        patch.setattr(sys, "argv", ["jaxos4", "design", *OPTIONS, *design])
        with pytest.raises(SystemExit) as stop:
            main()
    assert (stop.value.code or 0, failed.getvalue()) == (0, "")
    return folder, printed.getvalue(), *calls[0]


@pytest.fixture(scope="module")
def found(commanded):
    """What the command designs for a flight of 10 s."""
    return commanded[-1]


def test_designed_references_tell_twice_as_much_as_3211(found):
    """With the same length and the same largest values; the bounds are standard deviations."""
    assert found.gain("3211") < 0.5
    assert max(found.gain(name) for name in found.standard) < 0.6
    for one in (found.designed, found.standard["3211"]):
        np.testing.assert_allclose(np.abs(one.references).max(axis=0), [0.3, 0.3, 0.3, 1.5], rtol=1e-9)
        assert one.references.shape == (2501, 4)
    # Designed references repeat.
    period = round(found.designed.period / DT)
    np.testing.assert_allclose(found.designed.references[period:], found.designed.references[:-period], atol=1e-9)


def test_other_vehicles_in_other_gusts_keep_the_limits(found):
    """The limits of rates and angles are mostly used by gusts, whose largest value is random."""
    assert max(found.designed.uses.values()) <= 1
    others = Fleet.of(LOOP, BRACKET, DT, jax.random.key(77))
    uses = others.uses(found.designed.references, found.envelope)
    assert max(uses[name] for name in ("fastest", "slowest", "velocity", "distance")) <= 1
    assert max(uses[name] for name in ("angle", "rate")) < 1.15


@pytest.mark.usefixtures("quickly_compiled")
def test_the_bounds_are_those_of_filter_error(found):
    """The bounds of an identified flight, whose filters know neither the noise nor the parameters."""
    key = jax.random.key(5)
    flight = jaxos4.fly_closed_loop(LOOP, jnp.asarray(found.designed.references), dt=DT, key=key)
    estimate = jaxos4.identify(flight, CRAZYFLIE, holdout=0.0, begin=0.0, end=SECONDS)
    constants = [estimate.rigid_body.constants[name] for name in ("Ix", "Iy", "Iz")]
    known = [estimate.parameters[name] for name in ("alpha3", "alpha6", "alpha8")]
    # An interval is wider than the bound if parts of the flight disagree by chance.
    bounds = np.array([one.std * alpha.bound / alpha.std for one, alpha in zip(constants, known, strict=True)])
    errors = np.array([one.estimate for one in constants]) - INERTIA
    np.testing.assert_allclose(bounds / found.designed.bounds[:3], 1, atol=0.35)
    assert np.abs(errors / found.designed.bounds[:3]).max() < 4


def test_repeated_references_add_the_same_information(found):
    """Half of the flight without references leaves half of what they add: bounds fall with the root of the duration."""
    filters = Filters.of(LOOP, BRACKET.half_width, DT)
    quiet = dataclasses.replace(LOOP, gust=0.0, gyro_noise=0.0, attitude_noise=0.0, force_noise=0.0)
    references, period = found.designed.references, round(found.designed.period / DT)
    some = np.zeros((LANES, *references.shape))
    whole = references.shape[0] // period
    for repeats in range(1, whole + 1):
        some[repeats, : repeats * period] = references[: repeats * period]
    flights = fly_batch(batch_of(quiet), some, np.asarray(DT), jax.random.key(0))
    told = np.asarray(informations(filters, flights).channels)[: whole + 1].sum(axis=1)
    added = np.diff(np.stack([np.diagonal(one)[[2, 5, 7]] for one in told]), axis=0)
    # The first period begins, and the last one ends, with a step.
    np.testing.assert_allclose(added / added.mean(axis=0), 1, atol=0.1)
    seconds = found.designed.shortest(found.designed.bounds[:3] / 2)
    np.testing.assert_allclose(seconds, 4 * SECONDS, rtol=1e-9)


def test_the_command_writes_references_that_simulate_flies(commanded, run, tmp_path):
    folder, out, loop, asked, found = commanded
    assert {name: asked[name] for name in ASKED} == ASKED
    assert set(asked) == {*ASKED, "bracket", "progress"}
    assert jax.tree.structure(loop) == jax.tree.structure(LOOP)
    for one, other in zip(jax.tree.leaves((loop, asked["bracket"])), jax.tree.leaves((LOOP, BRACKET)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    references, dt = read_references(tmp_path / "references.csv")
    assert dt == pytest.approx(DT)
    np.testing.assert_allclose(references, found.designed.references, atol=1e-6)
    assert "x 3211" in out
    assert "known to 5 %: Ix after" in out
    assert (tmp_path / "references.svg").read_text().count("<svg") == 1
    code, out, err = run("simulate", *OPTIONS, "--references", "references.csv", "--out", "flight.csv")
    assert (code, err) == (0, "")
    assert "2501 samples of 0.004 s" in out
    (tmp_path / "references.csv").write_text("t,roll_reference\n0,0\n1,0\n")
    refused(
        run("simulate", *OPTIONS, "--references", "references.csv", "--out", "new.csv"),
        *("references.csv", "pitch_reference is missing"),
    )


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("--duration 0", ("--duration", "must be positive")),
        ("--duration 1000", ("--duration", "250 to 20000 samples")),
        ("--angle 2", ("--angle", "at most 1")),
        ("--rate -1", ("--rate must be positive",)),
        ("--gust -1", ("--gust",)),
        ("--fastest 300", ("cannot hover",)),
        ("--bandwidth 100", ("--bandwidth",)),
        ("--accuracy 0", ("--accuracy",)),
        ("--slew 5", ("--slew", "without --closed-loop")),
        ("--channels rates", ("--channels", "without --closed-loop")),
        ("--sensors commands --airframe os4", ("--sensors", "max_rotor_speed")),
    ],
)
def test_mistakes_are_one_line_and_write_nothing(run, tmp_path, line, said):
    (tmp_path / "mine.toml").write_text(CRAZYFLIE_TOML)
    options = ("--closed-loop", "--out", "new.csv", "--airframe", "mine.toml")
    refused(run("design", *options, *line.split()), *said)
    assert not (tmp_path / "new.csv").exists()


def test_gusts_are_for_the_closed_loop(run):
    refused(run("design", "--gust", "5", "--out", "new.csv"), "--gust", "with --closed-loop; add that")


def test_standard_references_have_the_largest_values_that_are_asked_for():
    largest = np.array([0.1, 0.2, 0.3, 2.0])
    for shape in standard_references(5001, DT, largest).values():
        np.testing.assert_allclose(np.abs(shape).max(axis=0), largest, rtol=1e-9)
    assert np.all(standard_references(500, DT, largest)["3211"] == 0)  # no room for one axis


def test_an_envelope_says_which_share_of_its_limits_another_one_needs():
    limits = dict(zip(Envelope.__annotations__, (100.0, 300.0, 1e3, [0.2, 0.2, 0.4], 2.0, 3.0, 4.0), strict=True))
    whole = Envelope(**limits)
    half = Envelope(**{**limits, "slowest": 200.0, "angle": [0.1, 0.15, 0.1], "distance": 1.0})
    shares = whole.shares_of(half)
    assert (shares["slowest"], shares["angle"], shares["distance"], shares["rate"]) == pytest.approx(
        (0.5, 0.75, 0.25, 1)
    )
