"""The command line: output, files and exit codes, for good and for bad input."""

import csv
import functools
import json
import math
import sys

import numpy as np
import pytest
import typer
from helpers import refused

from jaxos4.cli import _app, main
from jaxos4.estimators import ESTIMATORS
from jaxos4.networks import NetworkEstimator

TRUTH = {"alpha1": -0.73333333, "alpha3": 133.33333, "alpha4": 0.73333333, "alpha6": 133.33333, "alpha8": 76.923077}


def simulate(run, path="flight.csv", *options: str) -> None:
    code, _, err = run("simulate", "--duration", "2", "--out", str(path), *options)
    assert (code, err) == (0, "")


def test_simulate_writes_the_standard_flight(run, tmp_path):
    code, out, err = run("simulate", "--out", "flight.csv")
    assert (code, err) == (0, "")
    assert "501 samples" in out
    rows = list(csv.DictReader((tmp_path / "flight.csv").read_text().splitlines()))
    assert len(rows) == 501
    omega = [float(row[f"omega{i}"]) for row in rows for i in range(1, 5)]
    assert (math.floor(min(omega)), math.floor(max(omega))) == (134, 289)
    assert all(float(rows[0][name]) == 0 for name in ("x", "vz", "phi", "p"))


def test_the_seed_determines_the_noise(run, tmp_path):
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        simulate(run, f"{name}.csv", "--noise", "1", "--seed", seed)
    a, b, c = ((tmp_path / f"{name}.csv").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_estimate_recovers_the_truth_within_its_intervals(run, tmp_path):
    simulate(run, "flight.csv", "--noise", "1")
    code, out, err = run("estimate", "flight.csv", "--out", "estimate.json")
    assert code == 0, err
    report = json.loads((tmp_path / "estimate.json").read_text())
    assert {"estimator", "model", "result", "rollouts", "cost", "seconds", "parameters", "fit"} <= report.keys()
    assert (report["estimator"], report["model"], report["result"]) == ("ibss", "published", "successful")
    assert list(report["parameters"]) == [f"alpha{i}" for i in range(1, 9)]
    for name, row in report["parameters"].items():
        assert {"estimate", "std", "bound", "ci95", "unit", "noise_limit", "note"} == row.keys()
        assert row["ci95"][0] < row["estimate"] < row["ci95"][1]
        assert abs(row["estimate"] - TRUTH.get(name, 0.0)) < 4 * row["std"]
        assert name in out
    for name in ("alpha2", "alpha5"):  # 6e-9, far below the noise
        assert report["parameters"][name]["note"] == "below noise"
    assert "residuals white (Ljung-Box), tests at 1%: all" in " ".join(out.split())
    for row in report["fit"].values():
        assert row["percent"] > 85
        assert abs(row["correlation"]) < 0.3
    # The noise levels were estimated: they are the standard sensor's, within 4 standard errors of 200 samples.
    assert report["fit"]["p"]["rms"] == pytest.approx(0.01, rel=4 / math.sqrt(2 * 200))


def test_windows_and_validation(run, tmp_path):
    simulate(run, "flight.csv", "--noise", "1")
    simulate(run, "other.csv", "--noise", "1", "--seed", "1", "--excitation", "doublet", "--duration", "5")
    options = ("--channels", "rates", "--window", "0.5", "--validate", "other.csv", "--out", "e.json")
    code, out, err = run("estimate", "flight.csv", *options)
    assert code == 0, err
    assert "validation on other.csv" in out
    assert "residuals free of the inputs (cross-correlation), tests at 1%: all" in " ".join(out.split())
    assert "Ljung-Box" not in out  # the initial state of each window correlates its residuals
    report = json.loads((tmp_path / "e.json").read_text())
    assert report["provenance"]["windows"] == 4
    for row in (*report["fit"].values(), *report["validation"]["fit"].values()):
        assert row["percent"] > 90
        assert row["level"] == pytest.approx(1, abs=0.5)
        assert row["input_p"] > 1e-4
    assert list(report["validation"]["fit"]) == ["p", "q", "r"]
    for name, truth in (("Ix", 7.5e-3), ("Iy", 7.5e-3), ("Iz", 1.3e-2)):
        row = report["constants"][name]
        assert abs(row["estimate"] - truth) < 4 * row["std"]
    assert report["constants"]["consistency_p"] > 1e-4


@pytest.mark.parametrize(
    "estimator", [name for name, kind in ESTIMATORS.items() if name != "ibss" and not kind.needs_network]
)
def test_baselines_recover_the_truth(run, tmp_path, estimator):
    simulate(run, "flight.csv", "--noise", "1")
    options = ("--estimator", estimator, "--channels", "rates", "--out", "e.json")
    code, _, err = run("estimate", "flight.csv", *options)
    report = json.loads((tmp_path / "e.json").read_text())
    # Two seconds are too short for SVSF, and it says so.
    assert (code, report["result"]) in ((0, "successful"), (1, "unidentifiable")), err
    assert report["estimator"] == estimator
    identified = {name: row for name, row in report["parameters"].items() if row["estimate"] is not None}
    assert {"alpha3", "alpha6", "alpha8"} <= set(identified)
    for name, row in identified.items():
        assert abs(row["estimate"] - TRUTH.get(name, 0.0)) < 5 * row["std"]


def test_identifiability_names_the_parameters_that_are_not_excited(run, tmp_path):
    simulate(run, "flight.csv", "--noise", "1", "--excitation", "doublet", "--duration", "5")
    code, out, err = run("identifiability", "flight.csv", "--channels", "rates", "--out", "known.json")
    assert code == 0, err
    known = json.loads((tmp_path / "known.json").read_text())
    assert known["fitted"]
    assert known["sigma"]["p"] == pytest.approx(0.01, rel=0.2)
    assert known["parameters"]["alpha1"]["note"] == "not identifiable: not excited"
    assert known["parameters"]["alpha3"]["note"] == ""
    assert known["parameters"]["alpha3"]["bound"] < known["parameters"]["alpha3"]["half_width"]
    assert len(known["directions"]) == len(known["eigenvalues"]) == 8
    for name in ("alpha1", "alpha4", "alpha7"):  # a doublet moves one axis at a time: products of rates are 0
        assert f"{name}: not identifiable: not excited" in out
    assert "alpha2: below the noise floor: identifiable below" in out
    assert "alpha3:" not in out
    refused(run("identifiability", "missing.csv"), "missing.csv")


def test_intervals_grow_with_the_noise(run, tmp_path):
    stds = {}
    for scale in ("1", "10"):
        simulate(run, "flight.csv", "--noise", scale, "--duration", "5")
        assert run("estimate", "flight.csv", "--out", "e.json")[0] == 0
        stds[scale] = json.loads((tmp_path / "e.json").read_text())["parameters"]["alpha3"]["std"]
    assert stds["10"] / stds["1"] == pytest.approx(10, rel=0.2)


def test_brackets_channels_and_initial_state(run, tmp_path):
    simulate(run)
    (tmp_path / "bracket.toml").write_text("alpha3 = [100, 140]\n")
    code, out, err = run(
        "estimate", "flight.csv", "--bracket", "bracket.toml", "--channels", "rates", "--initial-state", "known"
    )
    assert code == 0, err
    assert "rates channels" in out


def test_a_flight_without_excitation_fails_with_a_message(run, tmp_path):
    simulate(run, "flight.csv", "--noise", "1")
    rows = list(csv.reader((tmp_path / "flight.csv").read_text().splitlines()))
    rest = [",".join([row[0], *["225.67789"] * 4, *row[5:]]) for row in rows[1:]]
    (tmp_path / "hover.csv").write_text("\n".join([",".join(rows[0]), *rest]) + "\n")
    code, _, err = run("estimate", "hover.csv", "--channels", "rates", "--out", "e.json")
    assert code == 1
    assert err.startswith("jaxos4: ")
    assert json.loads((tmp_path / "e.json").read_text())["result"] in err


# `test_flight_csv.py` has all kinds of bad files.
BAD_FILES = {
    "empty": ("", ["empty"]),
    "text": ("t,omega1,omega2,omega3,omega4,p\n0,1,1,1,1,0\n0.1,1,abc,1,1,0\n", ["row 3", "omega2"]),
    "degrees": ("t,omega1,omega2,omega3,omega4,p\n0,1,1,1,1,0\n1,1,1,1,1,90\n", ["row 3", "p", "57.3"]),
}


@pytest.mark.parametrize(("text", "fragments"), BAD_FILES.values(), ids=BAD_FILES)
def test_bad_flights_are_refused_in_one_line(run, tmp_path, text, fragments):
    (tmp_path / "bad.csv").write_text(text)
    refused(run("estimate", "bad.csv", "--out", "e.json"), "bad.csv", *fragments)
    assert [path.name for path in tmp_path.iterdir()] == ["bad.csv"]


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["estimate", "none.csv"], ["none.csv"]),
        (["estimate", "."], ["."]),
        (["estimate", "flight.csv", "--airframe", "none"], ["none", "os4"]),
        (["estimate", "flight.csv", "--airframe", "bad.toml"], ["bad.toml"]),
        (["estimate", "flight.csv", "--airframe", "."], ["."]),
        (["estimate", "flight.csv", "--bracket", "bad.toml"], ["bad.toml"]),
        (["estimate", "flight.csv", "--bracket", "none.toml"], ["none.toml"]),
        (["estimate", "flight.csv", "--bracket", "swapped.toml"], ["swapped.toml", "alpha3"]),
        (["estimate", "flight.csv", "--bracket", "unknown.toml"], ["unknown.toml", "alpha9"]),
        (["estimate", "flight.csv", "--out", "none/e.json"], ["none/e.json"]),
        (["estimate", "flight.csv", "--out", "."], ["."]),
        (["estimate", "flight.csv", "--out", "flight.csv"], ["flight.csv", "overwrite"]),
        (["estimate", "flight.csv", "--airframe", "deep.toml"], ["deep.toml"]),
        (["estimate", "flight.csv", "--airframe", "long.toml"], ["long.toml"]),
        (["estimate", "flight.csv", "--bracket", "deep.toml"], ["deep.toml"]),
        (["estimate", "flight.csv", "--bracket", "huge.toml"], ["huge.toml", "alpha1"]),
        (["estimate", "positions.csv"], ["positions.csv", "rates"]),
        (["simulate", "--airframe", "tiny.toml", "--out", "new.csv"], ["tiny.toml", "inertia"]),
        (["estimate", "rates.csv", "--channels", "all"], ["rates.csv", "--channels"]),
        (["estimate", "flight.csv", "--estimator", "rls", "--channels", "all"], ["--channels", "rls"]),
        (["estimate", "rates.csv", "--estimator", "svsf"], ["rates.csv", "p, q and r"]),
        (["estimate", "flight.csv", "--estimator", "kalman", "--window", "1"], ["--window", "kalman"]),
        (["estimate", "flight.csv", "--window", "0"], ["--window", "positive"]),
        (["estimate", "flight.csv", "--window", "nan"], ["--window", "positive"]),
        (["estimate", "flight.csv", "--window", "0.01"], ["--window", "flight.csv"]),
        (["estimate", "flight.csv", "--window", "1e-320"], ["--window", "flight.csv"]),
        (["estimate", "flight.csv", "--estimator", "hybrid", "--window", "1", "--network", "x.net"], ["--window"]),
        (["estimate", "places.csv", "--window", "0.1"], ["places.csv", "phi, theta, psi", "--channels rates"]),
        (["estimate", "short.csv"], ["short.csv", "6 measurements for 11 unknowns"]),
        (["estimate", "flight.csv", "--window", "1", "--initial-state", "known"], ["--window", "free"]),
        (["estimate", "flight.csv", "--validate", "none.csv"], ["none.csv"]),
        (["estimate", "flight.csv", "--validate", "positions.csv"], ["positions.csv", "rates"]),
        (["estimate", "rates.csv", "--channels", "rates", "--validate", "angles.csv"], ["angles.csv", "rates"]),
        (["estimate", "flight.csv", "--validate", "flight.csv", "--out", "flight.csv"], ["flight.csv", "overwrite"]),
        (["identifiability", "flight.csv", "--out", "flight.csv"], ["flight.csv", "overwrite"]),
        (
            ["estimate", "rates.csv", "--channels", "rates", "--initial-state", "known"],
            ["rates.csv", "first sample", "r"],
        ),
        (["simulate", "--out", "none/flight.csv"], ["none/flight.csv"]),
        (["simulate", "--out", "new.csv", "--duration", "-1"], ["duration"]),
        (["simulate", "--out", "new.csv", "--duration", "nan"], ["duration"]),
        (["simulate", "--out", "new.csv", "--dt", "0"], ["dt"]),
        (["simulate", "--out", "new.csv", "--noise", "-1"], ["noise"]),
        (["simulate", "--out", "new.csv", "--noise", "inf"], ["noise"]),
        (["simulate", "--out", "new.csv", "--seed", str(10**30)], ["seed"]),
        (["simulate", "--out", "new.csv", "--duration", "1e12"], ["duration"]),
    ],
)
def test_bad_arguments_are_refused_in_one_line(run, tmp_path, arguments, fragments):
    simulate(run)
    lines = [f"{0.1 * i:g},1,1,1,1,0,0" for i in range(20)]
    (tmp_path / "rates.csv").write_text("\n".join(["t,omega1,omega2,omega3,omega4,p,q", *lines, ""]))
    (tmp_path / "bad.toml").write_text("mass = = 3\n")
    (tmp_path / "swapped.toml").write_text("alpha3 = [140, 100]\n")
    (tmp_path / "unknown.toml").write_text("alpha9 = [1, 2]\n")
    (tmp_path / "deep.toml").write_text("x = " + "[" * 5000 + "]" * 5000 + "\n")
    (tmp_path / "long.toml").write_text("mass = 1" + "0" * 5000 + "\n")
    (tmp_path / "huge.toml").write_text("alpha1 = [0, 1" + "0" * 400 + "]\n")
    (tmp_path / "positions.csv").write_text("t,omega1,omega2,omega3,omega4,x\n0,1,1,1,1,0\n0.1,1,1,1,1,0\n")
    lines = [f"{0.1 * i:g},1,1,1,1,0" for i in range(20)]
    (tmp_path / "angles.csv").write_text("\n".join(["t,omega1,omega2,omega3,omega4,phi", *lines, ""]))
    (tmp_path / "short.csv").write_text("t,omega1,omega2,omega3,omega4,p,q,r\n0,1,1,1,1,0,0,0\n0.1,1,1,1,1,0,0,0\n")
    lines = [f"{0.01 * i:g},220,220,220,220,0,0,0,0" for i in range(50)]
    (tmp_path / "places.csv").write_text("\n".join(["t,omega1,omega2,omega3,omega4,p,q,r,z", *lines, ""]))
    (tmp_path / "tiny.toml").write_text(
        "mass = 0.65\ninertia = [1e-320, 1e-320, 1e-320]\narm = 0.23\nthrust_coefficient = 3e-5\n"
        "drag_coefficient = 7e-7\nrotor_inertia = 6e-5\n"
    )
    before = sorted(path.name for path in tmp_path.iterdir())
    refused(run(*arguments), *fragments)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("estimate x.csv --model none", "'published', 'corrected'"),
        ("simulate", "'--out'; see `jaxos4 simulate --help`"),
        ("simulate --out x.csv --duration five", "'--duration'"),
        ("simulate --out x.csv y.csv", "y.csv"),
        ("export x.json --to none", "'none' is not one of 'mujoco', 'rotorpy', 'sdf'"),
        ("simulate --frob", "--frob; see `jaxos4 simulate --help`"),
        ("none", "'none'; see `jaxos4 --help`"),
    ],
)
def test_bad_usage_is_refused_in_one_line(run, line, said):
    refused(run(*line.split()), said)


def test_without_arguments_the_help_is_shown(run):
    code, out, err = run()
    assert code == 2
    assert "identifiability" in out + err


@pytest.mark.parametrize("command", ["simulate", "design", "estimate"])
def test_the_help_shows_each_text_whole(run, command):
    """Units stand in brackets, which are easily taken for markup."""
    code, out, _ = run(command, "--help")
    assert code == 0
    texts = [vars(option)["help"] for option in typer.main.get_group(_app.app).commands[command].params]
    assert len(texts) > 10
    assert all("".join(text.split()) in "".join(out.split()) for text in texts)


def test_a_failing_estimate_keeps_an_older_file(run, tmp_path):
    (tmp_path / "e.json").write_text("older")
    (tmp_path / "bad.csv").write_text("t\n")
    refused(run("estimate", "bad.csv", "--out", "e.json"), "bad.csv")
    assert (tmp_path / "e.json").read_text() == "older"


def test_a_flight_that_ends_in_a_singularity_is_not_written(run, tmp_path):
    code, _, err = run("simulate", "--model", "corrected", "--duration", "120", "--out", "flight.csv")
    assert code == 1
    assert err.startswith("jaxos4: attitude_singularity")
    assert not (tmp_path / "flight.csv").exists()


def test_a_real_flight_is_read_and_fitted(run, tmp_path, shared_flights):
    (tmp_path / "crazyflie.toml").write_text(
        "mass = 0.027\ninertia = [1.6e-5, 1.7e-5, 2.9e-5]\nthrust_coefficient = 2.4e-8\ndrag_coefficient = 1.2e-10\n"
        "rotor_inertia = 2e-8\nmax_rotor_speed = 2500\n"
        "rotor_positions = [[0.028, -0.028], [-0.028, -0.028], [-0.028, 0.028], [0.028, 0.028]]\n"
    )
    flight = shared_flights / "arpl_crazyflie_yaw_b.csv"
    code, out, err = run(
        "estimate", str(flight), "--airframe", "crazyflie.toml", "--model", "corrected", "--out", "e.json"
    )
    report = json.loads((tmp_path / "e.json").read_text())
    assert "resampled" in out
    assert code == (report["result"] != "successful")
    assert np.all([row["estimate"] is None or np.isfinite(row["estimate"]) for row in report["parameters"].values()])
    # The model lacks this vehicle's offsets and lag: the page or the result says so.
    assert "are not white noise" in " ".join(out.split()) or "No estimate" in out


# Networks.


@pytest.fixture(scope="module")
def network_file(tmp_path_factory):
    """A small network for the standard flight, and that flight."""
    folder = tmp_path_factory.mktemp("network")
    small = functools.partial(NetworkEstimator, width=32, depth=2, batch=64, held_out=4000)
    flight, network = folder / "flight.csv", folder / "flight.net"
    for arguments in (
        ["simulate", "--noise", "1", "--out", str(flight)],
        ["train", str(flight), "--steps", "1000", "--out", str(network)],
    ):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("jaxos4.networks.NetworkEstimator", small)
            patch.setattr(sys, "argv", ["jaxos4", *arguments])
            with pytest.raises(SystemExit) as stop:
                main()
        assert not stop.value.code
    return network, flight


@pytest.mark.parametrize("estimator", ["network", "hybrid"])
def test_a_trained_network_identifies_other_flights_of_its_inputs(run, tmp_path, network_file, estimator):
    simulate(run, "other.csv", "--noise", "2", "--seed", "5", "--duration", "5")
    options = ("--estimator", estimator, "--network", str(network_file[0]))
    code, out, err = run("estimate", "other.csv", *options, "--out", "estimate.json")
    assert code == 0, err
    assert f"{estimator}, published model" in out
    report = json.loads((tmp_path / "estimate.json").read_text())
    assert (report["estimator"], report["result"]) == (estimator, "successful")
    for name, row in report["parameters"].items():
        assert abs(row["estimate"] - TRUTH.get(name, 0.0)) < 4.5 * row["std"]
        assert row["std"] >= 0.7 * row["bound"]


def test_networks_of_another_problem_are_refused(run, tmp_path, network_file):
    network, flight = (str(path) for path in network_file)
    simulate(run, "chirp.csv", "--excitation", "chirp", "--duration", "5")
    with_network = ("--estimator", "network", "--network", network)
    refused(run("estimate", "chirp.csv", *with_network), "chirp.csv", "another series of rotor speeds", "jaxos4 train")
    refused(run("estimate", flight, *with_network, "--model", "corrected"), "PublishedOS4, not CorrectedOS4")
    refused(run("estimate", flight, *with_network, "--airframe", "voos"), "another airframe")
    refused(run("estimate", flight, "--network", network), "--network", "ibss uses none")
    refused(run("estimate", flight, "--estimator", "network", "--network", flight), "not a whole network file")
    refused(run("estimate", flight, "--estimator", "network", "--network", "none.net"), "none.net", "No such file")
    (tmp_path / "bracket.toml").write_text("alpha1 = [-1.0, 0.0]\n")
    refused(run("estimate", flight, *with_network, "--bracket", "bracket.toml"), "--bracket")
    refused(run("estimate", flight, *with_network, "--out", network), "would overwrite an input")


def test_impossible_training_is_refused_and_writes_nothing(run, tmp_path, network_file):
    flight = str(network_file[1])
    refused(run("train", flight, "--out", "a.net", "--steps", "0"), "`steps` must be", "at least 1")
    refused(run("train", flight, "--out", "a.net", "--noise", "2", "1"), "`noise` must be (lowest, highest)")
    refused(run("train", flight, "--out", "a.net", "--seed", "-1"), "--seed")
    refused(run("train", flight, "--out", flight), "would overwrite an input")
    refused(run("train", flight, "--out", "missing/a.net"), "no such folder")
    both = ("--features", "raw", "--approximator", "cmac")
    refused(run("train", flight, "--out", "a.net", *both), "`approximator`", "score")
    assert not list(tmp_path.iterdir())
