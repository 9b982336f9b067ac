"""The command line: output, files and exit codes, for good and for bad input."""

import csv
import functools
import json
import math
import pathlib
import re
import sys

import pytest
import typer
from helpers import CRAZYFLIE_TOML, output_of, refused
from pages import without_matplotlib, words
from synthetic_results import vehicle_result

import jaxos4
from jaxos4.cli import main, options
from jaxos4.cli._app import app
from jaxos4.cli._shared import console
from jaxos4.networks import NetworkEstimator

TRUTH = {"alpha1": -0.73333333, "alpha3": 133.33333, "alpha4": 0.73333333, "alpha6": 133.33333, "alpha8": 76.923077}


def simulate(run, path="flight.csv", *options: str) -> None:
    output_of(run("simulate", "--duration", "2", "--out", str(path), *options))


def estimate(run, *options):
    """`jaxos4 estimate flight.csv`: its exit code, its words, the end of its error output, and the JSON."""
    code, out, err = run("estimate", "flight.csv", *options, "--out", "e.json")
    return code, " ".join(out.split()), err, json.loads(pathlib.Path("e.json").read_text())


def test_simulate_writes_the_standard_flight(run, tmp_path):
    out = output_of(run("simulate", "--out", "flight.csv"))
    assert "501 samples" in out
    rows = list(csv.DictReader((tmp_path / "flight.csv").read_text().splitlines()))
    assert len(rows) == 501
    omega = [float(row[f"omega{i}"]) for row in rows for i in range(1, 5)]
    assert (math.floor(min(omega)), math.floor(max(omega))) == (134, 289)
    assert all(float(rows[0][name]) == 0 for name in ("x", "vz", "phi", "p"))
    # The seed determines the noise.
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        simulate(run, f"{name}.csv", "--noise", "1", "--seed", seed)
    a, b, c = ((tmp_path / f"{name}.csv").read_bytes() for name in "abc")
    assert (a == b, a == c) == (True, False)


def test_estimate_recovers_the_truth_within_its_intervals(run, monkeypatch):
    simulate(run, "flight.csv", "--noise", "1")
    without_matplotlib(monkeypatch)
    code, out, err, report = estimate(run, "--report", "e.html")
    assert code == 0, err
    page = words(pathlib.Path("e.html").read_text(encoding="utf-8"))
    assert all(said in page for said in ("Physical quantities", "Measured, predicted, residual", "Residuals"))
    assert {"estimator", "model", "result", "rollouts", "cost", "seconds", "parameters", "fit"} <= report.keys()
    assert pathlib.Path("e.json").read_text().count('"ci95": [-') > 1  # a list of numbers is one line
    assert (report["estimator"], report["model"], report["result"]) == ("ibss", "published", "successful")
    assert list(report["parameters"]) == [f"alpha{i}" for i in range(1, 9)]
    for name, row in report["parameters"].items():
        assert {"estimate", "std", "bound", "ci95", "unit", "noise_limit", "note", "bracket"} == row.keys()
        assert row["ci95"][0] < row["estimate"] < row["ci95"][1]
        assert abs(row["estimate"] - TRUTH.get(name, 0.0)) < 4 * row["std"]
        assert name in out
    for name in ("alpha2", "alpha5"):  # 6e-9, far below the noise
        assert report["parameters"][name]["note"] == "below noise"
    assert "residuals white (Ljung-Box), tests at 1 %: all" in out
    for row in report["fit"].values():
        assert row["percent"] > 85
        assert abs(row["correlation"]) < 0.3
    # The noise levels were estimated: they are the standard sensor's, within 4 standard errors of 200 samples.
    assert report["fit"]["p"]["rms"] == pytest.approx(0.01, rel=4 / math.sqrt(2 * 200))
    # Ten times the noise makes the intervals ten times as wide.
    std = report["parameters"]["alpha3"]["std"]
    simulate(run, "flight.csv", "--noise", "10")
    assert estimate(run)[3]["parameters"]["alpha3"]["std"] / std == pytest.approx(10, rel=0.2)
    simulate(run)
    pathlib.Path("bracket.toml").write_text("alpha3 = [100, 140]\n")
    code, out, err, _ = estimate(run, "--bracket", "bracket.toml", "--channels", "rates", "--initial-state", "known")
    assert (code, "rates channels" in out) == (0, True), err


def test_windows_and_validation(run):
    simulate(run, "flight.csv", "--noise", "1")
    simulate(run, "other.csv", "--noise", "1", "--seed", "1", "--excitation", "doublet", "--duration", "5")
    code, out, err, report = estimate(run, "--channels", "rates", "--window", "0.5", "--validate", "other.csv")
    assert code == 0, err
    assert "validation on other.csv" in out
    assert "residuals free of the inputs (cross-correlation), tests at 1 %: all" in out
    assert "Ljung-Box" not in out  # the initial state of each window correlates its residuals
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


def test_identifiability_names_the_parameters_that_are_not_excited(run, tmp_path):
    simulate(run, "flight.csv", "--noise", "1", "--excitation", "doublet", "--duration", "5")
    code, out, err = run("identifiability", "flight.csv", "--channels", "rates", "--out", "known.json")
    assert code == 0, err
    known = json.loads((tmp_path / "known.json").read_text())
    assert known["fitted"]
    assert known["sigma"]["p"] == pytest.approx(0.01, rel=0.2)
    assert len(known["directions"]) == len(known["eigenvalues"]) == 8
    of, rows = known["parameters"], {line.split()[0]: line for line in out.splitlines() if line.startswith("alpha")}
    # A doublet moves one axis at a time: products of rates are 0.
    assert [name for name, row in rows.items() if "not identifiable" in row] == ["alpha1", "alpha4", "alpha7"]
    assert (of["alpha1"]["note"], of["alpha3"]["note"]) == ("not identifiable: not excited", "")
    assert of["alpha3"]["bound"] < of["alpha3"]["half_width"]
    assert of["alpha2"]["note"].startswith("below the noise floor: can be distinguished from 0 below")
    assert "below the noise" in rows["alpha2"]


def test_a_flight_without_excitation_or_that_ends_in_a_singularity_fails_with_a_message(run, tmp_path):
    simulate(run, "flight.csv", "--noise", "1")
    header, *rows = csv.reader((tmp_path / "flight.csv").read_text().splitlines())
    rows = [header, *([row[0], *["225.67789"] * 4, *row[5:]] for row in rows)]
    (tmp_path / "flight.csv").write_text("\n".join(map(",".join, rows)) + "\n")
    code, _, err, report = estimate(run, "--channels", "rates")
    assert (code, report["result"] in err, err.startswith("jaxos4: ")) == (1, True, True)
    code, _, err = run("simulate", "--model", "corrected", "--duration", "120", "--out", "long.csv")
    assert (code, err[:28], (tmp_path / "long.csv").exists()) == (1, "jaxos4: attitude_singularity", False)


def samples(names, values, count, dt):
    """A log with rotor speeds of `values[0]`, and constants in the columns `names`."""
    lines = [",".join([f"{dt * i:g}", *[values[0]] * 4, *values[1:]]) for i in range(count)]
    return "\n".join([f"t,omega1,omega2,omega3,omega4,{names}", *lines, ""])


INPUTS = {
    "rates.csv": samples("p,q", "100", 20, 0.1),
    "angles.csv": samples("phi", "10", 20, 0.1),
    "positions.csv": samples("x", "10", 2, 0.1),
    "short.csv": samples("p,q,r", "1000", 2, 0.1),
    "places.csv": samples("p,q,r,z", ("220", "0", "0", "0", "0"), 50, 0.01),
    "text.csv": "t,omega1,omega2,omega3,omega4,p\n0,1,1,1,1,0\n0.1,1,abc,1,1,0\n",
    "bad.toml": "mass = = 3\n",
    "swapped.toml": "alpha3 = [140, 100]\n",
    "long.toml": "mass = 1" + "0" * 5000 + "\n",
    "tiny.toml": "mass = 0.65\ninertia = [1e-320, 1e-320, 1e-320]\narm = 0.23\nthrust_coefficient = 3e-5\n"
    "drag_coefficient = 7e-7\nrotor_inertia = 6e-5\n",
}
CLOSED, EXPORT = "simulate --out new.csv --closed-loop", "export found.json --to mujoco"
DESIGN = "design --out new.csv --initial-state known"
REFERENCES = "design --out new.csv --closed-loop --airframe mine.toml"
OUT_OF_RANGE = ("gust -1", "lag nan", "delay 5", "load-sag 2", "gyro-cutoff 0", "log-every 0")
# A command line, and what its message names. `test_flight_csv.py` has all kinds of bad flights.
REFUSED = {
    "estimate none.csv": ["none.csv"],
    "estimate .": ["."],
    "estimate text.csv": ["text.csv", "row 3", "omega2"],
    "estimate positions.csv": ["positions.csv", "rates"],
    "estimate short.csv": ["short.csv", "6 measurements for 11 unknowns"],
    "estimate flight.csv --airframe none": ["none", "os4"],
    "estimate flight.csv --airframe long.toml": ["long.toml"],
    "estimate flight.csv --bracket bad.toml": ["bad.toml"],
    "estimate flight.csv --bracket swapped.toml": ["--bracket swapped.toml: ", "alpha3"],
    "estimate flight.csv --out none/e.json": ["none/e.json"],
    "estimate flight.csv --out .": ["."],
    "estimate flight.csv --out flight.csv": ["flight.csv", "overwrite"],
    "estimate flight.csv --validate flight.csv --out flight.csv": ["flight.csv", "overwrite"],
    "estimate flight.csv --estimator rls --channels all": ["--channels", "rls"],
    "estimate flight.csv --estimator kalman --window 1": ["--window", "kalman"],
    "estimate flight.csv --estimator hybrid --window 1 --network x.net": ["--window"],
    "estimate flight.csv --window 0": ["--window", "positive"],
    "estimate flight.csv --window 0.01": ["--window", "flight.csv"],
    "estimate flight.csv --window 1 --initial-state known": ["--window", "free"],
    "estimate flight.csv --validate none.csv": ["none.csv"],
    "estimate rates.csv --channels all": ["rates.csv", "--channels"],
    "estimate rates.csv --estimator svsf": ["rates.csv", "p, q and r"],
    "estimate rates.csv --channels rates --validate angles.csv": ["angles.csv", "rates"],
    "estimate rates.csv --channels rates --initial-state known": ["rates.csv", "first sample", "r"],
    "estimate places.csv --window 0.1": ["places.csv", "phi, theta, psi", "--channels rates"],
    "estimate flight.csv --estimator network --network flight.csv": ["not a whole network file"],
    "estimate flight.csv --estimator network --network none.net": ["none.net", "No such file"],
    "identifiability flight.csv --out flight.csv": ["flight.csv", "overwrite"],
    "simulate --airframe tiny.toml --out new.csv": ["tiny.toml", "inertia"],
    "simulate --out none/flight.csv": ["none/flight.csv"],
    "simulate --out new.csv --duration -1": ["duration"],
    "simulate --out new.csv --duration 1e12": ["duration"],
    "simulate --out new.csv --seed 1" + "0" * 30: ["seed"],
    "train flight.csv --out a.net --steps 0": ["--steps must be", "at least 1"],
    "train flight.csv --out a.net --seed -1": ["--seed"],
    "train flight.csv --out a.net --features raw --architecture cmac": ["--architecture", '--features "score"'],
    "train flight.csv --out flight.csv": ["would overwrite an input"],
    "train flight.csv --out missing/a.net": ["no such folder"],
    "estimate x.csv --model none": ["'published', 'corrected'"],
    "simulate": ["'--out'; see `jaxos4 simulate --help`"],
    "simulate --out x.csv --duration five": ["'--duration'"],
    "simulate --out x.csv y.csv": ["y.csv"],
    "simulate --frob": ["--frob; see `jaxos4 simulate --help`"],
    "none": ["'none'; see `jaxos4 --help`"],
    "inspect log --out log": ["would overwrite an input"],
    "inspect log --airframe nothing.toml": ["nothing.toml"],
    "inspect log --airframe-out log": ["would overwrite an input"],
    "inspect log --out a --airframe-out a": ["--out and --airframe-out name one file"],
    "inspect log --airframe-out none/mine.toml": ["none/mine.toml"],
    "inspect log --airframe-out log2 --airframe os4": ["leave out --airframe"],
    "inspect log --airframe-out mine.toml": ["mine.toml: exists"],
    **{f"{CLOSED} --{option}": [f"--{option.split()[0]}"] for option in OUT_OF_RANGE},
    f"{CLOSED} --duration -1": ["duration"],
    f"{CLOSED} --dt 0": ["dt"],
    f"{CLOSED} --duration 0.001": ["at least two samples"],
    f"{CLOSED} --sensors commands": ["--sensors", "os4", "max_rotor_speed"],
    f"{CLOSED} --excitation chirp": ["--excitation", "leave it out"],
    f"{CLOSED} --noise 1": ["--noise", "leave it out"],
    "simulate --out new.csv --gust 3": ["--gust", "--closed-loop"],
    "simulate --out new.csv --sensors speeds": ["--sensors", "--closed-loop"],
    f"{DESIGN} --duration 0": ["--duration", "50 to 2500 samples"],
    f"{DESIGN} --duration 2 --fastest 150": ["cannot hover", "225.7"],
    f"{DESIGN} --duration 2 --rate -1": ["--rate", "0.001 to 1000"],
    f"{DESIGN} --slew 1e-300": ["--slew", "0.001 to 1e+08"],
    f"{DESIGN} --accuracy 0": ["--accuracy"],
    f"{DESIGN} --bandwidth 100": ["--bandwidth", "0.2 to 25 Hz"],  # by default 5 s, sampled every 0.01 s
    f"{DESIGN} --out new.svg --figure new.svg": ["--out and --figure name one file"],
    f"{DESIGN} --figure new.png": ["--figure new.png", ".svg"],
    f"{DESIGN} --gust 5": ["--gust", "with --closed-loop; add that"],
    f"{REFERENCES} --duration 1000": ["--duration", "250 to 20000 samples"],
    f"{REFERENCES} --velocity 1e8": ["--velocity", "0.001 to 1000"],
    f"{REFERENCES} --distance 1e-9": ["--distance", "0.001 to 100000"],
    f"{REFERENCES} --angle 2": ["--angle", "at most 1"],
    f"{REFERENCES} --fastest 300": ["cannot hover"],
    f"{REFERENCES} --slew 5": ["--slew", "without --closed-loop"],
    f"{REFERENCES} --channels rates": ["--channels", "without --closed-loop"],
    f"{REFERENCES} --sensors commands --airframe os4": ["--sensors", "max_rotor_speed"],
    f"{EXPORT} --samples 2": ["--samples", "--out"],
    f"{EXPORT} --samples -1 --out vehicle.xml": ["--samples: must be an integer of at least 0", "-1"],
    f"{EXPORT} --samples 100001 --out vehicle.xml": ["--samples", "at most 100000"],
    f"{EXPORT} --seed -1": ["--seed", "-1"],
    f"{EXPORT} --out found.json": ["would overwrite an input"],
    f"{EXPORT} --out nowhere/vehicle.xml": ["nowhere/vehicle.xml", "no such folder"],
    f"{EXPORT} --out . --samples 2": [".: holds ", "give another folder"],
    f"{EXPORT} --out flight.csv --samples 2": ["flight.csv: is no folder"],
    f"{EXPORT} --out new.xml --samples 2": ["--out new.xml: with --samples, this is a folder"],
    f"{EXPORT} --out nowhere/vehicles --samples 2": ["nowhere/vehicles", "no such folder"],
    f"{EXPORT} --to gazebo": ["'gazebo' is not one of 'mujoco', 'rotorpy', 'sdf'"],
    "export none.json --to sdf": ["none.json", "give a path"],
    "report .": ["jaxos4: .: holds no results.nc; give a folder that `jaxos4 study` wrote.\n"],
    "report ..": ["jaxos4: ..: holds no results.nc; give a folder that `jaxos4 study` wrote.\n"],
    "predict r.json f.csv --horizon 1e300": ["jaxos4: --horizon: must lie within +-1e+09, got 1e+300.\n"],
    "predict r.json f.csv --spacing 1e300": ["jaxos4: --spacing: must lie within +-1e+09, got 1e+300.\n"],
    "design --out i.csv --slowest 1e300": ["jaxos4: --slowest: must lie within +-1e+09, got 1e+300.\n"],
    "simulate --out f.csv --duration 1e300": ["jaxos4: --duration: must lie within +-1e+09, got 1e+300.\n"],
    "estimate f.csv --end -1e300": ["jaxos4: --end: must lie within +-1e+09, got -1e+300.\n"],
    "train f.csv --out n.npz --noise 1 inf": ["jaxos4: --noise: must lie within +-1e+09, got inf.\n"],
    "export r.json --to urdf --samples 10000000000": ["jaxos4: --samples: must lie within +-1e+09, got 1e+10.\n"],
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder with a flight and the files of `INPUTS`."""
    folder = tmp_path_factory.mktemp("inputs")
    model = jaxos4.PublishedOS4()
    omega = jaxos4.multisine(model.airframe, duration=2.0, dt=0.01)
    jaxos4.write_flight(jaxos4.simulate(model, model.alpha, omega, dt=0.01), folder / "flight.csv")
    others = {"mine.toml": CRAZYFLIE_TOML, "found.json": json.dumps(vehicle_result())}
    for name, text in (INPUTS | others).items():
        (folder / name).write_text(text)
    (folder / "log").write_text("nobody reads it")
    return folder


@pytest.mark.parametrize(("line", "fragments"), REFUSED.items(), ids=[line[:70] for line in REFUSED])
def test_a_mistake_is_refused_in_one_line_and_nothing_is_written(run, inputs, monkeypatch, line, fragments):
    monkeypatch.chdir(inputs)
    before = {path: path.stat().st_mtime_ns for path in inputs.iterdir()}
    refused(run(*line.split()), *fragments)
    assert {path: path.stat().st_mtime_ns for path in inputs.iterdir()} == before


def test_what_is_printed_names_options_as_they_are_typed(monkeypatch, capsys):
    monkeypatch.setattr(options, "ASKED", {"bracket": pathlib.Path("mine.toml"), "sample_time": None})
    console().print("give a wider `bracket`, or `sample_time` 0.01; check `mass`, `end`")
    assert capsys.readouterr().out == "give a wider --bracket, or --sample-time 0.01; check `mass`, `end`\n"
    assert options.as_typed("`bracket`: knows no `alpha9`") == "--bracket mine.toml: knows no `alpha9`"


def test_the_help_shows_each_text_whole(run):
    """Units stand in brackets, which are easily taken for markup. Without arguments the help is shown, too."""
    code, out, err = run()
    assert (code, "identifiability" in out + err) == (2, True)
    assert not re.search(r"\w\.\.\.", out + err)  # the list of commands has whole sentences
    for command in ("simulate", "design", "estimate"):
        code, out, _ = run(command, "--help")
        texts = [vars(option)["help"] for option in typer.main.get_group(app).commands[command].params]
        assert (code, len(texts) > 10) == (0, True)
        assert all("".join(text.split()) in "".join(out.split()) for text in texts)


@pytest.fixture(scope="module")
def network_file(tmp_path_factory):
    """A small network for the standard flight, and that flight."""
    folder = tmp_path_factory.mktemp("network")
    small = functools.partial(NetworkEstimator, width=32, depth=2, batch=64, held_out=4000)
    flight, network = folder / "flight.csv", folder / "flight.net"
    lines = f"simulate --noise 1 --out {flight}", f"train {flight} --steps 1000 --out {network}"
    for line in lines:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(jaxos4, "NetworkEstimator", small)
            patch.setattr(sys, "argv", ["jaxos4", *line.split()])
            with pytest.raises(SystemExit) as stop:
                main()
        assert not stop.value.code
    return network, flight


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["network", "hybrid"])
def test_a_trained_network_identifies_other_flights_of_its_inputs(run, network_file, estimator):
    simulate(run, "flight.csv", "--noise", "2", "--seed", "5", "--duration", "5")
    code, out, err, report = estimate(run, "--estimator", estimator, "--network", str(network_file[0]))
    assert (code, f"{estimator}, published model" in out) == (0, True), err
    assert (report["estimator"], report["result"]) == (estimator, "successful")
    for name, row in report["parameters"].items():
        assert abs(row["estimate"] - TRUTH.get(name, 0.0)) < 4.5 * row["std"]
        assert row["std"] >= 0.7 * row["bound"]


@pytest.mark.slow
def test_the_architecture_of_a_network_can_be_chosen(run, network_file, monkeypatch):
    """What `train` asks for. A network with tables of weights: `test_network.py`; its file: `test_hybrid.py`."""
    (network, flight), asked = map(str, network_file), []

    class Trained(NetworkEstimator):
        def fit(self, problem, bracket, *, key):
            asked.append((self.architecture, self.steps, problem.initial_state is None))
            return jaxos4.load_network(network)

    monkeypatch.setattr(jaxos4, "NetworkEstimator", Trained)
    options = ["--architecture", "cmac", "--steps", "5", "--initial-state", "known"]
    code, out, err = run("train", flight, *options, "--out", "flight.net")
    assert (code, "flight.net: cmac, score features of the rates" in out) == (0, True), err
    assert asked == [("cmac", 5, False)]


@pytest.mark.slow
def test_networks_of_another_problem_are_refused(run, tmp_path, network_file):
    network, flight = (str(path) for path in network_file)
    simulate(run, "chirp.csv", "--excitation", "chirp", "--duration", "5")
    with_network = ("--estimator", "network", "--network", network)
    refused(run("estimate", "chirp.csv", *with_network), "chirp.csv", "another series of rotor speeds", "jaxos4 train")
    refused(run("estimate", flight, *with_network, "--model", "corrected"), "PublishedOS4, not CorrectedOS4")
    refused(run("estimate", flight, *with_network, "--airframe", "voos"), "another airframe")
    refused(run("estimate", flight, "--network", network), "--network", "ibss uses none")
    (tmp_path / "bracket.toml").write_text("alpha1 = [-1.0, 0.0]\n")
    refused(run("estimate", flight, *with_network, "--bracket", "bracket.toml"), "--bracket bracket.toml: ")
    refused(run("estimate", flight, *with_network, "--out", network), "would overwrite an input")
