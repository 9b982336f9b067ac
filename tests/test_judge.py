"""Issues about an estimate of a vehicle, and the jackknife that widens its intervals."""

import dataclasses
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
from scipy.special import chdtri

import jaxos4
from jaxos4.airframe import OS4
from jaxos4.identification.answers import VehicleAnswer, dominated
from jaxos4.identification.intervals import disagreement, parts_of
from jaxos4.identification.issues import issues_of_predictions, vibration
from jaxos4.identification.issues_of_values import issues_of_values
from jaxos4.identification.results import (
    Constant,
    Disturbance,
    FixedParameter,
    ParameterEstimate,
    PredictionSkill,
    RateSkill,
)
from jaxos4.identification.search import Optimum
from jaxos4.models.os4 import CorrectedOS4
from jaxos4.recording import read_recording
from jaxos4.results import RESULTS

AIRFRAME = Path(__file__).parents[1] / "experiments" / "real_flight" / "crazyflie.toml"
VEHICLE = jaxos4.FlightModel(
    eqx.tree_at(lambda a: a.max_rotor_speed, OS4, np.asarray(400.0)),
    terms=("damping", "motor", "delay", "accelerometer"),
)
IMPLAUSIBLE = "implausible"


def parameter(value, std):
    return ParameterEstimate(value, std, std, (value - 2 * std, value + 2 * std), "1", "")


def believable():
    """Parameters and inertias of the OS4, each known to 2 %."""
    alpha = np.asarray(CorrectedOS4(OS4).alpha)
    parameters = {f"alpha{i + 1}": parameter(x, 0.02 * abs(x) + 1e-3) for i, x in enumerate(alpha.tolist())}
    parameters |= {"rotor_lag": parameter(0.05, 0.001), "rotor_delay": parameter(0.01, 0.001)}
    parameters["thrust_gain"] = parameter(1.0, 0.01)
    table = zip(("Ix", "Iy", "Iz"), np.asarray(OS4.inertia).tolist(), strict=True)
    return parameters, {name: Constant(x, 0.02 * x, "kg m^2") for name, x in table}


def skill(**rates):
    """Skills at 0.25 s; 0.8 for rates that are not given."""
    nothing = [None, None, None]

    def rate(value):
        return RateSkill([0.9, value, 0.1], [0.1] * 3, nothing, nothing, nothing)

    return PredictionSkill([0.1, 0.248, 0.5], 100, **{name: rate(rates.get(name, 0.8)) for name in "pqr"})


def issues(changed=None, inertias=None, skill=None, still=(), **others):
    """The issues about a believable estimate, some of whose parameters or inertias (value, std) are changed."""
    parameters, constants = believable()
    parameters |= {name: parameter(*values) for name, values in (changed or {}).items()}
    constants |= {name: Constant(*values, "kg m^2") for name, values in (inertias or {}).items()}
    found = issues_of_values(VEHICLE, parameters, constants, **others)
    return (*found, *issues_of_predictions(skill, still))


def test_nothing_speaks_against_a_good_estimate_and_one_without_roll_and_pitch_is_none():
    assert issues(skill=skill()) == issues() == ()
    # An uncertain parameter is no contradiction.
    for name in ("rotor_lag", "rotor_delay", "thrust_gain", "alpha1"):
        assert issues({name: (-0.5, 1.0)}) == ()
    # Rotors of a Crazyflie damp by 0.7 to 1.3 1/s, those of RotorPy's Hummingbird by 1.7. A poor log knows it poorly.
    assert issues({"roll_damping": (1.8, 0.1), "pitch_damping": (5.0, 1.0)}) == ()
    parameters, constants = believable()
    del parameters["alpha3"]
    parameters["alpha6"] = parameter(10.0, 5.0)
    found = issues_of_values(VEHICLE, parameters, {"Iz": constants["Iz"]})
    assert [str(issue).split()[0] for issue in found] == ["roll", "pitch"]


@pytest.mark.parametrize(("curve", "is_unusual"), [(0.74, False), (1.04, False), (0.6, True), (1.1, True)])
def test_a_motor_is_unusual_beyond_two_standard_deviations_of_its_prior(curve, is_unusual):
    parameters, constants = believable()
    parameters["thrust_curve"] = msgspec.structs.replace(parameter(curve, 0.02), bracket=(0.75, 0.95))
    found = [str(issue) for issue in issues_of_values(VEHICLE, parameters, constants)]
    expected = f"thrust_curve = {curve} is unusual (expected: 0.65 to 1.05); log rotor speeds"
    assert found == [expected] * is_unusual


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"alpha3": (-100.0, 5.0)}, ("alpha3", "roll", "opposite sign")),
        ({"alpha8": (-70.0, 5.0)}, ("alpha8", "yaw", "rotor_spins")),
        ({"alpha1": (4.0, 0.1)}, ("alpha1", "contradict", "gyro")),
        ({"alpha7": (-3.0, 0.1)}, ("alpha7", "contradict")),
        ({"rotor_lag": (-0.02, 0.003)}, ("rotor_lag = -0.02 s is negative", "omega1..4")),
        ({"rotor_delay": (-0.06, 0.003)}, ("rotor_delay", "60 ms late", "time stamps")),
        ({"thrust_curve": (1.5, 0.03)}, ("thrust_curve = 1.5 is not between 0 (thrust linear", "climbs")),
        ({"pitch_damping": (6.0, 0.6)}, ("pitch_damping = 6 1/s is more than rotors give", "100 Hz", "on board")),
        ({"az_bias": (1.2, 0.02)}, ("az_bias = 1.2 m/s^2", "levelled accelerometer", "mass")),
        ({"thrust_gain": (0.02, 0.01)}, ("accelerometer", "does not follow")),
        ({"thrust_gain": (-1.0, 0.05)}, ("z axis points down",)),
        ({"thrust_gain": (9.8, 0.2)}, ("thrust_gain = 9.8 (the accelerometer shows more thrust", "mass")),
        (
            {"thrust_gain": (0.3, 0.02)},
            ("thrust_gain = 0.3 (the accelerometer shows less thrust", "thrust_coefficient"),
        ),
    ],
)
def test_a_parameter_that_contradicts_physics_is_named_with_its_cause(changed, words):
    (issue,) = issues(changed)
    assert issue.severity == IMPLAUSIBLE
    assert [word for word in words if word not in str(issue)] == []


@pytest.mark.parametrize(
    ("inertias", "words"),
    [
        ({"Iz": 0.03}, ("Iz", "exceeds Ix + Iy", "drag_coefficient")),
        ({"Ix": 0.03}, ("Ix", "exceeds Iy + Iz")),
        ({"Ix": 0.2, "Iy": 0.2}, ("Ix", "more than", "mass")),
        ({"Ix": 7.5e-5, "Iy": 7.5e-5, "Iz": 1.3e-4}, ("Ix", "less than", "rotor_positions")),
    ],
)
def test_inertias_that_no_body_has_are_named(inertias, words):
    found = issues(inertias={name: (x, 0.02 * x) for name, x in inertias.items()})
    assert {issue.severity for issue in found} == {IMPLAUSIBLE}
    assert [word for word in words if word not in str(found[0])] == []
    # Inertias that are wrong because the thrust is are not named beside it.
    wrong = issues({"thrust_gain": (9.8, 0.2)}, {name: (x, 0.02 * x) for name, x in inertias.items()})
    assert len(wrong) == 1


def test_a_gyro_that_vibrates_is_named():
    quiet, loud = (Disturbance(5.0, "rad/s^2", 0.25, 0.02, correlation) for correlation in (0.1, -0.6))
    assert not list(vibration({"p": quiet, "q": quiet, "r": quiet, "az": loud}, 0.004))
    (issue,) = vibration({"p": quiet, "q": loud, "r": quiet}, 0.004)
    assert all(word in str(issue) for word in ("noise of q", "-0.6", "`sample_time` 0.008", "log faster"))
    # Longer samples would hide the motion too.
    (issue,) = vibration({"q": loud}, 0.008)
    assert "sample_time" not in str(issue)


@pytest.mark.parametrize(("rates", "axes"), [({"p": 0.0}, "roll"), ({"q": -1.0, "r": -0.1}, "pitch and yaw")])
def test_predictions_of_a_fit_without_skill_are_not_believed(rates, axes):
    """Skill 0.1 s ahead is a reservation. Without any, predictions are refused; if clearly so, inertias too."""
    (issue,) = issues(skill=skill(**rates))
    assert (issue.severity, issue.status) == ("successful", "identified with a reservation")
    assert issue.moves == {"predictions": None}
    assert axes in str(issue)
    assert issues(skill=skill(**dict.fromkeys(rates))) == ()  # not measured
    # The held-out parts are too short for 0.25 s.
    short = RateSkill([-0.5, None, None], *[[None] * 3] * 4)
    (issue,) = issues(skill=PredictionSkill([0.1, 0.248, 0.5], 14, p=short, q=short, r=short))
    assert "roll and pitch and yaw no better than constant rates (skill p -0.5 at 0.1 s, " in str(issue)
    assert (issue.severity, set(issue.moves)) == ("no_skill", {"predictions", "Ix", "Iy", "Iz"})
    # Each rate has its own horizon.
    (issue,) = issues(skill=PredictionSkill([0.1, 0.248, 0.5], 14, p=skill().p, q=short, r=skill().r))
    assert "predicts pitch no better than constant rates (skill q -0.5 at 0.1 s)" in str(issue)
    # An axis that the held-out part hardly shows has no skill to lose, and the cause comes before the missing skill.
    poor = skill(p=0.5, q=0.5, r=-2.0)
    assert issues(skill=poor, still=["yaw"]) == ()
    (issue,) = issues(skill=poor, still=["roll", "pitch", "yaw"])
    assert (issue.severity, "`validate`" in issue.remedy) == ("no_skill", True)
    first, second = issues({"rotor_lag": (0.002, 0.001)}, skill=skill(p=-1.0), log_step=0.01)
    assert "rotor_lag = 0.002 s is shorter than a sample of the log, 0.01 s" in first.cause
    assert "predictions" in second.moves


def test_a_disturbance_larger_than_the_control_is_named():
    omega = np.asarray(OS4.hover_speed) + np.random.default_rng(0).normal(0, 1.0, (1000, 4))
    torque = (omega[:-1] ** 2 @ np.asarray(OS4.mixer)[:3].T).std(axis=0)
    sizes = (torque / np.asarray(OS4.inertia) * np.array([0.9, 1.1, 0.9])).tolist()
    gusts = {rate: Disturbance(size, "rad/s^2", 0.1, 0.01, 0.0) for rate, size in zip("pqr", sizes, strict=True)}
    model = jaxos4.CorrectedOS4(OS4)
    flight = jaxos4.Flight(0.01 * np.arange(1000), omega, np.full((1000, 12), np.nan))
    problem = jaxos4.ShootingProblem(model, flight, sigma=np.ones(12))
    counts = map(jnp.asarray, (0.0, 1, 1))
    estimate = jaxos4.Estimate(model.alpha, jnp.eye(8), jnp.zeros(3), *counts, RESULTS.successful)
    nothing = {"optimum": Optimum._make(len(Optimum._fields) * [None]), "widened": {}}
    answer = VehicleAnswer(problem, estimate, np.ones(8), 1, disturbances=gusts, **nothing)
    weak = dominated(answer)
    assert list(weak) == ["pitch"]
    assert "about pitch, the disturbance" in weak["pitch"]
    no_pitch, no_yaw = (
        dataclasses.replace(answer, fixed={name: FixedParameter(0.0, "1", "")}) for name in ("alpha6", "alpha8")
    )
    assert not dominated(no_pitch)
    # Vehicles hardly yaw: if nothing is known of it, the other axes do not need it.
    assert list(dominated(no_yaw)) == ["pitch", "yaw"]


# The jackknife of a straight line, for which one Gauss-Newton step is exact.


def segments_of_a_line(rng, slopes=1.0):
    """Gradient and information of y = slope x + b + noise in 40 segments, at the joint least-squares estimate.

    Also the data.
    """
    x = rng.standard_normal((40, 50))
    y = slopes * x + 0.5 + rng.standard_normal(x.shape)
    regressors = np.stack([x, np.ones_like(x)], axis=-1)
    information = np.einsum("lsi,lsj->lij", regressors, regressors)
    estimate = np.linalg.solve(information.sum(axis=0), np.einsum("lsi,ls->i", regressors, y))
    gradient = -np.einsum("lsi,ls->li", regressors, y - regressors @ estimate)
    return gradient, information, regressors, y


def test_the_jackknife_is_that_of_repeated_fits():
    rng = np.random.default_rng(3)
    gradient, information, regressors, y = segments_of_a_line(rng, 1.0 + 0.5 * rng.standard_normal((40, 1)))
    (part,) = parts_of(40, np.zeros(40, dtype=int))
    factor = disagreement(gradient, information, np.zeros((2, 2)), part)
    fits = []
    for number in range(20):
        kept = part != number
        flat, values = regressors[kept].reshape(-1, 2), y[kept].ravel()
        fits.append(np.linalg.lstsq(flat, values, rcond=None)[0])
    variance = 19 / 20 * np.square(np.array(fits) - np.mean(fits, axis=0)).sum(axis=0)
    ratio = np.sqrt(variance / np.diagonal(np.linalg.inv(information.sum(axis=0))))
    assert ratio[0] > 2
    np.testing.assert_allclose(factor[0], ratio[0], rtol=1e-6)
    assert factor[1] == 1 or ratio[1] ** 2 > chdtri(19, 0.05) / 19


def test_the_jackknife_of_many_unknowns_is_quick_and_the_same(monkeypatch):
    """Fifty logs have hundreds of unknowns, and least squares by singular values take half a second for each part."""
    rng, unknowns, part = np.random.default_rng(6), 40, np.arange(60)
    rows = rng.standard_normal((60, 50, unknowns))
    information, gradient = np.einsum("lsi,lsj->lij", rows, rows), rng.standard_normal((60, unknowns)) * 20
    asked = []
    lstsq = np.linalg.lstsq
    monkeypatch.setattr(np.linalg, "lstsq", lambda *given, **how: asked.append(given) or lstsq(*given, **how))
    factors = disagreement(gradient, information, np.zeros((unknowns, unknowns)), part)
    assert asked == []
    assert (factors > 1).any()
    doubled = [np.concatenate([each, each[..., :1]], axis=-1) for each in (gradient, information)]
    doubled[1] = np.concatenate([doubled[1], doubled[1][:, :1]], axis=1)  # the first unknown twice: not determined
    tiny = 1e-9 * np.eye(unknowns + 1)
    assert np.isfinite(disagreement(*doubled, tiny, part)).all()
    assert len(asked) == 60
    monkeypatch.setattr("jaxos4.identification.intervals._CLEAR", np.inf)
    slowly = disagreement(gradient, information, np.zeros((unknowns, unknowns)), part)
    np.testing.assert_allclose(slowly, factors, rtol=1e-9)


def test_parts_that_agree_widen_one_interval_in_twenty():
    rng, part = np.random.default_rng(4), parts_of(40, np.zeros(40, dtype=int))[0]
    trials = 400
    factors = [disagreement(*segments_of_a_line(rng)[:2], np.zeros((2, 2)), part) for _ in range(trials)]
    widened = np.mean(np.array(factors) > 1)
    assert abs(widened - 0.05) < 4 * np.sqrt(0.05 * 0.95 / (2 * trials))
    assert np.max(factors) < 2


def test_recordings_are_parts_of_their_own_if_there_are_enough_and_widen_more_than_their_blocks():
    """A slope that differs from recording to recording, and not within one."""
    lanes = np.arange(12)
    assert len(parts_of(12, lanes // 6)) == 1
    blocks, recordings = parts_of(12, lanes // 3)
    assert np.unique(blocks).size == 12
    assert recordings.tolist() == (lanes // 3).tolist()
    assert parts_of(3, np.zeros(3, dtype=int)) == []
    rng, recording = np.random.default_rng(5), np.arange(40) // 8
    slopes = 1.0 + np.repeat(rng.standard_normal(5), 8)[:, None]
    gradient, information, *_ = segments_of_a_line(rng, slopes)
    by_block, by_recording = (
        disagreement(gradient, information, np.zeros((2, 2)), part)[0] for part in parts_of(40, recording)
    )
    assert by_recording > 1.3 * by_block > 1.3


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_a_recorded_flight_does_not_end_successful_without_skill_or_against_physics(shared_flights):
    vehicle = jaxos4.load_airframe(AIRFRAME)
    found = jaxos4.identify(read_recording(shared_flights / "arpl_crazyflie_yaw_b.csv", vehicle), vehicle)
    # What was held out is too short for predictions of 0.25 s.
    skills = [getattr(found.skill, rate).skill[0] for rate in "pqr"] if found.skill is not None else []
    assert any(skill is not None and skill <= 0 for skill in skills)
    assert found.result == "unidentifiable"
    assert found.verdicts["predictions"].status == "not identified"
    # Rounding decides which minimum a search finds in 2.8 s. Besides the short flight there is another reason.
    for name in ("Ix", "Iy"):
        reasons = found.verdicts[name].reasons
        assert any("depends on the sample time" in why or why.startswith("it is known to") for why in reasons)
