"""The experiments with vehicles, in small configurations."""

import numpy as np
import pytest
from scipy.signal import lfilter
from small_experiments import load, plot, result_of

import jaxos4
from experiments.__main__ import main_of
from experiments.fits import summary
from experiments.monte_carlo import groups
from experiments.real_flights import aligned, capture_lag, disagreements

pytestmark = pytest.mark.slow


@pytest.mark.usefixtures("optimised")
def test_real_flight(shared_flights, tmp_path):
    report = result_of(
        tmp_path, "real_flight", flights=shared_flights, names=["rollpitch"], estimators=["filter-error"], end=12.0
    )
    plot(tmp_path, "real_flight")
    (row,) = report["rows"]
    assert all(0.8e-5 < row["constants"][name]["estimate"] < 2.2e-5 for name in ("Ix", "Iy"))
    assert all(value > 0 for value, _ in row["ahead"].values())


def test_flights_that_disagree_are_found():
    rows = {name: {"constants": {"Ix": {"estimate": x, "std": 3.0}}} for name, x in (("one", 1.0), ("two", 11.0))}
    rows |= {"three": {"constants": {}}}
    found = disagreements(rows)
    assert found == {"Ix": {("one", "two"): pytest.approx(10 / np.sqrt(18))}}


def test_real_flight_needs_its_flights(tmp_path, monkeypatch):
    monkeypatch.delenv("JAXOS4_FLIGHTS", raising=False)
    with pytest.raises(jaxos4.InputError, match="--flights: no folder; give .* JAXOS4_FLIGHTS"):
        main_of("real_flight.run")(out=tmp_path / "out")
    with pytest.raises(jaxos4.InputError, match="--flights: no arpl_crazyflie_rollpitch.csv in"):
        main_of("real_flight.run")(flights=tmp_path, out=tmp_path / "out")
    with pytest.raises(jaxos4.InputError, match="--flights: no nanobench/B8_star_fast_rep1.csv in"):
        main_of("public_flights.run")(flights=tmp_path, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_closed_loop(monkeypatch, tmp_path):
    monkeypatch.setattr("experiments.closed_loop.run.CHUNK", 2)  # two calls of each estimator; the second is padded
    cases = {"flights": 3, "gusts": [10.0], "duration": 6.0, "seed": 16}
    cases |= {"estimators": ["equation-error", "output-error"]}
    report = result_of(tmp_path, "closed_loop", **cases)
    plot(tmp_path, "closed_loop")
    cases = groups(report["rows"], "estimator").values()
    assert [len(rows) for rows in cases] == [3, 3]
    # A controller that answers gusts makes both biased by tens of percent, and their intervals do not know it.
    for row in (row for rows in cases for row in summary(rows).values()):
        assert (row["mean"] > 0.2, row["covered"]) == (True, 0)


def test_a_soft_flight_has_no_steps_and_the_mix_of_effects_stays_what_it_was():
    """Runs before the optimised tests, so that its flights' program compiles quickly."""
    effects = load("closed_loop", "effects")
    hard, soft = (effects.flights_of(kind, 1, 16.0, 22, gust=0.0)[0] for kind in ("gusts", "soft"))
    jumps = [np.abs(np.diff(flight.omega, axis=0)).max() / flight.omega.std() for flight in (hard, soft)]
    assert jumps[1] < 0.5 * jumps[0]
    assert {"battery", "filtered gyro", "soft", "soft, fast controller"} == set(effects.EFFECTS) - set(effects.MIXED)
    mixed = effects.effect_of(effects.ALL, np.random.default_rng(0))
    assert "load_sag" not in mixed.loop
    assert (mixed.log_every, mixed.soft) == (4, False)


@pytest.mark.usefixtures("optimised")
def test_effects(tmp_path):
    """The effects of real flights are flown, identified and drawn."""
    report = result_of(tmp_path, "closed_loop", "effects", flights=1, duration=16.0, effects=["clock"])
    plot(tmp_path, "closed_loop", "plot_effects")
    (row,) = report["rows"]
    assert row["result"] == "successful"
    assert abs(row["thrust"]["error"]) < 0.05


@pytest.mark.usefixtures("optimised")
def test_verdicts(capsys, tmp_path):
    """Good and spoiled flights are judged, and counted."""
    cases = {"gusts": None, "force clipped 0.8": True}
    report = result_of(tmp_path, "verdicts", flights=1, spoiled=1, duration=16.0, cases=list(cases))
    rows = {row["case"]: row for row in report["rows"]}
    assert {name: row["named"] for name, row in rows.items()} == cases
    good, clipped = (rows[name]["Ix"] for name in cases)
    assert good["status"].startswith("identified")
    assert abs(good["error"]) < 3 * good["std"]
    assert clipped["error"] < good["error"] - 0.05  # the fault makes Ix smaller
    assert clipped["status"] == "contradicted"
    assert "spoiled flights" in capsys.readouterr().out


def test_the_response_at_the_true_parameters(capsys, tmp_path):
    cases = {"gusts": [2.5], "effects": ["motors"], "sample_times": ["8 ms"]}
    report = result_of(tmp_path, "verdicts", "response", flights=2, duration=16.0, **cases)
    for row in report["rows"]:
        assert [*row["responses"]] == ["4 ms", "8 ms", "16 ms", "32 ms"]
        for ratio, error in (row["responses"]["8 ms"][axis] for axis in ("roll", "pitch")):
            assert abs(np.log(ratio)) < 3.5 * error < 0.5
    assert "motors, 8 ms" in capsys.readouterr().out


def test_each_fault_of_the_verdicts_changes_a_flight_as_it_says():
    random = np.random.default_rng(0)
    states = random.normal(0, 0.2, (500, 12))
    flight = jaxos4.recording.Recording(0.004 * np.arange(500), random.uniform(1e3, 2e3, (500, 4)), states)
    flight = flight._replace(specific_force=states[:, :3] + [0.0, 0.0, 9.8])
    spoiled = {name: fault.spoil(flight, fault.sizes[0]) for name, fault in load("verdicts").FAULTS.items()}
    np.testing.assert_allclose(spoiled["gyro scale"].states[:, [7, 9, 11]], states[:, [7, 9, 11]] / 2)
    np.testing.assert_allclose(
        spoiled["gyro early"].states[:400, 7], np.interp(flight.time + 0.05, flight.time, states[:, 7])[:400]
    )
    np.testing.assert_allclose(spoiled["turned"].states[:, 7], np.cos(np.pi / 6) * states[:, 7] + states[:, 9] / 2)
    assert np.abs(spoiled["gyro clipped"].states[:, 7]).max() == np.abs(states[:, 7]).max() / 2
    tilted = spoiled["earth's axes"].specific_force
    np.testing.assert_allclose(np.linalg.norm(tilted, axis=1), np.linalg.norm(flight.specific_force, axis=1))
    assert len(spoiled["short"].time) == 500
    assert len(np.unique(spoiled["rare motors"].omega[:, 0])) == 100


@pytest.mark.usefixtures("optimised")
def test_sample_times(tmp_path):
    """Every sample time has the same answer, within its interval."""
    report = result_of(tmp_path, "sample_times", flights=2, sample_times=[0.004, 0.016], duration=16.0)
    for rows in groups(report["rows"], "sample_time").values():
        assert {row["result"] for row in rows} == {"successful"}
        found = load("sample_times").summary(rows, load("sample_times").truth_of("speeds", 0.004))
        assert all(abs(found[name]["mean"]) < 0.08 for name in ("Ix", "Iy"))
        assert found["Ix"]["covered"] == 1


@pytest.mark.usefixtures("optimised")
def test_rotorpy(tmp_path):
    pytest.importorskip("rotorpy.vehicles.multirotor", reason="pip install rotorpy")
    cases = {"flights": 1, "kinds": ["calm"], "duration": 16.0, "estimators": ["filter-error"]}
    report = result_of(tmp_path, "rotorpy", recordings=tmp_path / "flights", **cases)
    (path,) = (tmp_path / "flights").iterdir()
    flight = jaxos4.read_flight(path)
    assert np.isfinite(flight.omega).all()
    # Frames, positions and spins are those of jaxos4: torques of the airframe make the body accelerate.
    vehicle = load("rotorpy", "flights").VEHICLE
    rates = np.asarray(flight.states)[:, [7, 9, 11]]
    change = np.diff(rates[::5], axis=0) / (5 * float(flight.dt))
    speeds = np.asarray(flight.omega)[: 5 * len(change)].reshape(-1, 5, 4)
    expected = np.square(speeds).mean(axis=1) @ vehicle.mixer[:3].T / vehicle.inertia
    for axis in range(3):
        assert np.corrcoef(change[:, axis], expected[:, axis])[0, 1] > 0.9
    (row,) = report["rows"]
    assert row["result"] == "successful"
    assert all(abs(row[name]["error"]) < 0.05 for name in ("Ix", "Iy", "Iz", "thrust"))


@pytest.mark.usefixtures("optimised")
def test_the_order_of_a_disturbance_decides_on_the_thrust():
    """Under a controller that answers it by half, one order too few is a bias."""
    pytest.importorskip("rotorpy.vehicles.multirotor", reason="pip install rotorpy")
    fit, random, steps = load("rotorpy", "disturbance").fit, np.random.default_rng(0), 5000
    smooth = lfilter([0.05], np.poly([0.992, 0.95]), random.normal(size=steps))
    thrust = 10 - 0.5 * lfilter([0.02], [1, -0.98], smooth) + lfilter([0.05], [1, -0.95], random.normal(size=steps))
    force = 0.9 * thrust + smooth + 0.02 * random.normal(size=steps)
    first, second = fit(force, thrust, 1), fit(force, thrust, 2)
    assert second.likelihood > first.likelihood + 100
    assert abs(second.gain - 0.9) < 3 * second.std
    assert abs(first.gain - 0.9) > 2 * abs(second.gain - 0.9)


@pytest.mark.usefixtures("optimised")
def test_commands_that_are_too_rare_are_named(shared_flights, tmp_path):
    (row,) = result_of(tmp_path, "public_flights", "radio", flights=shared_flights, every=[40])["rows"]
    assert row["result"] != "successful"
    assert any("damping" in doubt["cause"] and "too rarely" in doubt["cause"] for doubt in row["doubts"])


def test_a_motion_capture_is_moved_to_the_clock_of_the_gyro():
    random = np.random.default_rng(0)
    time = 0.01 * np.arange(2000)
    angle, rate = (
        (lambda t: 0.3 * np.sin(7 * t) + 0.2 * np.sin(11 * t)),
        2.1 * np.cos(7 * time) + 2.2 * np.cos(11 * time),
    )
    states = np.zeros((len(time), 12))
    states[:, 6], states[:, 7] = angle(time - 0.013), rate
    states[:, 6:8] += random.normal(0, [0.003, 0.1], (len(time), 2))
    states[::50, 6] += 1.0  # markers that were taken for others
    recording = jaxos4.recording.Recording(time, np.ones((len(time), 4)), states)
    assert capture_lag(recording) == pytest.approx(0.013, abs=0.002)
    moved = aligned(recording)
    assert np.median(np.abs(moved.states[:-5, 6] - angle(time[:-5]))) < 0.005
    np.testing.assert_array_equal(moved.states[:, 7], states[:, 7])
