"""Each experiment runs in a small configuration and writes the figures that it prints."""

import importlib.util
import json
import pathlib

import numpy as np

EXPERIMENTS = pathlib.Path(__file__).resolve().parents[1] / "experiments"


def load(name: str):
    spec = importlib.util.spec_from_file_location(f"experiment_{name}", EXPERIMENTS / name / "run.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_efficiency(tmp_path):
    load("efficiency").main(flights=48, seed=0, scale=1.0, cases=["published, rates"], out=tmp_path / "out.json")
    row = json.loads((tmp_path / "out.json").read_text())["cases"]["published, rates"]
    assert row["results"] == {"successful": 48}
    # Within four Monte-Carlo standard errors of the bound, on each of the eight parameters.
    assert np.all(np.abs(np.array(row["efficiency"]) - 1) < 4 * row["monte_carlo_error"])
    assert np.all(np.abs(row["bias"]) < 4 / np.sqrt(48))
    assert abs(row["covered"] - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 48)


def test_speed(tmp_path):
    load("speed").main(batch=64, steps=40, flights=[2], repeats=2, out=tmp_path / "out.json")
    report = json.loads((tmp_path / "out.json").read_text())
    assert report["provenance"]["precision"] == "float64"
    assert all(row["rate"] > 0 and row["min_seconds"] <= row["median_seconds"] for row in report["rows"])


def test_networks(tmp_path):
    load("networks").main(
        flights=100,
        seed=7,
        cases=["standard"],
        networks=["score, mlp"],
        noises=[1.0],
        steps=250,
        many=50,
        separate=False,
        out=tmp_path / "out.json",
    )
    report = json.loads((tmp_path / "out.json").read_text())
    rows = {row["estimator"]: row for row in report["rows"]}
    assert report["one_call"]["flights"] == 50
    assert list(rows) == ["score, mlp", "hybrid", "ibss"]
    # Of 100 flights, each of eight parameters within five Monte-Carlo errors of the bound.
    for name in ("hybrid", "ibss"):
        assert np.all(np.abs(np.array(rows[name]["efficiency"]) - 1) < 5 * rows[name]["monte_carlo_error"])
    assert rows["hybrid"]["rollouts"] < rows["ibss"]["rollouts"]
    assert rows["hybrid"]["hit_rate"] > 0.9


def test_baselines(tmp_path):
    load("baselines").main(
        flights=32,
        seed=5,
        channels="rates",
        estimators=["equation-error", "output-error"],
        noises=["white"],
        scales=[0.0, 1.0],
        out=tmp_path / "out.json",
    )
    rows = json.loads((tmp_path / "out.json").read_text())["rows"]
    exact, noisy = rows[:2], rows[2:]
    assert all(row["answers"] == 32 for row in rows)
    assert all(max(row["efficiency"]) < 1e-6 for row in exact)
    # Known start: integrated equation error loses most in alpha2, 1.6 times the bound.
    assert max(noisy[1]["efficiency"]) < 1 + 5 * noisy[1]["monte_carlo_error"]
    assert max(noisy[0]["efficiency"]) < 1.6 + 8 * noisy[0]["monte_carlo_error"]


def test_coverage(tmp_path):
    load("coverage").main(
        flights=100,
        seed=11,
        model="published",
        channels="rates",
        estimators=["ibss", "hybrid", "output-error"],
        scales=[1.0],
        steps=250,
        out=tmp_path / "out.json",
    )
    rows = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert [row["estimator"] for row in rows] == ["ibss", "hybrid", "output-error"]
    for row in rows:
        assert row["results"] == {"successful": 100}
        np.testing.assert_allclose(row["std"], 1, atol=0.05)  # and not by being wide
        covered = np.array(row["covered"] + row["constants_covered"])
        assert np.all(np.abs(covered - 0.95) < 4.5 * np.sqrt(0.95 * 0.05 / 100))


def test_long_flight(tmp_path):
    load("long_flight").main(
        duration=10.0,
        flights=2,
        seed=3,
        drifts=[1e-3],
        windows=[1, 20],
        estimators=["ibss"],
        steps=200,
        out=tmp_path / "out.json",
    )
    one, many = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert many["results"] == {"successful": 2}
    assert max(many["percent"]) < 5
    assert one["percent"] is None or max(one["percent"]) > 3 * max(many["percent"])
