"""Each experiment runs in a small configuration, writes its results, and draws them."""

import json
import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest
from helpers import how_we_compile
from small_experiments import plot, result_of

from experiments import figures, shared
from experiments.__main__ import again, main, main_of, scripts
from experiments.closed_loop.run import print_cases
from experiments.published import RECORDER, read
from jaxos4.study import load_study, metrics, read_results

EXPERIMENTS = pathlib.Path(__file__).resolve().parents[1] / "experiments"


# The command line.


@pytest.mark.parametrize("arguments", [[], ["--help"]])
def test_usage(arguments, capsys):
    main(arguments)
    text = capsys.readouterr().out
    assert all(word in text for word in ("again NAME", "render", *scripts()))


@pytest.mark.parametrize(
    ("script", "texts"),
    [
        (
            "closed_loop.run",
            ["Number of flights", "Random seed of", "continued if it exists", "Names of the"],
        ),
        ("public_flights.run", ["Folder of the recorded flights", "up to this time", "written anew if it exists"]),
    ],
)
def test_help_describes_the_common_options(script, texts, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "250")
    main([script, "--help"])
    text = capsys.readouterr().out
    assert all(each in text for each in texts)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nosuch.run"], "nosuch.run: no such script; give one of"),
        (["again"], "again: no name; give names of files in"),
        (["again", "nosuch"], "nosuch: no such result in"),
        (["study.run", "nosuch.toml", "--out", "data"], "nosuch.toml"),
        (["efficiency.run", "--cases", "nosuch"], "--cases: no 'nosuch'; give one of published, all; "),
        (["defaults.run", "--settings", "nosuch"], "--settings: no 'nosuch'; give one of equation error, memory 0; "),
        (["closed_loop.run", "--references", "nosuch"], "--references: no 'nosuch'; give one of random; designed; "),
        *(
            ([script, *place, "--estimators", "filter-eror"], "--estimators: no 'filter-eror'; give one of ibss")
            for script, *place in (
                *(["baselines.run"], ["coverage.run"], ["long_flight.run"], ["precision.run"], ["real_flight.run"]),
                *(["closed_loop.run"], ["closed_loop.effects"], ["rotorpy.run", "flights"]),
            )
        ),
    ],
)
def test_mistake_is_one_line(arguments, message, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    text = capsys.readouterr().err
    assert end.value.code == 2
    assert message in text
    assert text.count("\n") == 1


def test_again_ends_with_the_failure_of_a_script(monkeypatch):
    monkeypatch.setattr("experiments.__main__.commands", lambda names: {name: ["nosuch.run"] for name in names})
    monkeypatch.setattr("subprocess.run", lambda *_, **__: subprocess.CompletedProcess([], 2))
    with pytest.raises(SystemExit) as end:
        again(["one"])
    assert end.value.code == 1


def test_case_whose_flights_are_all_refused_has_a_line():
    row = {"gust": 5.0, "references": "random", "estimator": "filter-error", "result": "refused"}
    print_cases("refused flights", [row, row])
    assert RECORDER.tables[-1].rows == [["5", "random", "filter-error", *[""] * 7, "2 refused"]]


# Studies: experiments with a specification.

STUDIES = ("comparison", "noise_study", "noise_kinds", "scale")  # those without a script of their own
OTHERS = ("frontier", "rollout_budget", "published_corrected", "inverse_crime", "bracket_and_seeds")


def small(name):
    """The small configuration of an experiment; three studies share that of the comparison."""
    return EXPERIMENTS / ("comparison" if name in ("noise_study", "scale") else name) / "small.toml"


def near(found, expected, errors):
    """Whether all numbers are within these errors."""
    return bool(np.all(np.abs(np.asarray(found) - expected) < errors))


@pytest.fixture
def run(tmp_path):
    """Runs and plots the small configuration of an experiment with a script."""

    def results(name, **options):
        main_of(f"{name}.run")(small(name), tmp_path / "out", **options)
        plot(tmp_path, name, results="out")
        return tmp_path / "out"

    return results


@pytest.mark.slow
@pytest.mark.parametrize("name", [*STUDIES, *OTHERS])
def test_configurations(name):
    """The full configuration is valid, and no smaller than the small one."""
    real, short = load_study(EXPERIMENTS / name / "study.toml"), load_study(small(name))
    assert real.count * real.batch >= short.count * short.batch
    assert (f"{name}.run" in scripts()) == (name not in STUDIES)


@pytest.mark.slow
def test_comparison_noise_study_and_scale(tmp_path):
    """One study of IBSS and equation error against the noise, and the figures of three experiments."""
    shared.run_studies({"out": load_study(small("comparison"))}, tmp_path)
    RECORDER.publish("small", ["study.run"], {}, tmp_path)
    assert [row[:3] for row in read("small", tmp_path).tables[-1].rows[:2]] == [
        ["out", "0.1", "ibss"],
        ["out", "0.1", "equation-error"],
    ]
    for name in ("noise_study", "scale", "comparison"):
        plot(tmp_path, name, results="out", suffixes=(".svg", ".pdf") if name == "comparison" else (".svg",))
    data = read_results(tmp_path / "out").squeeze()
    accuracy, error = metrics.accuracy(data), metrics.estimator_error(data)["absolute"].sel(estimator="ibss")
    # On the rates of one second both are at the bound, within chance: 8 parameters of 32 flights.
    assert near(accuracy.sel(scale=1.0), 1, 3 / np.sqrt(2 * 8 * 32))
    # Ten times the noise, ten times the error: the flights draw the same numbers.
    np.testing.assert_allclose(error.sel(scale=1.0) / error.sel(scale=0.1), 10, rtol=0.1)
    # At ten times the noise IBSS ends at its limits around the bracket.
    assert (accuracy.sel(scale=10.0, estimator="ibss") < accuracy.sel(scale=10.0, estimator="equation-error")).all()


@pytest.mark.slow
def test_noise_kinds(tmp_path):
    shared.run_studies({"out": load_study(small("noise_kinds"))}, tmp_path)
    plot(tmp_path, "noise_kinds", results="out")
    covered = metrics.mean_coverage(read_results(tmp_path / "out").squeeze()).sel(level=0.95)
    low, high = covered["low"].sel(noise="white"), covered["high"]
    # Without 10 % of the samples the errors are about 5 % larger, and the intervals too.
    assert float(low) < 0.95 < min(float(high.sel(noise=noise)) for noise in ("white", "lossy"))
    assert (covered["coverage"].sel(noise=["coloured", "biased"]) < low).all()


def test_frontier(run):
    frontier = shared.load_results(run("frontier"))["frontier"].squeeze()
    # The published gyroscopic terms are far below any sensor's noise, the corrected ones are not.
    published, corrected = (
        float(frontier.sel(parameter="alpha2", excitation="multisine", model=name)) for name in frontier["model"].values
    )
    assert published < 1e-4 < 1 < corrected
    # A doublet moves one axis at a time, so products of rates are not excited. alpha7 is 0.
    assert frontier.sel(excitation="doublet", parameter="alpha1").isnull().all()
    assert (frontier.sel(parameter="alpha7") == 0).all()


@pytest.mark.slow
def test_rollout_budget(run):
    data = shared.load_results(run("rollout_budget", limits=[1, 10])).squeeze()
    reached, (few, enough) = figures.accuracy(data), data["rollouts"].mean("flight").T
    # One sweep, or one step, of each stage is nearly as good as the complete search: the rates are nearly linear.
    assert (reached.isel(limit=0) < 1.2).all()
    assert (few < 0.7 * enough).all()
    assert near(reached.isel(limit=1), 1, 0.2)  # both minimise the same cost


@pytest.mark.slow
def test_published_corrected(run):
    data = shared.load_results(run("published_corrected")).squeeze()
    rms, rejected = (data["error"] ** 2).mean("flight") ** 0.5, (data["white_p"] < 0.01).mean("flight")
    # Each model is at the bound on its own flights, and the residuals are noise.
    for which in ({"flown": model, "fitted": model} for model in ("published", "corrected")):
        assert data["answered"].sel(which).all()
        assert near(rms.sel(which), 1, 0.6)
        assert float(rejected.sel(which)) < 0.2
    # The published model lacks a term of the corrected one, and its residuals show it.
    alien = {"flown": "corrected", "fitted": "published"}
    assert (float(rms.sel(alien).min()) > 2, float(rejected.sel(alien))) == (True, 1)
    # With alpha2 = alpha5 = 0 the corrected model equals the published one: only these two estimates are wrong.
    alien, wrong = {"flown": "published", "fitted": "corrected"}, ["alpha2", "alpha5"]
    assert float(rejected.sel(alien)) < 0.2
    assert rms.sel(alien).sel(parameter=wrong).min() > 10 > 2 > rms.sel(alien).drop_sel(parameter=wrong).max()


@pytest.mark.slow
def test_inverse_crime(run):
    out, bias = run("inverse_crime", fit_methods=["euler", "rk4"], dts=[0.01]), figures.bias
    euler, rk4 = (bias(read_results(out / f"{fit} 0.01 s")).squeeze() for fit in ("euler", "rk4"))
    assert float(euler.sel({"method": "rk4"})) > 8 * float(euler.sel({"method": "euler"}))
    assert float(rk4.sel({"method": "rk4"})) < float(euler.sel({"method": "rk4"})) / 8


@pytest.mark.slow
def test_bracket_and_seeds(run):
    data = read_results(run("bracket_and_seeds", seeds=[0]) / "seed 0").squeeze()
    rollouts, accuracy = metrics.mean_rollouts(data), metrics.accuracy(data)
    ibss, hybrid, network = ({"estimator": name} for name in ("ibss", "hybrid", "network"))
    assert float(rollouts.sel(ibss | {"width": 2.0})) > float(rollouts.sel(ibss | {"width": 0.5}))
    assert (rollouts.sel(hybrid) < rollouts.sel(ibss)).all()
    np.testing.assert_allclose(accuracy.sel(hybrid), accuracy.sel(ibss), rtol=0.05)
    # The rates are nearly linear in the parameters: the network loses little, and less in a narrower bracket.
    assert float(accuracy.sel(network | {"width": 0.5})) < min(1.5, float(accuracy.sel(network | {"width": 2.0})))


# Experiments that are scripts.

FLIGHTS = 128  # of most of them, so that they share programs


@pytest.mark.slow
def test_efficiency(tmp_path):
    case = "published, rates"
    (row,) = result_of(tmp_path, "efficiency", flights=FLIGHTS, seed=0, scale=1.0, cases=[case])["cases"]
    assert row["results"] == {"successful": FLIGHTS}
    # Within four Monte-Carlo standard errors of the bound, on each of the eight parameters.
    assert near(row["efficiency"], 1, 4 * row["monte_carlo_error"])
    assert near(row["bias"], 0, 4 / np.sqrt(FLIGHTS))
    assert near(row["covered"], 0.95, 4 * np.sqrt(0.95 * 0.05 / FLIGHTS))


@pytest.mark.slow
def test_speed(tmp_path):
    report = result_of(tmp_path, "speed", batch=64, repeats=2)
    assert report["provenance"]["precision"] == "float64"
    assert all(row["steps_per_second"] > 0 and row["min_seconds"] <= row["median_seconds"] for row in report["rows"])


@pytest.mark.slow
def test_networks(tmp_path):
    trained = {"networks": ["score, mlp", "score, cmac"], "channels": "rates", "separate": False}
    report = result_of(tmp_path, "networks", flights=FLIGHTS, seed=7, steps=100, noises=[1.0], **trained)
    rows = {row["estimator"]: row for row in report["rows"]}
    hybrids = [f"hybrid from {label}" for label in trained["networks"]]
    assert list(rows) == ["score, mlp", hybrids[0], "ibss", "score, cmac", hybrids[1]]
    # Each of eight parameters within five Monte-Carlo errors of the bound.
    assert all(near(rows[n]["efficiency"], 1, 5 * rows[n]["monte_carlo_error"]) for n in (*hybrids, "ibss"))
    assert all(rows[n]["rollouts"] < rows["ibss"]["rollouts"] and rows[n]["hit_rate"] > 0.9 for n in hybrids)


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_precision(tmp_path):
    """In a process of its own: JAX keeps the constants of a program in the precision of their first use."""
    # How far the answers of a flight may be apart, in bounds.
    most, out = dict.fromkeys(("kalman", "equation-error", "rls", "ibss"), 0.2), tmp_path / "out.json"
    most |= {"filter-error": 2.0}
    command = [sys.executable, "-m", "experiments", "precision.run", "--flights", "64", "--out", str(out)]
    options = [each for name in most for each in ("--estimators", name)]
    environment = os.environ | how_we_compile()  # its level of optimisation too
    subprocess.run([*command, *options], check=True, capture_output=True, cwd=EXPERIMENTS.parent, env=environment)
    report = json.loads(out.read_text())
    rows = {(row["estimator"], row["precision"]): row for row in report["rows"]}
    assert len(rows) == 2 * len(most)
    for name, largest in most.items():
        double, single = (rows[name, precision] for precision in ("float64", "float32"))
        assert double["largest_difference"] == 0 < single["largest_difference"] < largest
        assert double["results"] == single["results"] == {"successful": 64}
        assert near(single["covered"], 0.95, 4.5 * np.sqrt(0.95 * 0.05 / 64))
    assert all(near(rows[name, "float32"]["efficiency"], 1, 5 * np.sqrt(1 / 128)) for name in ("kalman", "ibss"))


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_baselines(tmp_path):
    cases = {"estimators": ["equation-error", "output-error"], "noises": ["white"], "scales": [0.0, 1.0]}
    rows = result_of(tmp_path, "baselines", flights=FLIGHTS, seed=5, channels="rates", **cases)["rows"]
    exact, noisy = rows[:2], rows[2:]
    assert all(row["answers"] == FLIGHTS for row in rows)
    assert all(max(row["efficiency"]) < 1e-6 for row in exact)
    # Known start: integrated equation error loses most in alpha2, 1.6 times the bound.
    assert max(noisy[1]["efficiency"]) < 1 + 5 * noisy[1]["monte_carlo_error"]
    assert max(noisy[0]["efficiency"]) < 1.6 + 8 * noisy[0]["monte_carlo_error"]


@pytest.mark.slow
def test_coverage(tmp_path):
    cases = {"model": "published", "channels": "rates", "estimators": ["ibss", "hybrid", "output-error"]}
    rows = result_of(tmp_path, "coverage", flights=FLIGHTS, seed=11, scales=[1.0], steps=100, **cases)["rows"]
    assert [row["estimator"] for row in rows] == cases["estimators"]
    for row in rows:
        assert row["results"] == {"successful": FLIGHTS}
        assert near(row["std"], 1, 0.05)  # the intervals are not too wide
        assert near(row["covered"] + row["constants_covered"], 0.95, 4.5 * np.sqrt(0.95 * 0.05 / FLIGHTS))


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_defaults(tmp_path):
    settings = ["equation error, memory 0", "equation error, memory 1 (default)", "ant colony, q 0.1"]
    rows = result_of(tmp_path, "defaults", flights=8, seed=7, settings=settings)["rows"]
    assert [(row["setting"], row["scale"]) for row in rows] == [
        (settings[0], 1.0),
        *((settings[1], scale) for scale in (0.1, 1.0, 10.0)),
        (settings[2], 1.0),
    ]
    assert max(rows[2]["efficiency"]) < max(rows[0]["efficiency"]) / 3
    assert rows[4]["results"] == {"successful": 8}
    assert 0 <= rows[4]["gap"] < 0.02  # its cost above that of output error


@pytest.mark.slow
def test_robust_intervals():
    """Those by the residuals hold the truth under coloured noise; those by the bound of white noise do not."""
    main_of("coverage.robust")(flights=16, seed=13)
    white, robust = (float(row[-1]) for row in RECORDER.tables[-1].rows)
    assert white < 70 < 80 < robust


@pytest.mark.slow
def test_times_of_commands(monkeypatch):
    monkeypatch.delenv("JAXOS4_FLIGHTS", raising=False)
    main_of("speed.commands")(repeats=1, commands=["simulate --help"])
    unit, (command, cold, again) = RECORDER.tables[-1].rows
    assert (unit[0], command) == ("import jax", "jaxos4 simulate --help")
    assert 0 < float(cold)
    assert again.count(again.split()[0]) == 3  # one run: median, least and most are one number
    with pytest.raises(SystemExit, match="missing.csv"):
        main_of("speed.commands")(repeats=1, commands=["estimate missing.csv"])


@pytest.mark.slow
def test_long_flight(tmp_path):
    """Windows follow a drift that one shot cannot. One shot ends at the bounds, and its result says so."""
    cases = {"duration": 20.0, "drifts": [1e-3], "windows": [1, 20], "estimators": ["ibss"]}
    one, many = result_of(tmp_path, "long_flight", flights=2, seed=3, **cases)["rows"]
    assert (one["results"], many["results"]) == ({"at_bound": 2}, {"successful": 2})
    assert max(many["percent"]) < 5
    assert max(many["percent"][place] for place in (1, 3, 4)) < 2  # the gains of the torques


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_public_flights(shared_flights, tmp_path):
    """One flight is identified, and another one predicted better than by constant velocity."""
    names = {"fitted": ["B8_star_fast_rep1"], "predicted": ["B8_star_fast_rep2"]}
    small = {"end": 15.0, "batches": 20, "gusts": [0.0, 8.0], "simulations": 1}
    report = result_of(tmp_path, "public_flights", flights=shared_flights, **small, **names)
    found = report["flights"]["B8_star_fast_rep2"]["quantities"]
    assert all(found[name]["sum"]["error"] < 0.7 * found[name]["sum"]["constant"] for name in ("position", "velocity"))
    assert all(found[rate]["error"][9] < found[rate]["constant"][9] for rate in "pq")
    assert all(len(found[rate]["network"]) == 50 for rate in "pq")
    # Without gusts the true vehicle predicts what is measured; with gusts the commands answer what it does not know.
    calm, gusty = (report["simulated"][gust] for gust in ("0", "8"))
    assert all(calm[rate]["share"][-1] > 0.9 and gusty[rate]["share"][-1] < 0.5 for rate in "pq")
    plot(tmp_path, "public_flights")
