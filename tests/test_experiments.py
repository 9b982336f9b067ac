"""Each experiment that is a script runs in a small configuration, writes its results, and draws them."""

import json

import numpy as np
import pytest
from helpers import how_we_compile
from small_experiments import load, plot, report_of


@pytest.mark.usefixtures("quickly_compiled")
def test_efficiency(tmp_path):
    case = "published, rates"
    row = report_of("efficiency", tmp_path, flights=48, seed=0, scale=1.0, cases=[case])["cases"][case]
    assert row["results"] == {"successful": 48}
    # Within four Monte-Carlo standard errors of the bound, on each of the eight parameters.
    assert np.all(np.abs(np.array(row["efficiency"]) - 1) < 4 * row["monte_carlo_error"])
    assert np.all(np.abs(row["bias"]) < 4 / np.sqrt(48))
    assert abs(row["covered"] - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 48)


@pytest.mark.usefixtures("quickly_compiled")
def test_speed(tmp_path):
    sizes = {"batch": 64, "steps": 40, "flights": [2], "repeats": 2}
    report = report_of("speed", tmp_path, **sizes, channels=["rates"], methods=["euler", "rk4"])
    assert report["provenance"]["precision"] == "float64"
    assert all(row["rate"] > 0 and row["min_seconds"] <= row["median_seconds"] for row in report["rows"])


def test_networks(tmp_path):
    cases = {"cases": ["standard"], "networks": ["score, mlp"], "noises": [1.0], "channels": "rates", "separate": False}
    report = report_of("networks", tmp_path, flights=100, seed=7, steps=100, many=100, **cases)
    rows = {row["estimator"]: row for row in report["rows"]}
    assert report["one_call"]["flights"] == 100
    assert list(rows) == ["score, mlp", "hybrid", "ibss"]
    # Each of eight parameters within five Monte-Carlo errors of the bound.
    for name in ("hybrid", "ibss"):
        assert np.all(np.abs(np.array(rows[name]["efficiency"]) - 1) < 5 * rows[name]["monte_carlo_error"])
    assert rows["hybrid"]["rollouts"] < rows["ibss"]["rollouts"]
    assert rows["hybrid"]["hit_rate"] > 0.9


def test_baselines(tmp_path):
    cases = {"estimators": ["equation-error", "output-error"], "noises": ["white"], "scales": [0.0, 1.0]}
    rows = report_of("baselines", tmp_path, flights=100, seed=5, channels="rates", **cases)["rows"]
    exact, noisy = rows[:2], rows[2:]
    assert all(row["answers"] == 100 for row in rows)
    assert all(max(row["efficiency"]) < 1e-6 for row in exact)
    # Known start: integrated equation error loses most in alpha2, 1.6 times the bound.
    assert max(noisy[1]["efficiency"]) < 1 + 5 * noisy[1]["monte_carlo_error"]
    assert max(noisy[0]["efficiency"]) < 1.6 + 8 * noisy[0]["monte_carlo_error"]


def test_coverage(tmp_path):
    cases = {"model": "published", "channels": "rates", "estimators": ["ibss", "hybrid", "output-error"]}
    rows = report_of("coverage", tmp_path, flights=100, seed=11, scales=[1.0], steps=100, **cases)["rows"]
    assert [row["estimator"] for row in rows] == cases["estimators"]
    for row in rows:
        assert row["results"] == {"successful": 100}
        np.testing.assert_allclose(row["std"], 1, atol=0.05)  # the intervals are not too wide
        covered = np.array(row["covered"] + row["constants_covered"])
        assert np.all(np.abs(covered - 0.95) < 4.5 * np.sqrt(0.95 * 0.05 / 100))


def test_dirty_flights(tmp_path):
    report = report_of("dirty_flights", tmp_path, flights=2, duration=6.0, seed=17, airframes=["os4"])
    plot("dirty_flights", tmp_path / "out.json", tmp_path / "figures")
    found = report["airframes"]["os4"]
    assert {flight["result"] for flight in found["flights"]} == {"successful"}
    assert max(flight["fastest"] for flight in found["flights"]) < 5
    # The lag of 60 ms and the delay of 8 ms are found within a few standard errors.
    for name in ("rotor_lag", "rotor_delay", "alpha3", "alpha6", "roll_damping", "thrust_gain"):
        assert found["summary"][name]["identified"] == 2
        assert abs(found["summary"][name]["bias"]) < 4
    assert abs(found["summary"]["rotor_lag"]["mean_error"]) < 3e-3
    assert abs(found["summary"]["rotor_delay"]["mean_error"]) < 2e-3


@pytest.mark.usefixtures("quickly_compiled")
def test_long_flight(tmp_path):
    """Windows follow a drift that one shot cannot."""
    cases = {"duration": 20.0, "drifts": [1e-3], "windows": [1, 20], "estimators": ["ibss"]}
    one, many = report_of("long_flight", tmp_path, flights=2, seed=3, steps=100, **cases)["rows"]
    assert many["results"] == {"successful": 2}
    assert max(many["percent"]) < 5
    assert max(many["percent"][place] for place in (1, 3, 4)) < 2  # the gains of the torques
    # One shot ends at the bounds, and its result says so.
    assert one["results"] == {"at_bound": 2}


@pytest.mark.usefixtures("quickly_compiled")
def test_real_flight(shared_flights, tmp_path):
    out = tmp_path / "out.json"
    cases = {"names": ["rollpitch"], "estimators": ["filter-error"], "end": 12.0}
    load("real_flight").main(flights=shared_flights, out=out, **cases)
    plot("real_flight", out, tmp_path / "figures")
    (row,) = json.loads(out.read_text())["estimators"]["filter-error"]["flights"].values()
    assert all(0.8e-5 < row["constants"][name]["estimate"] < 2.2e-5 for name in ("Ix", "Iy"))
    assert all(value > 0 for value, _ in row["ahead"].values())


def test_flights_that_disagree_are_found():
    rows = {name: {"constants": {"Ix": {"estimate": x, "std": 3.0}}} for name, x in (("one", 1.0), ("two", 11.0))}
    rows |= {"three": {"constants": {}}}
    found = load("real_flight").disagreements(rows)
    assert found == {"Ix": {"one, two": pytest.approx(10 / np.sqrt(18))}}


def test_real_flight_needs_its_flights(tmp_path, monkeypatch):
    monkeypatch.delenv("JAXOS4_FLIGHTS", raising=False)
    with pytest.raises(SystemExit, match="--flights: no flights in None: give"):
        load("real_flight").main(out=tmp_path / "out")
    with pytest.raises(SystemExit, match="--flights: no arpl_crazyflie_rollpitch.csv in"):
        load("real_flight").main(flights=tmp_path, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("quickly_compiled")
def test_closed_loop(tmp_path, monkeypatch):
    def load_with_small_chunks(name, script="run"):
        module = load(name, script)
        module.CHUNK = 3  # two calls of each estimator, the second of them padded
        return module

    monkeypatch.setattr("small_experiments.load", load_with_small_chunks)
    cases = {
        "flights": 4,
        "gusts": [10.0],
        "duration": 6.0,
        "seed": 16,
        "estimators": ["equation-error", "output-error"],
    }
    report = report_of("closed_loop", tmp_path, **cases)
    plot("closed_loop", tmp_path / "out.json", tmp_path / "figures")
    assert [len(case["flights"]) for case in report["cases"]] == [4, 4]
    # A controller that answers gusts makes both biased by tens of percent, and their intervals do not know it.
    for row in (row for case in report["cases"] for row in case["summary"].values()):
        assert row["bias"] > 0.2
        assert row["covered"] == 0
    # An interrupted study is continued: the flights that are there are not identified again.
    assert report_of("closed_loop", tmp_path, **cases) == report
    with pytest.raises(SystemExit, match="other settings"):
        report_of("closed_loop", tmp_path, **{**cases, "seed": 17})


@pytest.mark.usefixtures("quickly_compiled")
def test_benchmarks(tmp_path, monkeypatch):
    for name, value in how_we_compile().items():
        monkeypatch.setenv(name, value)
    fits, shots = ["SciPy least_squares", "jaxos4 kalman"], ["jaxos4", "C -O3, one core"]
    sizes = {"flights": 2, "alone": 1, "repeats": 2, "steps": 500, "starts": ["known"], "seed": 0}
    growth = {"growing": "kalman", "grow_flights": [], "grow_steps": [], "grow_parameters": []}
    report = report_of(
        "benchmarks", tmp_path, **sizes, contenders=fits, shooters=shots, **growth, network_steps=0, simulations=0
    )
    rows = report["fits"]["known"]
    # Both reach the same optimum, and are timed in turns.
    assert {name: row["reached"] for name, row in rows.items()} == dict.fromkeys(fits, 1.0)
    assert all(len(row["laps"]) == 2 and row["min_seconds"] <= row["median_seconds"] for row in rows.values())
    assert all(row["peak_mib"] > 10 for row in rows.values())
    assert report["shots"]["jaxos4"]["steps_per_second"] > 0
    assert 0 < report["roofline"]["share"] < 1
    plot("benchmarks", tmp_path / "out.json", tmp_path / "figures")


def test_a_benchmark_skips_who_is_missing_or_fails():
    run = load("benchmarks")
    case = run.make_case(1, 50)
    failing = run.Contender("scipy_fit:levenberg_marquardt", alone=True, options={"unknown": 1})
    absent = run.Contender("scipy_fit:levenberg_marquardt", "no_such_package")
    skipped = []
    assert run.line_up({"failing": failing, "absent": absent}, case, 1, skipped) == {}
    assert "failing: failed: TypeError" in skipped[0]
    assert skipped[1] == "absent: no_such_package is not installed: pip install no_such_package"


def test_a_benchmark_times_only_who_reaches_the_least_cost():
    run = load("benchmarks")
    case = run.make_case(2, 50)
    truth, first = np.tile(case.truth, (2, 1)), np.zeros((2, 12))
    answers = {
        "both": {"parameters": truth, "first": first},
        "one of both": {"parameters": np.stack([truth[0], case.starts[1]]), "first": first},
        "only the first": {"parameters": truth[:1], "first": first[:1]},
        "diverged": {"parameters": 1e3 * truth, "first": first},
    }
    assert list(run.reached(case, answers).values()) == [1.0, 0.5, 1.0, 0.0]
