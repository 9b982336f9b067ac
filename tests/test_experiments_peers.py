"""`experiments/peers`: each tool is exact on flights of its own kind, and all tools get the same flights."""

import numpy as np
import pytest
from small_experiments import load, plot, result_of

import jaxos4
from experiments.fits import given_airframe
from jaxos4.recording import Recording

flights, logs = load("peers", "flights"), load("peers", "log")
QUIET = {"gyro_noise": 1e-6, "force_noise": 1e-5, "attitude_noise": 0.0}
TRUE = np.asarray(flights.CRAZYFLIE.inertia)
WRONG = given_airframe(flights.CRAZYFLIE, 0)
pytestmark = pytest.mark.slow


def log_of(flight, logged="commands"):
    return logs.Log.of(Recording.of(flight, "flight"), WRONG, commands=logged == "commands")


@pytest.fixture(scope="module")
def quiet():
    """Logs without noise, in calm air, of both kinds."""
    loops = {
        kind: jaxos4.ClosedLoop(flights.CRAZYFLIE, gust=0.0, logged=kind, **QUIET) for kind in ("commands", "speeds")
    }
    return {kind: log_of(flights.closed_loop(loop, 3, 8.0), kind) for kind, loop in loops.items()}


@pytest.mark.parametrize("logged", ["commands", "speeds"])
@pytest.mark.parametrize("response", ["acceleration", "torque"])
def test_regression_is_exact_without_noise(quiet, logged, response):
    found = load("peers", "regression").fit(quiet[logged], cutoff=8.0, response=response)
    np.testing.assert_allclose(found.inertia, TRUE, rtol=2e-3)
    assert (found.std < 1e-3 * TRUE).all()


@pytest.mark.parametrize("closed", [False, True])
def test_shooting_is_exact_without_noise(quiet, closed, monkeypatch):
    """Its program is not compiled here, which would take longer than the test."""
    pytest.importorskip("casadi", reason="pip install casadi")
    fit = load("peers", "shooting").fit
    monkeypatch.setattr("experiments.peers.shooting.COMPILED", {})
    for log in quiet.values():
        found = fit(log, window=0.5, closed=closed)
        np.testing.assert_allclose(found.inertia, TRUE, rtol=1e-3)
        assert not found.warnings


def sysid():
    """The module of `mujoco.sysid`; skips the test if MuJoCo is older, or without the extra."""
    module = pytest.importorskip("mujoco.sysid", reason="pip install 'mujoco[sysid]>=4'")
    if not hasattr(module, "optimize"):
        pytest.skip("mujoco.sysid needs its extra: pip install 'mujoco[sysid]'")
    return load("peers", "mujoco_sysid")


def test_mujoco_sysid_solves_its_own_example():
    """The armatures of an arm: the example of its tests."""
    sysid()
    pytest.importorskip("mujoco.sysid.tests.test_integration").test_arm_recover_armature()


def test_mujoco_sysid_is_exact_on_its_own_physics():
    module = sysid()
    loop = jaxos4.ClosedLoop(flights.CRAZYFLIE, gust=0.0, **QUIET)
    flight = flights.in_mujoco(loop, 3, 8.0)
    assert flight.commanded
    found = module.fit(log_of(flight), window=0.5)
    np.testing.assert_allclose(found.inertia, TRUE, rtol=4e-3)
    assert not found.warnings


def test_gusts_under_a_controller_mislead_regression_and_its_intervals_do_not_know():
    loop = jaxos4.ClosedLoop(flights.CRAZYFLIE, gust=5.0)
    found = load("peers", "regression").fit(log_of(flights.closed_loop(loop, 3, 20.0)), 8.0, "acceleration")
    assert (found.inertia[:2] > 1.3 * TRUE[:2]).all()
    assert (found.std[:2] < 0.1 * TRUE[:2]).all()


def test_a_fast_log_is_averaged_and_what_was_not_measured_is_interpolated():
    time = 0.001 * np.arange(4001)
    states = np.zeros((len(time), 12))
    states[:, 7] = np.sin(3 * time)
    states[100:103, 7] = np.nan
    force = np.tile([0.0, 0.0, 9.8], (len(time), 1))
    recording = Recording(time, np.full((len(time), 4), 5.0), states)._replace(specific_force=force)
    log = logs.Log.of(recording, WRONG, commands=True)
    assert (log.dt, len(log.rates)) == (pytest.approx(0.004), 1000)
    np.testing.assert_allclose(log.rates[:, 0], np.sin(3 * (time[:-1:4] + 0.002)), atol=1e-4)
    np.testing.assert_allclose(log.force, 9.8)
    late = logs.followed(np.repeat([[1.0], [2.0]], 50, axis=0), 0.02, 0.004)
    assert late[50:53, 0] == pytest.approx([1, 2 - np.exp(-0.2), 2 - np.exp(-0.4)])


@pytest.mark.usefixtures("optimised")
def test_all_tools_get_the_same_flights_and_who_is_missing_is_skipped(capsys, monkeypatch, shared_flights, tmp_path):
    monkeypatch.setitem(load("peers").PEERS, "CasADi", "no_such_module")
    file, airframe, _, *others = flights.REAL["Crazyflie, ARPL"]
    part = (0.0, 12.0)  # that of `test_real_flight`, which has the same program
    monkeypatch.setitem(flights.REAL, "Crazyflie, ARPL", (file, airframe, part, *others))
    cases = {"flights": 2, "duration": 16.0, "only": ["Crazyflie, 0"], "tools": ["jaxos4", "regression", "CasADi"]}
    report = result_of(tmp_path, "peers", recorded=["Crazyflie, ARPL"], recordings=shared_flights, **cases)
    plot(tmp_path, "peers")
    assert [(row["flight"], row["tool"]) for row in report["rows"]] == [
        (i, tool) for i in range(2) for tool in ("jaxos4", "regression")
    ]
    assert all(abs(row["Ix"]["error"]) < 0.1 for row in report["rows"])
    assert {row["flight"] for row in report["chosen"]} == {1000}
    ours, regression = (row["Ix"]["estimate"] for row in report["real"])
    assert 1.1e-5 < ours < 1.7e-5
    assert ours < regression < 2.5e-5  # which the controller biases
    printed = capsys.readouterr().out
    assert "CasADi: skipped: No module named" in printed
    assert "settings of the peers" in printed


def test_the_setting_with_the_smallest_error_of_both_is_chosen():
    def row(setting, x, y, air="calm"):
        return {"tool": "a", "setting": setting, "air": air, "Ix": {"error": x}, "Iy": {"error": y}}

    rows = [row(0, 0.01, 0.2), row(1, 0.1, -0.1), row(2, 0.0, 0.0, "gusts"), row(2, np.inf, 0.0)]
    best = load("peers").best
    assert best(rows, "a", ({}, {}, {}), "calm") == 1
    assert best(rows, "a", ({}, {}, {}), "gusts") == 2
