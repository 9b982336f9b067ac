"""The benchmarks in small configurations: opponents reach the optimum, and only those that do are timed."""

import numpy as np
import pytest
from helpers import how_we_compile
from small_experiments import load, plot, result_of

from experiments.benchmarks.case import ALL, RATES, costs
from experiments.benchmarks.contenders import FITS, KINDS, REFERENCE_SHOT, SHOTS
from experiments.benchmarks.opponents.in_c import FAST, compiled, compiler, lanes as shots_in_lanes, levenberg_marquardt
from experiments.benchmarks.opponents.least_squares import Residuals

pytestmark = pytest.mark.usefixtures("optimised")
in_c = pytest.mark.skipif(compiler() is None, reason="no C compiler")


@pytest.mark.slow
def test_benchmarks(monkeypatch, tmp_path):
    for name, value in how_we_compile().items():
        monkeypatch.setenv(name, value)
    fits, shots = ["SciPy least_squares", "jaxos4 kalman"], ["jaxos4", "C, plain"]
    sizes = {"flights": 2, "alone": 1, "repeats": 2, "steps": 500, "starts": ["known"], "seed": 0}
    growth = {"growing": "kalman", "grow_flights": [], "grow_steps": [50], "grow_parameters": []}
    others = {"contenders": fits, "shooters": shots, "network_steps": 0, "simulations": 0}
    report = result_of(tmp_path, "benchmarks", **sizes, **growth, **others)
    rows = report["fits"]["known"]
    # Both reach the same optimum, and are timed in turns.
    assert {name: row["reached"] for name, row in rows.items()} == dict.fromkeys(fits, 1.0)
    assert all(len(row["laps"]) == 2 and row["min_seconds"] <= row["median_seconds"] for row in rows.values())
    assert all(row["peak_mib"] > 10 for row in rows.values())
    assert report["shots"]["jaxos4"]["steps_per_second"] > 0
    assert 0 < report["roofline"]["share"] < 1
    assert [(row["axis"], row["size"], row["flights"]) for row in report["growth"]] == [("steps", 50, 10)]
    plot(tmp_path, "benchmarks")


def test_a_benchmark_skips_who_is_missing_or_fails_and_times_only_who_reaches_the_least_cost():
    run = load("benchmarks")
    case = run.make_case(2, 50)
    failing = run.Contender("least_squares:levenberg_marquardt", alone=True, options={"unknown": 1})
    absent = run.Contender("least_squares:levenberg_marquardt", "no_such_package")
    skipped = []
    assert run.line_up({"failing": failing, "absent": absent}, case, 1, skipped) == {}
    assert "failing: failed: TypeError" in skipped[0]
    assert skipped[1] == "absent: no_such_package is not installed: pip install no_such_package"
    truth, first = np.tile(case.truth, (2, 1)), np.zeros((2, 12))
    answers = {
        "both": {"parameters": truth, "first": first},
        "one of both": {"parameters": np.stack([truth[0], case.starts[1]]), "first": first},
        "only the first": {"parameters": truth[:1], "first": first[:1]},
        "diverged": {"parameters": 1e3 * truth, "first": first},
    }
    assert list(run.reached(case, answers).values()) == [1.0, 0.5, 1.0, 0.0]


@pytest.mark.slow
@in_c
def test_opponents_in_c_leave_the_arithmetic_of_the_process_alone():
    """A library that is linked with `-ffast-math` would round this quotient to 0 from now on."""
    compiled("fits.c", *FAST, "-DLANES=4")
    assert np.float64(1e-308) / 1e3 > 0


@in_c
@pytest.mark.parametrize("lanes", [1, 4])
@pytest.mark.parametrize("known", [True, False], ids=["known", "free"])
def test_the_fit_in_c_reaches_the_optimum(known, lanes):
    """NumPy's Gauss-Newton step from the answer would not lower the cost, which is less than that of the truth."""
    run = load("benchmarks")
    case = run.make_case(6, 200, known=known)
    answer = levenberg_marquardt(case, lanes=lanes, cores=2)()
    least = costs(case, np.tile(case.truth, (6, 1)), np.zeros((6, 12)))
    found = costs(case, answer["parameters"], answer["first"])
    assert (found < least).all()
    for which in range(case.flights):
        residuals = Residuals(case, which)
        offsets = (answer["parameters"][which] - case.starts[which]) / case.half_width
        if not known:
            offsets = np.append(offsets, (answer["first"][which] - case.measured[which, 0]) / case.sigma)
        slopes, errors = residuals.jacobian(offsets), residuals(offsets)
        promised = 0.5 * np.square(slopes @ np.linalg.lstsq(slopes, errors)[0]).sum()
        assert promised < run.SAME_COST / 10


@in_c
@pytest.mark.parametrize("same_flight", [False, True], ids=["many", "same"])
@pytest.mark.parametrize("kind", KINDS)
def test_shots_in_c_have_the_costs_and_slopes_of_numpy(kind, same_flight):
    options = KINDS[kind] | {"same_flight": same_flight}
    case = load("benchmarks").make_case(10, 200, share=0.1)
    answer = shots_in_lanes(case, **options)()
    stepped = case.starts + 1e-30j * case.half_width
    columns = RATES if options.get("channels") == "rates" else ALL
    expected = costs(case.first(1) if same_flight else case, stepped, np.zeros((10, 12)), columns)
    np.testing.assert_allclose(answer["costs"], expected.real, rtol=1e-9)
    if options.get("slope"):
        np.testing.assert_allclose(answer["slopes"], expected.imag / 1e-30, rtol=1e-7)


def test_each_contender_is_compared_with_one_that_takes_part():
    """Rivals are contenders of the same race, on as many cores."""
    for race in (FITS, SHOTS):
        for name, contender in race.items():
            for rival in contender.rivals:
                assert rival in race
                assert rival.endswith(", all cores") == name.endswith(", all cores")
    assert SHOTS["jaxos4, rates"].rivals == (f"{REFERENCE_SHOT}, rates",)


def test_growth_has_exponents_of_its_larger_sizes(capsys):
    tables = load("benchmarks", "tables")
    rows = [
        {"axis": "steps", "size": size, "flights": 1, "median_seconds": 1.0 if size < 100 else size / 100}
        for size in (1, 10, 100, 1000)
    ]
    (found,) = tables._exponents([row | {"peak_mib": 300.0} for row in rows])
    assert found == ("steps", "100", "1,000", "1.00", "0.00")
