"""An identification as a page. As text: `test_report_text.py`."""

import base64
import json

import msgspec
import numpy as np
import pytest
from helpers import CRAZYFLIE
from pages import page_of, printed, says
from synthetic_identification import (
    CONSTANTS,
    SAMPLE_TIMES,
    WRONG,
    behind_an_estimate,
    identified_flight,
    identified_vehicle,
    synthetic_response,
    synthetic_traces,
    vehicle_traces,
)

from jaxos4 import Predictions
from jaxos4.analysis.inertia import CenterOfMass
from jaxos4.identification.results import FixedParameter, ParameterEstimate, RigidBody
from jaxos4.identification.verdict import Verdict
from jaxos4.report import write_flight_page
from jaxos4.report.identification_figures import frequency_responses, inertias_by_sample_time, vehicle
from jaxos4.report.identification_page import verdict
from jaxos4.report.identification_signals import identified_signals, prediction_band
from jaxos4.report.panels import Band, Line, Words, styles

LOOK = styles(["ibss"])["ibss"]
EVIL = "</script><script>alert(1)</script>"


def written(path, title="A flight", **changes):
    """The page of a vehicle, and its words."""
    shown = page_of(identified_vehicle(**changes), path, title=title)
    return path.read_text(encoding="utf-8"), shown


def test_the_page_says_what_was_found(tmp_path):
    text, shown = written(tmp_path / "flight.html")
    assert text.index("Ix: identified. Iz: refused (not identified).") < text.index("<main>")
    says(shown, "Iz: the flights say less about alpha8 than")
    says(
        shown,
        *("ibss, flight model, successful, 812 rollouts, 35.4 s, cost 1230", "57710 56710 to 58720 130"),
        *("alpha6 1/(kg m^2) – 2.0e6 not identifiable: not excited", "fixed: not identifiable alpha1 1 -0.8125"),
        *("1.733e-05 1.704e-05 to 1.762e-05 if arms and mass are right", "p = 0.21", "377 starts"),
        *("0.248 0.73 ± 0.14 0.41 0.400 0.800", "known to less than half of the model"),
        *("jaxos4 estimate flight.csv --model flight --report flight.html", "t is not uniform", "sample time 0.004"),
    )
    absent = {"traces": None, "predictions": None, "skill": None, "response": None, "rigid_body": RigidBody()}
    text, shown = written(tmp_path / "flight.html", **absent)
    assert not any(said in shown for said in ("Measured, predicted", "Skill", "Frequency response"))
    assert len(text) < 100_000


def test_names_of_arguments_are_code(tmp_path):
    notes = ["(`begin` and `end` override)", "a ` alone", "`<b>`"]
    text, _ = written(tmp_path / "flight.html", provenance={"notes": notes})
    says(text, "(<code>begin</code> and <code>end</code> override)", "a ` alone", "<code>&lt;b&gt;</code>")


def unpacked(line):
    middle, step, levels = line["values"]
    levels = np.frombuffer(base64.b64decode(levels), "<i2").astype(float)
    return np.where(levels == -(1 << 15), np.nan, middle + step * levels), step


def test_the_signals_are_the_predictions_with_a_band_of_95_percent():
    unfitted = msgspec.structs.replace(vehicle_traces(), measured=np.full((400, 3), np.nan))
    found = identified_vehicle(traces=unfitted)
    predicted = found.predictions
    drawn = json.loads(identified_signals(found, LOOK))
    named = ["0.1 s ahead", "0.248 s ahead", "0.5 s ahead", "from one start"]
    assert [view["name"] for view in drawn["views"]] == named
    assert drawn["shown"] == 1
    # Nothing was measured so far ahead.
    measured = np.where(np.arange(3)[:, None] > 0, np.nan, predicted.measured)
    short = msgspec.structs.replace(found, predictions=msgspec.structs.replace(predicted, measured=measured))
    assert json.loads(identified_signals(short, LOOK))["shown"] == 0
    # The line breaks between two stretches.
    view, half = drawn["views"][1], prediction_band(predicted)
    time = np.frombuffer(base64.b64decode(view["time"]), "<f4")
    assert (np.diff(time) > 0).all()
    errors = np.abs(predicted.predicted - predicted.measured)
    np.testing.assert_allclose(half, np.nanquantile(errors, 0.95, axis=0))
    for i, panel in enumerate(view["panels"]):
        assert panel["half"] == pytest.approx(half[1, i])
        for line, values in zip(panel["lines"], (predicted.measured, predicted.predicted), strict=True):
            shown, step = unpacked(line)
            assert np.isnan(shown[80])
            np.testing.assert_allclose(np.delete(shown, 80), values[:, 1, i], atol=step)


def test_fitted_and_held_out_parts_are_on_one_axis_of_all_logs():
    """Two logs: of the second one, the second half is held out. The axis has no empty time."""
    log, time = np.repeat([0, 1], 100), np.concatenate([5 + 0.02 * np.arange(100), 900 + 0.02 * np.arange(100)])
    measured = np.where(np.arange(200)[:, None] < 150, 1.0, np.nan) * np.ones(3)
    start = np.arange(150, 170)
    ahead = Predictions(start, np.array([0.2]), np.zeros((20, 3)), np.ones((20, 1, 3)), np.full((20, 1, 3), 2.0))
    traces = synthetic_traces(time, log, measured)
    traces = msgspec.structs.replace(traces, start_time=time[start], start_log=log[start])
    changes = {"traces": traces, "predictions": ahead, "provenance": {"flights": ["a.csv", "b.csv"]}}
    drawn = json.loads(identified_signals(identified_vehicle(**changes), LOOK))
    (at, begin, end, name), (later, *_, other) = drawn["pieces"]
    assert (at, begin, name, other) == (0.0, 5.0, "a.csv", "b.csv")
    assert end - begin < later < 1.1 * (end - begin)
    assert drawn["shaded"] == [pytest.approx([-0.01, later + 0.99])]
    assert [panel["title"] for panel in drawn["common"][0]["panels"]] == ["inputs [rad/s]", "gusts [rad/s²]"]
    shown = np.frombuffer(base64.b64decode(drawn["views"][0]["time"]), "<f4")
    np.testing.assert_allclose(shown, later + 1 + 0.02 * np.arange(20) + 0.2, atol=1e-4)
    fitted, earlier = (np.frombuffer(base64.b64decode(drawn["before"]["time"]), "<f4"), drawn["before"]["panels"][0])
    values, _ = unpacked(earlier["lines"][0])
    assert (fitted.size, np.isfinite(values).sum(), np.isnan(values).argmax()) == (151, 150, 150)


def test_the_trajectory_from_each_start_is_on_the_page():
    """The measured line breaks only where no trajectory is near; each sample knows its start."""
    found = identified_vehicle()
    paths, traces = found.trajectories, found.traces
    drawn = json.loads(identified_signals(found, LOOK))["views"][-1]
    start = np.frombuffer(base64.b64decode(drawn["start"]), "<i2")
    time = np.frombuffer(base64.b64decode(drawn["time"]), "<f4")
    assert (np.diff(time) >= 0).all()
    assert start.max() + 1 == paths.start.size == 40
    begin = traces.start_time[np.isin(found.predictions.start, paths.start)]
    for i, panel in enumerate(drawn["panels"]):
        measured, predicted = (unpacked(line)[0] for line in panel["lines"])
        breaks = np.isnan(measured)
        assert np.count_nonzero(breaks) == 2  # between the stretches, and at the end
        assert panel["residual"]
        for k in (0, 17, 39):
            own = (start == k) & ~breaks
            np.testing.assert_allclose(time[own] - time[own][0], np.append(0, paths.horizons), atol=1e-4)
            assert time[own][0] - time[start == 0][0] == pytest.approx(begin[k] - begin[0], abs=1e-4)
            expected = np.append(paths.initial[k, i], paths.predicted[k, :, i])
            np.testing.assert_allclose(predicted[own], expected, atol=1e-3)
            np.testing.assert_allclose(measured[own][1:], paths.measured[k, :, i], atol=1e-3)


def test_a_few_wild_samples_do_not_set_the_scale_of_the_gusts():
    traces = vehicle_traces()
    wild = traces.disturbance.copy()
    wild[:2] = 1e4
    drawn = json.loads(
        identified_signals(identified_vehicle(traces=msgspec.structs.replace(traces, disturbance=wild)), LOOK)
    )
    panels = {panel["title"]: panel["reach"] for view in drawn["common"] for panel in view["panels"]}
    largest = np.abs(traces.disturbance).max()
    assert 0.9 * largest < panels["gusts [rad/s²]"] < 2 * largest
    assert panels["inputs [rad/s]"] == 0


def test_what_stands_behind_an_estimate_is_drawn(tmp_path):
    behind = behind_an_estimate()
    correlations = behind["correlations"]
    assert (np.abs(correlations.own) < correlations.bound[:, None]).mean() == pytest.approx(0.95, abs=0.03)
    assert correlations.with_torque[1, 2].argmax() == 25 + 5
    shown = page_of(identified_flight(**behind), tmp_path / "flight.html")
    assert (tmp_path / "flight.html").stat().st_size < 600_000
    says(
        shown,
        "alpha3 and alpha6 (-0.95)",
        "Measured, predicted, residual",
        "p rad/s 97.5",
        "Path",
        "alpha6, alpha3: -0.95",
    )
    _, shown = written(tmp_path / "vehicle.html", correlations=correlations)
    says(shown, "Residual: measured minus one-step prediction.")


def test_the_figure_says_how_strongly_each_axis_answers(tmp_path):
    found = synthetic_response()
    figure = frequency_responses(found, LOOK)
    low, high = found.roll.agreement().interval
    _, shown = written(tmp_path / "flight.html")
    says(shown, f"roll: 1.25 ({low:.2f} to {high:.2f}) times the model; pitch: 0.50 (", "yaw: no clear response.")
    for panel, values in ((0, found.roll.gain), (1, np.degrees(found.roll.phase)), (2, found.roll.coherence)):
        np.testing.assert_allclose(figure.panels[panel].marks[0].y, values)
    # What is not clear has no band and no strong line.
    _, band, line, _ = figure.panels[6].marks
    assert np.isnan([band.low, band.high, line.y]).all()


def test_the_vehicle_is_drawn_as_it_was_identified(tmp_path):
    names = ("alpha3", "alpha6", "roll_thrust", "pitch_thrust")
    values = dict(zip(names, (6e4, 5e4, -1.62, 2.7), strict=True))
    rows = {name: ParameterEstimate(x, 0.0, None, (x, x), "", "") for name, x in values.items()}
    covariance = np.diag(np.square([0.0, 0.0, 0.162, 0.27])).tolist()
    _, shown = written(tmp_path / "flight.html", parameters=rows, covariance=covariance)
    says(shown, "centre of mass, x 2.00 ± 0.39 mm, y 1.00 ± 0.20 mm (95 %)")
    place = (CenterOfMass("x", 2e-3, 2e-4), CenterOfMass("y", 1e-3, 1e-4))
    above, bars = vehicle(CRAZYFLIE, CONSTANTS, place, LOOK).panels
    # Rotor 1 is at the front on the right. The centre of mass is at the front on the left.
    assert [(each.x, each.y) for each in above.marks if isinstance(each, Words) and each.text == "1"] == [(28.0, 28.0)]
    cross = next(mark for mark in above.marks if isinstance(mark, Line) and mark.marker == "P")
    assert ([*cross.x], [*cross.y]) == ([-1.0], [2.0])
    # Seen from above, rotor 1 turns counter-clockwise and rotor 2 clockwise.
    arcs = [mark for mark in above.marks if isinstance(mark, Line) and len(mark.x) == 60]
    assert len(arcs) == 4
    for arc, (right, front), spin in zip(arcs[:2], ((28, 28), (28, -28)), (1, -1), strict=True):
        x, y = np.asarray(arc.x) - right, np.asarray(arc.y) - front
        assert (np.sign(x[:-1] * np.diff(y) - y[:-1] * np.diff(x)) == spin).all()
    assert [mark.x[1] for mark in bars.marks if isinstance(mark, Band)] == [CONSTANTS["Ix"].estimate]
    assert [mark.text for mark in bars.marks if isinstance(mark, Words)] == ["not identified"] * 2


CAREFUL = Verdict("identified with a reservation", "", ("it is known to 20 % only",))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "Ix: identified. Iz: refused (not identified)."),
        (
            {"verdicts": {"Ix": CAREFUL, "Iy": Verdict("identified"), "Iz": CAREFUL}},
            "Iy: identified. Ix, Iz: use with care.",
        ),
        ({"verdicts": {}}, "No quantity was judged."),
        ({"result": "implausible", "verdicts": WRONG}, "Ix: refused (contradicted)."),
        ({"result": "max_sweeps", "verdicts": {}}, "Not to be trusted: the search did not converge"),
        ({"result": "nonfinite_trajectory"}, "There is no answer: "),
    ],
)
def test_the_headline_has_every_quantity_and_is_that_of_the_terminal(changes, said):
    found = identified_vehicle(**changes)
    assert verdict(found).startswith(said)
    if found.verdicts and found.has_answer:
        assert printed(found).startswith(verdict(found))


def test_the_inertias_of_all_sample_times_are_shown(tmp_path):
    changes = {"sample_times": SAMPLE_TIMES, "provenance": {"sample_time": 0.008}}
    says(
        printed(identified_vehicle(**changes)),
        "sample times: 4 ms Ix 1.64e-05 Iy 1.8e-05, 8 ms Ix 1.78e-05 Iy 1.8e-05 (chosen), 16 ms Ix 1.8e-05 ",
    )
    _, shown = written(tmp_path / "flight.html", **changes)
    says(shown, "Moment of inertia against sample time")
    first, *_, last = inertias_by_sample_time(SAMPLE_TIMES, 0.008, LOOK).panels
    chosen, line, bars, _ = first.marks
    np.testing.assert_allclose(chosen.y, 1.78e-5)
    np.testing.assert_allclose(line.y, [1.64e-5, 1.78e-5, 1.8e-5])
    assert bars.y[4] - bars.y[3] == pytest.approx(2 * 1.96 * 2e-7, rel=1e-3)
    assert last.title == "Iz: not identified"


def test_names_cannot_break_out_of_the_page_and_an_older_one_is_kept_if_it_cannot_be_made(tmp_path):
    path = tmp_path / "flight.html"
    changes = {"title": EVIL, "estimator": EVIL, "held": {EVIL: FixedParameter(0.0, "1", EVIL)}}
    _, shown = written(path, **changes, provenance={"command": EVIL, "network": {"of": EVIL}, "notes": [EVIL]})
    assert shown.count("alert(1)") >= 6
    path.write_text("of before")
    with pytest.raises(AttributeError):
        write_flight_page(path, msgspec.structs.replace(identified_vehicle(), rigid_body=None), title="")
    assert path.read_text() == "of before"
    with pytest.raises(FileNotFoundError):
        write_flight_page(tmp_path / "none" / "a.html", identified_vehicle(), title="")
