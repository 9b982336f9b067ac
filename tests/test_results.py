"""A result read from its file is the one that was found: the same page, numbers and words; and results compared."""

import io
import json
import re
import sys

import equinox as eqx
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
from helpers import CRAZYFLIE, output_of, refused
from jaxtyping import Float, jaxtyped
from matplotlib.figure import Figure
from pages import printed, read_page, says, words
from rich.console import Console
from strange import survives_strange_values
from synthetic_identification import (
    SAMPLE_TIMES,
    WRONG,
    behind_an_estimate,
    identified_flight,
    identified_vehicle,
    synthetic_predictions,
    synthetic_traces,
    synthetic_trajectories,
    vehicle_traces,
)

import jaxos4
from jaxos4.errors import InputError
from jaxos4.identification.results import Constant, Disturbance, RigidBody
from jaxos4.identification.verdict import Verdict
from jaxos4.report import print_comparison, print_identification, write_flight_page

FULL = {
    "sample_times": SAMPLE_TIMES,
    "covariance": [[1.0, 0.0], [0.0, 4.0]],
    "widened": {"alpha3": 1.7},
    "disturbances": {
        "p": Disturbance(1.2, "rad/s^2", 0.1, 0.02, 0.01),
        "az": Disturbance(0.3, "m/s^2", 0.3, 0.1, 0.01, smoothing=0.05),
    },
    "correlations": behind_an_estimate()["correlations"],
}


def written(found, path):
    path.write_text(json.dumps(found.to_dict()))
    return jaxos4.read_result(path)


@pytest.mark.parametrize(
    "found", [identified_vehicle(**FULL), identified_flight(**behind_an_estimate())], ids=["vehicle", "os4"]
)
def test_a_result_that_was_read_is_the_one_that_was_written(tmp_path, found):
    again = written(found, tmp_path / "found.json")
    assert (type(again), again.estimate, again.problem) == (type(found), None, None)
    assert again.to_dict() == found.to_dict()
    assert printed(again) == printed(found)
    assert written(again, tmp_path / "again.json").to_dict() == found.to_dict()
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "found.json").read_bytes()


def test_arrays_without_rows_keep_their_shape(tmp_path):
    """A short log has no frequency at which its response is known."""
    none = np.zeros(0)
    axis = jaxos4.AxisResponse(none, none, none, none, np.zeros((0, 0)), 0.0)
    again = written(identified_vehicle(response=jaxos4.FrequencyResponse(axis, axis, axis)), tmp_path / "found.json")
    assert again.response.yaw.covariance.shape == (0, 0)
    write_flight_page(tmp_path / "found.html", again)


def test_the_command_makes_the_page_of_the_estimate_byte_for_byte(run, tmp_path):
    found = identified_vehicle(**FULL)
    write_flight_page(tmp_path / "fresh.html", found)
    written(found, tmp_path / "found.json")
    out = output_of(run("report", "found.json"))
    assert out.startswith("found.html: ")
    assert (tmp_path / "found.html").read_bytes() == (tmp_path / "fresh.html").read_bytes()
    refused(run("report", "found.json", "--out", "found.json"), "would overwrite an input")
    (tmp_path / "none.json").write_text("[]")
    refused(run("report", "none.json"), "none.json: not a result")
    assert not (tmp_path / "none.html").exists()
    written(identified_flight(), tmp_path / "os4.json")
    assert run("report", "os4.json", "--out", "other.html")[0] == 0
    assert "<title>flight.csv</title>" in (tmp_path / "other.html").read_text(encoding="utf-8")
    (tmp_path / "study").mkdir()
    refused(run("report", "study", "--out", "page.html"), "--out: study is a folder")


def test_a_file_of_an_older_version_has_a_page_without_the_figures_that_it_lacks(tmp_path):
    found = identified_vehicle()
    table = {
        name: each
        for name, each in found.to_dict().items()
        if name not in ("traces", "correlations", "predictions", "trajectories", "response", "verdicts")
    }
    (tmp_path / "old.json").write_text(json.dumps(table))
    old = jaxos4.read_result(tmp_path / "old.json")
    assert (old.predictions, old.response, old.verdicts) == (None, None, {})
    write_flight_page(tmp_path / "old.html", old)
    assert "Measured and predicted" not in (tmp_path / "old.html").read_text(encoding="utf-8")


def test_predictions_in_a_file_are_few(tmp_path):
    many = synthetic_predictions(4000).thinned(1000)
    np.testing.assert_array_equal(many.start, synthetic_predictions(4000).start[::4])
    np.testing.assert_allclose(many.predicted, synthetic_predictions(4000).predicted[::4], atol=5.1e-5)
    many = synthetic_predictions(4000).thinned(1200)
    some = synthetic_trajectories(4000)
    some = msgspec.structs.replace(
        some, **{name: getattr(some, name)[:40] for name in ("start", "initial", "predicted", "measured")}
    )
    found = identified_vehicle(predictions=many, trajectories=some, traces=vehicle_traces(many.start))
    written(found, tmp_path / "found.json")
    assert (tmp_path / "found.json").stat().st_size < 5e5
    write_flight_page(tmp_path / "found.html", found)
    assert (tmp_path / "found.html").stat().st_size < 6e5


def test_channels_that_are_logged_rarely_stay_in_thinned_traces():
    """Attitude in every tenth sample from sample 3 on, position from sample 5 on; the second log begins in a block."""
    rows = np.arange(4010)
    rare, places = (np.where(rows % 10 == first, rows + 1.0, np.nan)[:, None] for first in (3, 5))
    traces = synthetic_traces(0.002 * rows, (rows >= 2001).astype(int), np.tile(rare, 6))
    traces = msgspec.structs.replace(traces, disturbance=np.full((4010, 3), np.nan), position=np.tile(places, 3))
    fewer = traces.thinned(401)
    np.testing.assert_allclose(fewer.time, traces.time[::10])
    expected = rows[3::10] + 1.0
    expected[200] = np.nan  # only sample 2000 of this block is of the first log
    np.testing.assert_allclose(fewer.measured[:, 5], expected)
    np.testing.assert_allclose(fewer.position[:, 2], expected + 2)
    assert np.isnan(fewer.disturbance).all()
    # Shorter blocks have a value if one was measured; the last block is not whole.
    assert np.count_nonzero(np.isfinite(traces.thinned(1003).measured[:, 0])) == 400


def shown(path):
    """All that is made of a result's file."""
    found = jaxos4.read_result(path)
    printed(found)
    assert found._repr_html_()
    assert len(found.to_dataframe()) >= len(found.to_dataset()["parameter"])
    print_comparison(Console(file=io.StringIO()), jaxos4.compare_results([found, path]))
    write_flight_page(path.with_suffix(".html"), found)


RESPONSE = identified_vehicle().to_dict()["response"]
BACKWARD = {axis: found | {"frequency": found["frequency"][::-1]} for axis, found in RESPONSE.items()}
DAMAGES = [
    (("predictions", "start", 1), 5, "`predictions`: starts must increase"),
    (("predictions", "start", 0), -1, "`predictions`: starts must increase"),
    (("predictions", "horizons", 0), -1.0, "`predictions`"),
    (("predictions", "measured", 0), [], "`predictions.measured`"),
    (("trajectories", "start", 1), 6, "`trajectories`: has starts that are not among those of the predictions"),
    (("predictions",), None, "`trajectories`: has starts"),
    (("trajectories", "horizons", 24), 9e9, "`trajectories`: horizons must increase"),
    (("trajectories", "horizons", 3), 0.01, "`trajectories`: horizons must increase"),
    (("response", "roll", "gain", 3), 0.0, "`response.roll`"),
    (("response",), BACKWARD, "`response.roll`: frequencies must be positive and increase"),
    (("response", "roll", "phase"), [1.0], "`response.roll`: `phase` has another shape"),
    (("response", "yaw", "frequency", 0), 0.5, "`response`: its axes must have the same frequencies"),
    (("response", "yaw"), {}, "`response.yaw`: object missing required field `frequency`"),
    (("traces", "start_time"), [0.1], "`traces"),
    (("traces", "log", 0), 7, "`traces`: is of a log that has no name"),
    (("traces", "time", 3), None, "`traces`: a time is missing"),
    (("traces", "measured"), [[1.0]] * 400, "`traces`: has channels that no model has"),
    (("traces", "rotors", 0), [1.0], "`traces.rotors`: is not an array"),
    (("correlations", "bound"), [1.0], "`correlations"),
    (("skill", "horizons"), [0.1], "`skill`"),
    (("constants", "Ix", "std"), -1.0, "`constants[...].std`: expected a number >= 0.0"),
    (("constants", "other"), 1.0, "'other' is no name"),
    (("disturbances", "p", "smoothing"), 0.05, "`disturbances.p`: `smoothing` is of a rate"),
    (("disturbances", "az", "smoothing"), 0.3, "`disturbances.az`: `smoothing` is of a rate, or not between 0"),
    (("disturbances", "az", "time_constant"), 0.0, "`disturbances[...].time_constant`: expected a number > 0.0"),
    (("disturbances", "az", "sensor"), -0.1, "`disturbances[...].sensor`: expected a number >= 0.0"),
    (("sample_times", 0, "sample_time"), 0.0, "`sample_times[0].sample_time`: expected a number > 0.0"),
    (("cost",), float("nan"), "`cost`"),
    (("airframe", "mass"), -1.0, "`mass` must be"),
    (("result",), "unheard", "`result` unheard"),
]


@pytest.mark.parametrize(
    ("place", "value", "said"), DAMAGES, ids=lambda x: ".".join(map(str, x)) if isinstance(x, tuple) else ""
)
def test_what_no_result_has_is_named(tmp_path, place, value, said):
    table = identified_vehicle(**FULL).to_dict()
    holder = table
    for key in place[:-1]:
        holder = holder[key]
    holder[place[-1]] = value
    (tmp_path / "found.json").write_text(json.dumps(table))
    with pytest.raises(InputError, match=f"found.json: .*{re.escape(said)}") as caught:
        jaxos4.read_result(tmp_path / "found.json")
    assert str(caught.value).isprintable()


# In Python


def test_a_result_shows_itself(tmp_path):
    found = identified_vehicle(**FULL)
    assert len(repr(found)) < 200
    assert repr(found).startswith("<Identification by ibss, flight model: successful, Ix = 1.733e-05 kg m^2")
    lines = found.summary().splitlines()
    assert max(map(len, lines)) <= 80
    place = [
        next(i for i, line in enumerate(lines) if line.startswith(said))
        for said in ("Ix: identified.", "Ix ", "Iz: the")
    ]
    assert place == sorted(place)  # verdict, quantities, reservations
    assert place[1] < 5
    assert "alpha3" not in found.summary()
    assert "alpha3" in found.summary(verbose=True)
    wide = found.summary(width=120).splitlines()
    assert max(map(len, wide)) <= 120
    assert any(line.startswith("Ix") and line.endswith("if arms and mass are right") for line in wide)
    shown = found._repr_html_()
    assert "Ix: identified. Iz: refused (not identified)." in shown
    assert "1.733e-05" in shown
    evil = identified_vehicle(verdicts={"Ix": Verdict("contradicted", "", ("<script>",))})
    assert "<script>" not in evil._repr_html_()


def test_verdicts_have_colours_on_a_terminal_alone():
    shown = {"force_terminal": True, "color_system": "standard", "no_color": False}
    for options, begin in ((shown, "\x1b[32mIx: identified."), ({"force_terminal": False}, "Ix: identified.")):
        console = Console(width=80, file=io.StringIO(), **options)
        print_identification(console, identified_vehicle())
        assert console.file.getvalue().startswith(begin)


def test_a_result_as_tables():
    found = identified_vehicle(**FULL)
    table = found.to_dataframe()
    assert list(table.index) == ["Ix", "J_R", "alpha3", "alpha6", "alpha1"]
    assert table.loc["alpha3", ["kind", "estimate", "low", "bound"]].tolist() == ["parameter", 57712.3, 56708.8, 130.0]
    assert np.isnan(table.loc["alpha6", "estimate"])
    assert table.loc["alpha1", "kind"] == "held"
    data = found.to_dataset()
    assert data["covariance"].sel(parameter="alpha6", other="alpha6") == 4.0
    np.testing.assert_array_equal(data["predicted"], found.predictions.predicted)
    np.testing.assert_allclose(data["start"], 0.004 * found.predictions.start)
    np.testing.assert_array_equal(data["gain"].sel(axis="pitch"), found.response.pitch.gain)
    assert set(identified_flight().to_dataset().data_vars) == {"estimate", "std", "low", "high"}


@pytest.mark.parametrize(("package", "method"), [("pandas", "to_dataframe"), ("xarray", "to_dataset")])
def test_a_missing_package_is_named(monkeypatch, package, method):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=f"the package {package} is missing"):
        getattr(identified_vehicle(), method)()


def test_figures_are_on_one_axis_each():
    found, ax = identified_vehicle(), Figure().add_subplot()
    assert found.plot.rates("q", horizon=0.1, ax=ax) is ax
    measured, predicted = (np.asarray(line.get_ydata()) for line in ax.lines)
    np.testing.assert_allclose(np.delete(measured, 80), found.predictions.measured[:, 0, 1])
    np.testing.assert_allclose(np.delete(predicted, 80), found.predictions.predicted[:, 0, 1])
    assert np.isnan(measured[80])  # between the stretches
    np.testing.assert_allclose(np.delete(ax.lines[0].get_xdata(), 80), 0.004 * found.predictions.start + 0.1)
    bars = found.plot.inertias(ax=Figure().add_subplot())
    assert [label.get_text() for label in bars.get_xticklabels()] == ["Ix"]
    assert bars.lines[1].get_ydata() == [1.733e-5]
    gain = found.plot.response("pitch", ax=Figure().add_subplot())
    np.testing.assert_array_equal(gain.lines[0].get_ydata(), found.response.pitch.gain)
    empty = identified_flight()
    for wrong, said in (
        (lambda: found.plot.rates("x"), "`rate` must be one of p, q, r"),
        (empty.plot.rates, "no predictions"),
        (empty.plot.response, "no frequency response"),
    ):
        with pytest.raises(InputError, match=said):
            wrong()


# Comparison


def of_inertias(ix, std=2e-7, **changes):
    """A result with this Ix, and an Iy and a Iz that are the same in all results."""
    table = {"Ix": Constant(ix, std, "kg m^2"), "Iy": Constant(1.7e-5, 2e-7, "kg m^2")}
    return identified_vehicle(rigid_body=RigidBody(table), verdicts={}, **changes)


AGREE = (1.66e-5, 1.69e-5, 1.64e-5)


@pytest.fixture
def files(tmp_path):
    for i, ix in enumerate((*AGREE, 1.9e-5)):
        written(of_inertias(ix, provenance={"flights": [f"{i}.csv"]}), tmp_path / f"{i}.json")
    return [f"{i}.json" for i in range(4)]


def test_three_results_that_agree_are_pooled_and_one_that_does_not_is_named(run, tmp_path, files):
    out = output_of(run("compare", *files[:3]))
    assert out.startswith("The results agree within their intervals in all 2 quantities")
    agree = jaxos4.compare_results([tmp_path / name for name in files[:3]])
    ix, iy = agree.quantities
    errors = (np.array(AGREE) - np.mean(AGREE)) / 2e-7
    assert ix.value == pytest.approx(np.mean(AGREE))
    assert ix.chi2 == pytest.approx(errors @ errors)
    assert ix.p == pytest.approx(np.exp(-ix.chi2 / 2))  # chi-squared with two degrees of freedom
    widened = max(1.0, np.sqrt(ix.chi2 / 2))
    assert ix.std == pytest.approx(2e-7 / np.sqrt(3) * widened)
    assert iy.std == pytest.approx(2e-7 / np.sqrt(3))
    assert (agree.different, iy.p) == ((), pytest.approx(1.0))
    code, out, err = run("compare", *files, "--report", "page.html")
    assert code == 1
    assert err == "jaxos4: the results differ by more than chance: see the quantities that differ\n"
    assert "differ by more than chance in 1 of 2 quantities: Ix (p = " in " ".join(out.split())
    assert "3.json" in out
    says(words(read_page(tmp_path / "page.html")), "Ix (p = ", "1.90e-5", "differ", "3.json")
    (different,) = jaxos4.compare_results([tmp_path / name for name in files]).different
    assert different.name == "Ix"


def test_what_a_verdict_refuses_is_shown_and_does_not_count(tmp_path):
    results = [of_inertias(ix) for ix in AGREE]
    wrong = msgspec.structs.replace(of_inertias(9e-5), verdicts=WRONG, result="implausible")
    found = jaxos4.compare_results([*results, wrong])
    assert found.quantities[0].used == (True, True, True, False)
    assert found.quantities[0].value == pytest.approx(np.mean(AGREE))
    console = Console(width=80, file=io.StringIO())
    print_comparison(console, found)
    assert "not counted: refused (contradicted)" in " ".join(console.file.getvalue().split())
    assert "not to be trusted as a whole" in console.file.getvalue()


CAREFUL = Verdict("identified with a reservation", "", ("it is known to 16 % only; fly more roll, or longer",))
UNSEEN = Verdict("not identified", "", ("the disturbance is larger; fly more yaw",), ("fly more yaw",))


def test_a_comparison_is_not_more_confident_than_its_results(tmp_path, run):
    """Two of three have a reservation about Ix, and none has an Iz."""
    good = {"Ix": Verdict("identified"), "Iy": Verdict("identified"), "Iz": UNSEEN}
    results = [
        msgspec.structs.replace(of_inertias(ix, std, provenance={"flights": [f"{i}.csv"]}), verdicts=verdicts)
        for i, (ix, std, verdicts) in enumerate(
            ((1.66e-5, 1e-6, good), (1.7e-5, 1e-6, good | {"Ix": CAREFUL}), (1.62e-5, 2e-6, good | {"Ix": CAREFUL}))
        )
    ]
    found = jaxos4.compare_results(results)
    assert found.statuses == {"Ix": CAREFUL.status, "Iy": "identified", "Iz": "not identified"}
    assert [each.status for each in found.quantities[:3]] == list(found.statuses.values())
    assert found.flights == ("0.csv", "1.csv", "2.csv")
    assert found.quantities[0].reference == pytest.approx(float(CRAZYFLIE.inertia[0]))
    assert found.quantities[2].answers == (None, None, None)
    console = Console(width=80, file=io.StringIO())
    print_comparison(console, found)
    out = " ".join(console.file.getvalue().split())
    says(
        out,
        "Iy: identified. Ix: use with care. Iz: refused (not identified). The results agree",
        "Ix in results 2, 3: it is known to 16 % only; fly more roll, or longer.",
        "Iz in results 1, 2, 3: the disturbance is larger; fly more yaw.",
        *("airframe's file", "result 2: 1.csv, of 1.csv", "A wrong mass or arm length is wrong in all results"),
    )
    assert out.endswith("next: fly more yaw (Iz).")
    for i, result in enumerate(results):
        written(result, tmp_path / f"{i}.json")
    code, *_ = run("compare", "0.json", "1.json", "2.json", "--report", "page.html")
    assert code == 0
    page = words((tmp_path / "page.html").read_text(encoding="utf-8"))
    says(
        page,
        "Iy: identified. Ix: use with care. Iz: refused",
        "Ix in results 2, 3",
        "pooled, 95 % airframe's file 95 % interval",  # the legend
    )
    says(page, "Next: ")
    other = of_inertias(2.3e-5, 1e-7, provenance={"flights": ["3.csv"]})
    differs = jaxos4.compare_results([*results, msgspec.structs.replace(other, verdicts=good)])
    assert differs.next_flight.startswith("first find out why the results differ in Ix; ")


def test_what_cannot_be_compared_is_refused_or_noted(run, tmp_path, files):
    refused(run("compare", "0.json"), "two results or more")
    refused(run("compare", "--report", "page.html"), "--report: is for a comparison of results")
    refused(run("compare", *files, "--quick"), "--quick: is for a comparison of estimators")
    written(identified_flight(), tmp_path / "os4.json")
    refused(run("compare", "0.json", "os4.json"), "os4.json: is of the published model")
    refused(run("compare", "0.json", "./0.json"), "0.json: given twice; give one result of each flight")
    heavy = eqx.tree_at(lambda airframe: airframe.mass, CRAZYFLIE, jnp.asarray(0.03))
    other = of_inertias(1.66e-5, airframe=heavy)
    notes = jaxos4.compare_results([of_inertias(1.66e-5), other]).notes
    assert any("airframes differ in `mass`" in note for note in notes)
    assert any("flight.csv was fitted in several results" in note for note in notes)


def test_a_damaged_result_ends_in_one_line(tmp_path):
    path = tmp_path / "found.json"
    few = identified_vehicle(**FULL, predictions=synthetic_predictions(6)).to_dict()
    tables = [json.dumps(few), json.dumps(identified_flight().to_dict())]
    survives_strange_values(shown, path, tables, examples=25)


def test_a_result_is_read_in_a_function_whose_axes_have_the_same_names(tmp_path):
    """Those of the caller's arrays, and those of predictions and trajectories, are not compared."""
    found = identified_vehicle(**FULL)
    found = msgspec.structs.replace(found, trajectories=found.predictions.thinned(2))
    with jaxtyped("context"):
        assert isinstance(np.zeros(9), Float[np.ndarray, " starts"])
        again = written(found, tmp_path / "found.json")
    assert again.trajectories.start.size < again.predictions.start.size
