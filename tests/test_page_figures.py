"""The figures of an identification's page: nothing outside of an axis, a legend for each line, names for each mark."""

import json

import msgspec
import numpy as np
import pytest
from pages import assert_inside, page_of, printed, says
from synthetic_identification import (
    CONSTANTS,
    KNOWN,
    behind_an_estimate,
    identified_flight,
    identified_vehicle,
    synthetic_response,
    vehicle_traces,
)

from jaxos4.identification.results import Constant, RigidBody
from jaxos4.report.identification_figures import correlation_matrix, frequency_responses, priors, residual_figure
from jaxos4.report.identification_signals import identified_signals
from jaxos4.report.panels import Line, Words, styles

LOOK = styles(["ibss"])["ibss"]


@pytest.mark.parametrize("far", [3.0, 60.0])
def test_every_parameter_is_inside_the_axis_of_the_brackets(far):
    low, high = 0.0, 2.0  # the centre is 1, and half of the width is 1
    at = 1.0 + far
    row = msgspec.structs.replace(KNOWN, bracket=(low, high), estimate=at, ci95=(at - 0.5, at + 0.5))
    near = msgspec.structs.replace(row, estimate=1.0, ci95=(0.9, 1.1))
    (panel,) = priors(identified_vehicle(parameters={"alpha8": row, "alpha3": near}), LOOK).panels
    interval, points = (mark for mark in panel.marks if isinstance(mark, Line) and len(mark.x))
    np.testing.assert_allclose(interval.x[[0, 1, 3, 4]], [far - 0.5, far + 0.5, -0.1, 0.1], atol=1e-12)
    np.testing.assert_allclose(points.x, [far, 0], atol=1e-12)
    assert panel.x.ends[1] > far + 0.5
    assert panel.x.kind == ("symlog" if far > 5 else "linear")
    assert {"-1", "0", "1"} <= {*panel.x.labelled()[0].values()}
    assert_inside(panel)


def test_the_gain_has_the_mean_that_the_verdict_is_about_and_an_axis_that_shows_it():
    found = synthetic_response()
    figure = frequency_responses(found, LOOK)
    for place, axis in ((0, found.roll), (3, found.pitch)):
        panel, mean = figure.panels[place], axis.agreement()
        bar = next(mark for mark in panel.marks if mark.name == "mean gain with its 95 % interval")
        assert (list(bar.x), list(bar.y)) == ([mean.low, mean.high], [mean.ratio] * 2)
        low, high = panel.y.ends
        assert low < mean.interval[0] < mean.interval[1] < high
        assert high / low < 10
    assert figure.panels[6].y.ends == (0.5, 2.0)
    assert {*figure.legend()} >= {"measured / modelled", "model", "not clear"}


def test_residuals_have_a_legend_and_both_signs_on_their_axes():
    figure = residual_figure(behind_an_estimate()["correlations"])
    assert [*figure.legend()] == ["95 % by chance", "roll torque", "pitch torque", "yaw torque"]
    for panel in figure.panels:
        assert len(panel.y.labelled(2)[0]) >= 2


def test_each_row_and_column_of_the_correlations_has_its_name():
    (panel,) = correlation_matrix(identified_flight(**behind_an_estimate()), LOOK).panels
    assert [(each.text, each.y) for each in panel.marks if isinstance(each, Words)] == [("alpha3", 0), ("alpha6", 1)]
    (pair,) = (mark for mark in panel.marks if isinstance(mark, Line) and mark.hollow)
    assert (pair.tip, [*pair.x], [*pair.y]) == ("alpha6, alpha3: -0.95", [0], [1])


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


def test_much_widened_intervals_are_a_warning(tmp_path):
    found = identified_vehicle(widened={"alpha3": 1.7, "alpha6": 2.4, "rotor_lag": 4.9})
    said = "warning: parts of the flight disagree, so that intervals were widened 2.4 to 4.9 times: alpha6, rotor_lag."
    for text in (found.summary(width=400), page_of(found, tmp_path / "flight.html")):
        says(text, said, "The model lacks an effect.")
    several = identified_vehicle(widened=found.widened, provenance={"flights": ["a.csv", "b.csv"]})
    says(several.summary(width=400), "The model lacks an effect, or the flights are not of one vehicle.")
    assert "warning" not in printed(identified_vehicle(widened={"alpha3": 1.9}))


def test_a_moment_of_inertia_below_noise_has_no_value(tmp_path):
    body = RigidBody(CONSTANTS | {"J_R": Constant(-2.83, 9.0, "kg m^2")}, 0.2, True)
    text = page_of(identified_flight(rigid_body=body), tmp_path / "flight.html")
    says(text, "J_R kg m^2 – -20.47 to 14.81 below noise")
    assert "-2.83" not in text
