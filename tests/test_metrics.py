"""Metrics of a study: against the same a second time in plain loops, and against laws of statistics."""

import math

import numpy as np
import pytest
import scipy.stats
import xarray as xr
from synthetic_study import LEVELS, RESULTS, SCENARIO, synthetic_study

from jaxos4.study import metrics

CONVERGED = (RESULTS.index("successful"), RESULTS.index("unidentifiable"))


@pytest.fixture(scope="module", params=[False, True], ids=["one truth", "a truth each"])
def study(request):
    estimators = ("ibss", "network", "hybrid", "svsf")
    return synthetic_study(flights=12, drawn=request.param, scales=(0.1, 10.0), estimators=estimators)


def cells(study):
    """Every cell: its place by dimension, and its arrays by flight."""
    for index in np.ndindex(tuple(study.sizes[name] for name in SCENARIO)):
        at = dict(zip(SCENARIO, index, strict=True))
        one = study.isel(at)
        converged = [f for f in range(study.sizes["flight"]) if int(one["result"].values[f]) in CONVERGED]
        yield at, one, converged


def same(actual, expected):
    assert math.isclose(float(actual), expected, rel_tol=1e-9) or (math.isnan(float(actual)) and math.isnan(expected))


def rms(values):
    return math.sqrt(sum(v * v for v in values) / len(values)) if len(values) else math.nan


def test_errors_efficiency_and_bounds_against_plain_loops(study):
    errors, best = metrics.estimator_error(study), metrics.bound_error(study)
    middle, efficiency = metrics.center_error(study), metrics.efficiency(study)
    for at, one, converged in cells(study):
        without = {name: place for name, place in at.items() if name != "estimator"}
        truth, bound, estimate = (one[name].values for name in ("truth", "bound", "estimate"))
        least = np.nanmin(study.isel(without)["bound"].values, axis=0)
        for p in range(8):
            place, size = at | {"parameter": p}, abs(truth[:, p])
            zero, below = (size == 0).any(), (size < 1.959964 * bound[:, p]).any()
            reason = 1 if zero else 2 if below else 0
            found = errors.isel(place)
            assert int(found["reason"]) == reason
            deviations = (estimate - truth)[converged, p]
            same(found["absolute"], rms(deviations))
            same(found["percent"], rms([] if reason else 100 * deviations / size[converged]))
            same(efficiency["efficiency"].isel(place), rms(deviations / bound[converged, p]))
            assert int(efficiency["count"].isel(place)) == len(converged)
            known = ~np.isnan(bound[:, p])
            same(best["absolute"].isel(place), rms(bound[known, p]))
            same(best["percent"].isel(place), rms([] if reason else 100 * bound[known, p] / size[known]))
            distances, center = float(one["center"][p]) - truth[:, p], middle.isel(without | {"parameter": p})
            same(center["absolute"], rms(distances))
            below_least = zero or (size < 1.959964 * least[:, p]).any()
            same(center["percent"], rms([] if below_least else 100 * distances / size))


def test_coverage_results_hits_rollouts_and_accuracy_against_plain_loops(study):
    coverage, counts, accuracy = metrics.coverage(study), metrics.result_counts(study), metrics.accuracy(study)
    hits, spent = metrics.hit_rate(study), metrics.mean_rollouts(study)
    for at, one, converged in cells(study):
        results = [int(code) for code in one["result"].values]
        for code, name in enumerate(RESULTS):
            assert int(counts.sel(code=name).isel(at)) == results.count(code)
        ran = [f for f, code in enumerate(results) if RESULTS[code] not in ("failed", "not_run")]
        same(spent.isel(at), sum(int(one["rollouts"][f]) for f in ran) / len(ran) if ran else math.nan)
        hit = [int(one["hit"][f]) for f in ran if int(one["hit"][f]) >= 0]
        same(hits["hit_rate"].isel(at), sum(hit) / len(hit) if hit else math.nan)
        errors = one["estimate"].values - one["truth"].values
        for p, k in np.ndindex(8, len(LEVELS)):
            held = sum(bool(abs(errors[f, p]) <= one["half_width"].values[f, p, k]) for f in converged)
            part = coverage.isel(at | {"parameter": p, "level": k})
            same(part["coverage"], held / len(converged) if converged else math.nan)
            if converged:
                test = scipy.stats.binomtest(held, len(converged)).proportion_ci(0.95, method="wilson")
                assert np.allclose([part["low"], part["high"]], [test.low, test.high], atol=1e-9)
        # Accuracy is against the least bound of all estimators.
        others = study.isel({name: place for name, place in at.items() if name != "estimator"})
        least = np.nanmin(others["bound"].values, axis=0)
        ratios = [rms([errors[f, p] / least[f, p] for f in converged]) for p in range(8)]
        same(accuracy.isel(at), math.exp(sum(math.log(r) for r in ratios) / 8) if converged else math.nan)


def test_monte_carlo_intervals_hold_the_truth_as_often_as_they_say():
    """400 studies of 15 flights: the exact chi-squared interval, within its own Monte-Carlo error."""
    rng = np.random.default_rng(1)
    ratio = rng.standard_normal((400, 15))
    study = xr.Dataset(
        {
            "estimate": (("scale", "flight"), ratio),
            "truth": (("scale", "flight"), np.zeros_like(ratio)),
            "bound": (("scale", "flight"), np.ones_like(ratio)),
            "result": (("scale", "flight"), np.zeros(ratio.shape, dtype=np.int8)),
        }
    )
    study["result"].attrs = {"flag_values": np.arange(len(RESULTS)), "flag_meanings": " ".join(RESULTS)}
    found = metrics.efficiency(study)
    exact = [math.sqrt(15 / scipy.stats.chi2.ppf(q, 15)) for q in (0.975, 0.025)]
    assert np.allclose(found["low"] / found["efficiency"], exact[0], rtol=2e-3)
    assert np.allclose(found["high"] / found["efficiency"], exact[1], rtol=5e-3)
    share = float(((found["low"] <= 1) & (found["high"] >= 1)).mean())
    assert abs(share - 0.95) < 4 * math.sqrt(0.95 * 0.05 / 400)


def test_metrics_of_a_study_without_results_or_noise_are_nan_without_a_warning():
    study = synthetic_study(flights=4, scales=(0.0, 1.0), spoiled=False)
    assert metrics.efficiency(study)["efficiency"].isel(scale=0).isnull().all()
    assert metrics.estimator_error(study)["percent"].sel(parameter="alpha2").isel(scale=0).notnull().all()
    study["result"][:] = RESULTS.index("not_run")
    for name in ("truth", "estimate", "std", "half_width", "bound"):
        study[name] = xr.full_like(study[name], np.nan)
    errors = (metrics.estimator_error(study)["absolute"], metrics.center_error(study)["absolute"])
    covered = (metrics.coverage(study)["coverage"], metrics.mean_coverage(study)["coverage"])
    others = (metrics.efficiency(study)["efficiency"], metrics.mean_rollouts(study), metrics.accuracy(study))
    assert all(found.isnull().all() for found in (*errors, *covered, *others))
    assert int(metrics.result_counts(study).sel(code="not_run").sum()) == 4 * 10
