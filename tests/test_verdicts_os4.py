"""Verdicts of a flight of an OS4: what was asked are its alphas, and not the rigid body that they may contradict."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import standard_flight

import jaxos4
from jaxos4.airframe import OS4
from jaxos4.excitation import doublet, multisine
from jaxos4.flight import ANGLES, RATES
from jaxos4.identification.issues_of_values import issues_of_alphas
from jaxos4.identification.prepare_os4 import prepare_os4
from jaxos4.identification.results import Constant, ParameterEstimate, RigidBody
from jaxos4.identification.tables import physical_quantities
from jaxos4.identification.verdict import CONTRADICTED, IDENTIFIED, RESERVED
from jaxos4.recording import Recording


def drawn(number):
    """A flight whose alphas lie inside 60 % of the default brackets, and these alphas."""
    random, model = np.random.default_rng([7, number]), jaxos4.PublishedOS4()
    alpha = np.asarray(model.alpha) + 0.6 * random.uniform(-1, 1, 8) * np.asarray(model.half_width)
    flight = jaxos4.simulate(model, jnp.asarray(alpha), multisine(OS4), dt=0.01)
    return alpha, jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(flight, key=jax.random.key(number))


def changed(flight, *, scale=1.0, order=(0, 1, 2)):
    """The states with body rates of another scale and order."""
    states = np.array(flight.states)
    states[:, RATES] = scale * states[:, RATES[list(order)]]
    return {"states": states}


@pytest.mark.slow
@pytest.mark.parametrize("number", range(4))
def test_alphas_of_no_rigid_body_contradict_the_rigid_body_alone(number):
    alpha, flight = drawn(number)
    found = jaxos4.identify(flight, jaxos4.PublishedOS4())
    assert found.successful
    statuses = {name: verdict.status for name, verdict in found.verdicts.items()}
    assert statuses.pop("rigid body") == CONTRADICTED
    assert set(statuses.values()) <= {IDENTIFIED, RESERVED}  # below noise
    assert "not those of one rigid body" in " ".join(found.verdicts["rigid body"].reasons)
    assert {each.judged for each in physical_quantities(found) if not each.trusted} == {"rigid body"}
    z = [(row.estimate - truth) / row.std for row, truth in zip(found.parameters.values(), alpha, strict=True)]
    assert np.abs(z).max() < 3.5
    assert np.mean(np.abs(z) < 1.96) >= 7 / 8
    lines = found.summary(width=1000).splitlines()
    assert lines[0].startswith("alpha1, ")
    assert lines[0].endswith(": identified.")
    assert ": successful," in lines[-2]


@functools.cache
def good(channels):
    flight = jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(standard_flight(), key=jax.random.key(0))
    return jaxos4.identify(flight, jaxos4.PublishedOS4(), settings=jaxos4.OS4Settings(channels=channels))


@pytest.mark.parametrize("channels", ["all", pytest.param("rates", marks=pytest.mark.slow)])
def test_a_good_flight_identifies_what_it_shows(channels):
    found = good(channels)
    assert found.successful
    assert {found.verdicts[name].status for name in ("rigid body", "alpha1", "alpha3", "alpha6", "alpha8")} == {
        IDENTIFIED
    }


def test_a_rotor_inertia_below_noise_is_no_physical_value():
    found = good("all")
    assert "J_R" in found.rigid_body.constants
    assert [each.name for each in physical_quantities(found)][:4] == ["Ix", "Iy", "Iz", "alpha1"]
    assert "J_R below noise" in found.summary(width=300)


FAULTY = {
    "rates halved": lambda flight: changed(flight, scale=0.5),
    "time twice as fast": lambda flight: {"time": np.asarray(flight.time) / 2},
    "time 1.25 times as fast": lambda flight: {"time": np.asarray(flight.time) / 1.25},
    "roll and pitch exchanged": lambda flight: changed(flight, order=(1, 0, 2)),
}


@pytest.mark.slow
@pytest.mark.parametrize("channels", ["all", "rates"])
@pytest.mark.parametrize("fault", FAULTY)
def test_a_fault_of_the_log_contradicts_alphas_of_no_rigid_body(fault, channels):
    """A flight of 2.5 s is long enough to compare attitude and gyro."""
    _, flight = drawn(0)
    settings = jaxos4.OS4Settings(channels=channels)
    found = jaxos4.identify(
        dataclasses.replace(flight, **FAULTY[fault](flight)), jaxos4.PublishedOS4(), settings=settings
    )
    assert found.result == "implausible"
    assert {verdict.status for verdict in found.verdicts.values()} == {CONTRADICTED}
    first, *_ = found.summary(width=200).splitlines()
    assert first.startswith("alpha1, ")
    assert first.endswith(", rigid body: refused (contradicted).")
    assert set(found.to_dict()["verdicts"]) == {*found.parameters, "rigid body"}
    if fault == "rates halved":
        assert "the attitude turns 2 times as much as the gyro says" in found.verdicts["alpha3"].reasons[0]


def test_a_wrong_attitude_is_a_note_if_the_rates_alone_are_fitted():
    flight = standard_flight(duration=10.0)
    states = np.asarray(flight.states).copy()
    states[:, ANGLES] *= 1.3
    recording = Recording.of(dataclasses.replace(flight, states=states), "flight")
    judged = {}
    for channels in ("all", "rates"):
        settings = jaxos4.OS4Settings(channels=channels)
        nothing = dict.fromkeys(("estimator", "bracket", "network", "validate"))
        data, *_ = prepare_os4((recording,), jaxos4.PublishedOS4(), settings, **nothing)
        judged[channels] = [each.name for each in data.findings], any("attitude" in x for x in data.provenance.notes)
    assert judged == {"all": (["attitude_scale"], False), "rates": ([], True)}


def test_alphas_that_no_rigid_body_has_are_named_without_an_attitude():
    states = changed(standard_flight(), scale=0.5)["states"]
    states[:, ANGLES] = np.nan
    settings = jaxos4.OS4Settings(channels="rates")
    found = jaxos4.identify(
        dataclasses.replace(standard_flight(), states=states), jaxos4.PublishedOS4(), settings=settings
    )
    assert found.result == "implausible"
    assert "alpha1 = -1.47 is not between -1 and 1" in found.verdicts["alpha1"].reasons[0]
    said = " ".join(found.verdicts["rigid body"].reasons)
    assert all(words in said for words in ("J_R = ", "is negative", "not those of one rigid body"))
    assert found.verdicts["alpha3"].trusted


def alpha_table(**alphas):
    model = jaxos4.PublishedOS4()
    lower, upper = model.alpha - model.half_width, model.alpha + model.half_width
    rows = zip(model.parameter_names, *(np.asarray(x).tolist() for x in (model.alpha, lower, upper)), strict=True)
    return {
        name: ParameterEstimate(alphas.get(name, value), 0.01, 0.01, None, "1", "", bracket=(low, high))
        for name, value, low, high in rows
    }


@pytest.mark.parametrize(
    ("alphas", "rotor", "said"),
    [
        # Its bracket ends at 1.08: an alpha inside it is right, although no rigid body has it.
        ({"alpha4": 1.05}, 0.0, {"alpha4 = 1.05": {"rigid body"}}),
        ({"alpha4": 1.3}, 0.0, {"alpha4 = 1.3": {"alpha4", "rigid body"}}),
        ({}, -60.0, {"J_R = -60 kg m^2 is negative": {"rigid body"}}),
        ({}, 60.0, {"J_R = 60 kg m^2 is larger than the Iz": {"rigid body"}}),
        ({}, 1.0, {}),
        ({}, -1.0, {}),
    ],
)
def test_an_alpha_is_contradicted_only_outside_its_bracket(alphas, rotor, said):
    constants = {"Iz": Constant(0.013, 1e-5, "kg m^2"), "J_R": Constant(rotor, 1.0, "kg m^2")}
    issues = list(issues_of_alphas(alpha_table(**alphas), RigidBody(constants, 0.5, True)))
    assert len(issues) == len(said)
    for issue, (cause, moves) in zip(issues, said.items(), strict=True):
        assert cause in issue.cause
        assert set(issue.moves) == moves


@pytest.mark.slow
def test_coloured_residuals_are_a_reservation():
    flight, slow = standard_flight(), jaxos4.GaussMarkov(jaxos4.SENSOR_SIGMA, 0.1)
    found = jaxos4.identify(slow(flight, key=jax.random.key(1)), jaxos4.PublishedOS4())
    assert found.successful
    assert {verdict.status for verdict in found.verdicts.values()} == {RESERVED}
    assert "the residuals of p, q" in found.verdicts["alpha3"].reasons[0]
    # Kalman filters and regressions do not find the best fit, so their residuals say nothing.
    other = jaxos4.identify(flight, jaxos4.PublishedOS4(), estimator="rls")
    assert not any("not white" in str(issue) for issue in other.issues)


def test_an_alpha_that_is_not_excited_does_not_refuse_the_others():
    model = jaxos4.PublishedOS4()
    flight = jaxos4.simulate(model, model.alpha, doublet(OS4), dt=0.01)
    found = jaxos4.identify(jaxos4.WhiteNoise(jaxos4.SENSOR_SIGMA)(flight, key=jax.random.key(0)), model)
    assert found.result == "unidentifiable"
    refused = {name for name, verdict in found.verdicts.items() if not verdict.trusted}
    assert refused == {"alpha1", "alpha4", "alpha7"}
    assert found.verdicts["alpha3"].status == IDENTIFIED
    assert found.summary(width=200).splitlines()[:3] == [
        "alpha3, alpha6, alpha8, rigid body: identified.",
        "alpha2, alpha5: use with care.",
        "alpha1, alpha4, alpha7: refused (not identified).",
    ]
