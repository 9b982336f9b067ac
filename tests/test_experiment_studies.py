"""Each experiment that has the specification of a study runs in its small one, and draws the results."""

import numpy as np
import pytest
from small_experiments import EXPERIMENTS, load, load_results, plot, small, study

from jaxos4.report import read_results
from jaxos4.study import load_study, metrics

# The experiments that are a study without a script of their own.
STUDIES = ("comparison", "noise_study", "noise_kinds", "scale")
WITH_FIGURES = (*STUDIES, "frontier", "rollout_budget", "published_corrected", "inverse_crime", "bracket_and_seeds")


@pytest.mark.parametrize("name", WITH_FIGURES)
def test_configurations(name):
    """The full configuration is valid, and no smaller than the small one."""
    real, short = load_study(EXPERIMENTS / name / "study.toml"), load_study(small(name))
    assert real.count * real.batch >= short.count * short.batch
    assert (EXPERIMENTS / name / "run.py").exists() == (name not in STUDIES)


def test_comparison(tmp_path):
    data = study("comparison", tmp_path)
    accuracy = metrics.accuracy(data)
    # On the rates of one second both are at the bound, within chance: 8 parameters of 32 flights.
    assert (abs(accuracy.sel(scale=1.0) - 1) < 3 / np.sqrt(2 * 8 * 32)).all()
    # At ten times the noise IBSS ends at its limits around the bracket.
    assert (accuracy.sel(scale=10.0, estimator="ibss") < accuracy.sel(scale=10.0, estimator="equation-error")).all()


def test_noise_study(tmp_path):
    data = study("noise_study", tmp_path)
    error = metrics.estimator_error(data)["absolute"].sel(estimator="ibss")
    # Ten times the noise, ten times the error: the flights draw the same numbers.
    np.testing.assert_allclose(error.sel(scale=1.0) / error.sel(scale=0.1), 10, rtol=0.1)


def test_noise_kinds(tmp_path):
    data = study("noise_kinds", tmp_path)
    covered = metrics.mean_coverage(data).sel(level=0.95)
    assert float(covered["low"].sel(noise="white")) < 0.95 < float(covered["high"].sel(noise="white"))
    assert (covered["coverage"].sel(noise=["coloured", "biased"]) < covered["low"].sel(noise="white")).all()
    # Without 10 % of the samples the errors are about 5 % larger, and the intervals too.
    assert float(covered["high"].sel(noise="lossy")) > 0.95


def test_scale(tmp_path):
    data = study("scale", tmp_path)
    efficiency, covered = metrics.efficiency(data), metrics.mean_coverage(data).sel(level=0.95)["coverage"]
    # Each of eight parameters is within five Monte-Carlo errors of the bound.
    assert (abs(efficiency["efficiency"] - 1) < 5 / np.sqrt(2 * 128)).all()
    assert (abs(covered - 0.95) < 4.5 * np.sqrt(0.95 * 0.05 / 128)).all()


def test_frontier(tmp_path):
    load("frontier").main(small("frontier"), tmp_path / "out")
    plot("frontier", tmp_path / "out", tmp_path / "figures")
    frontier = load_results(tmp_path / "out")["frontier"].squeeze()
    # The published gyroscopic terms are far below any sensor's noise, the corrected ones are not.
    gyroscopic = frontier.sel(parameter="alpha2", excitation="multisine")
    assert float(gyroscopic.sel(model="published")) < 1e-4 < 1 < float(gyroscopic.sel(model="corrected"))
    # A doublet moves one axis at a time, so products of rates are not excited. alpha7 is 0.
    assert frontier.sel(excitation="doublet", parameter="alpha1").isnull().all()
    assert (frontier.sel(parameter="alpha7") == 0).all()


def test_rollout_budget(tmp_path):
    names = ["IBSS, whitened", "output error"]
    load("rollout_budget").main(small("rollout_budget"), tmp_path / "out", limits=[1, 10], names=names)
    plot("rollout_budget", tmp_path / "out", tmp_path / "figures")
    data = load_results(tmp_path / "out").squeeze()
    reached = load("rollout_budget", "plot").accuracy(data)
    assert (data["rollouts"].mean("flight").isel(limit=1) >= data["rollouts"].mean("flight").isel(limit=0)).all()
    # One sweep, or one step, of each stage is nearly as good as the complete search: the rates are nearly linear.
    assert (reached.isel(limit=0) < 1.2).all()
    assert (data["rollouts"].mean("flight").isel(limit=0) < 0.7 * data["rollouts"].mean("flight").isel(limit=1)).all()
    # Both minimise the same cost.
    np.testing.assert_allclose(reached.isel(limit=1), 1, atol=0.2)


def test_published_corrected(tmp_path):
    load("published_corrected").main(small("published_corrected"), tmp_path / "out")
    plot("published_corrected", tmp_path / "out", tmp_path / "figures")
    data = load_results(tmp_path / "out").squeeze()
    rms = (data["error"] ** 2).mean("flight") ** 0.5
    rejected = (data["white_p"] < 0.01).mean("flight")
    own = [{"flown": model, "fitted": model} for model in ("published", "corrected")]
    # Each model is at the bound on its own flights, and the residuals are noise.
    for which in own:
        assert data["answered"].sel(which).all()
        np.testing.assert_allclose(rms.sel(which), 1, atol=0.6)
        assert float(rejected.sel(which)) < 0.2
    # The published model lacks a term of the corrected one, and its residuals show it.
    alien = {"flown": "corrected", "fitted": "published"}
    assert float(rms.sel(alien).min()) > 2
    assert float(rejected.sel(alien)) == 1
    # With alpha2 = alpha5 = 0 the corrected model equals the published one: only these two estimates are wrong.
    alien = {"flown": "published", "fitted": "corrected"}
    assert float(rejected.sel(alien)) < 0.2
    assert (rms.sel(alien).sel(parameter=["alpha2", "alpha5"]) > 10).all()
    assert (rms.sel(alien).drop_sel(parameter=["alpha2", "alpha5"]) < 2).all()


def test_inverse_crime(tmp_path):
    load("inverse_crime").main(small("inverse_crime"), tmp_path / "out", fit_methods=["euler", "rk4"], dts=[0.01])
    plot("inverse_crime", tmp_path / "out", tmp_path / "figures")
    bias = load("inverse_crime", "plot").bias
    euler, rk4 = (bias(read_results(tmp_path / "out" / f"{fit} 0.01 s")).squeeze() for fit in ("euler", "rk4"))
    assert float(euler.sel({"method": "rk4"})) > 8 * float(euler.sel({"method": "euler"}))
    assert float(rk4.sel({"method": "rk4"})) < float(euler.sel({"method": "rk4"})) / 8


def test_bracket_and_seeds(tmp_path):
    load("bracket_and_seeds").main(small("bracket_and_seeds"), tmp_path / "out", seeds=[0])
    plot("bracket_and_seeds", tmp_path / "out", tmp_path / "figures")
    data = read_results(tmp_path / "out" / "seed 0").squeeze()
    rollouts, accuracy = metrics.mean_rollouts(data), metrics.accuracy(data)
    assert float(rollouts.sel(estimator="ibss", width=2.0)) > float(rollouts.sel(estimator="ibss", width=0.5))
    assert (rollouts.sel(estimator="hybrid") < rollouts.sel(estimator="ibss")).all()
    np.testing.assert_allclose(accuracy.sel(estimator="hybrid"), accuracy.sel(estimator="ibss"), rtol=0.05)
    # The rates are nearly linear in the parameters: the network loses little, and less in a narrower bracket.
    network = accuracy.sel(estimator="network")
    assert float(network.sel(width=0.5)) < min(1.5, float(network.sel(width=2.0)))
