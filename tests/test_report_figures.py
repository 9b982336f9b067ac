"""Figures as SVG: the numbers that they show, and nothing outside of the axes."""

import itertools
import re
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest
from helpers import CRAZYFLIE
from pages import assert_inside
from sign_flights import flown
from synthetic_identification import (
    KNOWN,
    SAMPLE_TIMES,
    behind_an_estimate,
    identified_flight,
    identified_vehicle,
    synthetic_response,
)
from synthetic_study import synthetic_study

from jaxos4 import compare_results
from jaxos4.analysis.inertia import CenterOfMass
from jaxos4.report import identification_figures, study_figures
from jaxos4.report.comparison import forest
from jaxos4.report.log_figures import motors, spectra
from jaxos4.report.panels import INK, Band, Figure, Line, Panel, Scale, Words, spread, styles
from jaxos4.report.study_tables import scenarios
from jaxos4.report.svg import as_file, inline

LOOK = styles(["ibss"])["ibss"]


def drawn(panel):
    """The elements of the file of one panel: its texts with their places, and the points of each path in the axes."""
    root = ElementTree.fromstring(as_file(Figure("one", [panel])).encode())
    tag = "{http://www.w3.org/2000/svg}"
    texts = {text.text: (float(text.get("x")), float(text.get("y"))) for text in root.iter(f"{tag}text")}
    inside = next(group for group in root.iter(f"{tag}g") if group.get("clip-path"))
    area = next(root.iter(f"{tag}clipPath"))[0]
    paths = [
        np.array(re.findall(r"-?[\d.]+", path.get("d")), dtype=float).reshape(-1, 2)
        for path in inside.iter(f"{tag}path")
    ]
    return texts, paths, (float(area.get("width")), float(area.get("height")))


@pytest.mark.parametrize("kind", ["linear", "log"])
def test_points_are_where_the_labels_of_the_axes_say(kind):
    x, y = np.array([1.0, 2.0, 5.0, 10.0]), np.array([3.0, 0.5, 40.0, 7.0])
    ticks = {each: f"{each:g}" for each in (1.0, 10.0)}
    ends = (0.5, 20.0)
    panel = Panel(
        "Title", [Line(x, y)], Scale(kind, ends, ticks), Scale(kind, (0.1, 50.0), {0.5: "half", 40.0: "forty"})
    )
    texts, (path,), (width, height) = drawn(panel)
    along = np.log10 if kind == "log" else np.asarray
    for column, values, labels, of in ((0, x, ("1", "10"), (1.0, 10.0)), (1, y, ("half", "forty"), (0.5, 40.0))):
        at = [texts[label][column] - 4 * column for label in labels]  # labels of y are 4 pixels lower than their lines
        expected = np.interp(along(values), along(of), at, left=None)
        slope = (at[1] - at[0]) / (along(of[1]) - along(of[0]))
        expected = at[0] + slope * (along(values) - along(of[0]))
        np.testing.assert_allclose(path[:, column], expected, atol=0.11)
    assert ((path >= 0) & (path <= (width, height))).all()
    assert texts["Title"][1] < 0


def test_a_line_breaks_and_a_band_has_parts_where_nothing_is_known():
    x, gap = np.arange(6.0), np.array([1.0, 2.0, np.nan, 3.0, np.nan, 4.0])
    file = as_file(Figure("one", [Panel("", [Line(x, gap), Band(x, gap - 1, gap + 1)])]))
    line, band = re.findall(r'd="(M[^"]*)"', file.split("clip-path=")[1])
    assert line.count("M") == 3
    assert (band.count("M"), band.count("z")) == (3, 3)
    assert "nan" not in file
    assert "inf" not in as_file(Figure("one", [Panel("", [Line((-np.inf, np.inf), (1, 1)), Line(x, x)])]))


def test_what_is_outside_of_an_axis_is_cut_off_and_does_not_grow_without_bound():
    panel = Panel("", [Line((0.0, 1.0, 1e12), (0.0, 1e30, 1.0))], Scale(ends=(0.0, 1.0)), Scale(ends=(0.0, 1.0)))
    _, (path,), size = drawn(panel)
    assert np.abs(path).max() < 20 * max(size)
    text = as_file(Figure("one", [panel]))
    assert re.search(r'<clipPath id="(\S+)">.*clip-path="url\(#\1\)"', text)


EXTREME = (0.0, -1e30, 1e30, 1e-320, 5e-324, 1.0, np.nan, np.inf, -np.inf, 3e15, 3e15 + 1)  # a result has up to 1e30


@pytest.mark.parametrize("kind", ["linear", "log", "symlog"])
def test_no_number_of_a_result_spoils_a_figure(kind):
    scale = Scale(kind, (-5.0, 5.0) if kind == "symlog" else None)
    for a, b in itertools.product(EXTREME, EXTREME):
        marks = [Line([a, b], [b, a], marker="o"), Band([a, b], [a, a], [b, b])]
        text = as_file(Figure("one", [Panel("", marks, scale, scale)]))
        assert not re.search("nan|inf", text), (a, b)


@pytest.mark.parametrize("low", [0.04, 0.62, 0.84, 0.99])
@pytest.mark.parametrize("high", [1.01, 1.6, 3.4, 12.0, 29.0, 5e3])
def test_a_logarithmic_axis_has_a_tick_at_1_where_that_is_in_sight(low, high):
    ticks, power = Scale("log", (low, high)).labelled()
    assert any(np.isclose(at, 1) and text == "1" for at, text in ticks.items())
    assert 1 < len(ticks) < 13
    assert power == 0


@pytest.mark.parametrize("middle", [0.0, 1.7e-5, -3.2, 1013.0, 2.5e7])
@pytest.mark.parametrize("width", [1e-6, 0.37, 90.0, 4e6])
def test_labels_of_an_axis_differ_and_are_their_ticks(middle, width):
    ticks, power = Scale(ends=(middle - width, middle + width)).labelled()
    assert 3 <= len(ticks) <= 8
    if width > 1e-4 * abs(middle):
        assert len({*ticks.values()}) == len(ticks)
        for at, text in ticks.items():
            assert float(f"{text}e{power}") == pytest.approx(at, abs=1e-3 * width)


def test_a_name_is_text_and_each_bar_has_its_ends():
    evil = "</text><script>alert(1)</script> & $x$"
    marks = [spread([1.0], [0.0], [2.0], name=evil, group=0, tip=evil), Words(1.0, 1.0, evil)]
    figure = Figure("one", [Panel(evil, marks, Scale(label=evil))])
    for text in (as_file(figure), inline(figure, evil)):
        assert "<script" not in text
        assert text.count("&lt;script&gt;") >= 4
    (bar,) = (mark for mark in marks if isinstance(mark, Line))
    np.testing.assert_array_equal(bar.y, [0, 2, np.nan])
    assert "<title>&lt;/text&gt;" in inline(figure, "")


def test_colours_follow_the_theme_but_not_in_texts():
    drawn = inline(Figure("one", [Panel(INK, [Line((0, 1), (0, 1), name=f'fill="{INK}"')])]), INK)
    assert f'aria-label="{INK}"' in drawn
    assert f">{INK}</text>" in drawn
    assert f"fill=&#34;{INK}&#34;" in drawn
    assert 'stroke="currentColor"' in drawn
    assert f'stroke="{INK}"' not in drawn


def of_pages():
    """A figure of each kind, of data that nobody computed."""
    vehicle, os4 = identified_vehicle(sample_times=SAMPLE_TIMES), identified_flight(**behind_an_estimate())
    made = identification_figures
    yield made.vehicle(CRAZYFLIE, vehicle.rigid_body.constants, [CenterOfMass("x", 2e-3, 2e-4)], LOOK)
    yield made.inertias_by_sample_time(SAMPLE_TIMES, 0.008, LOOK)
    yield made.priors(os4, LOOK)
    yield made.residual_figure(os4.correlations)
    yield made.path(os4.traces, LOOK)
    yield made.correlation_matrix(os4, LOOK)
    yield forest(compare_results([vehicle, vehicle]), LOOK)
    log = flown(CRAZYFLIE, 0)
    yield motors([log], float(CRAZYFLIE.max_rotor_speed))
    yield spectra([log], (10.0, 20.0))
    ((_, study),) = scenarios(synthetic_study(flights=8))
    ((_, one),) = scenarios(synthetic_study(flights=1, spoiled=False))
    drawn = study_figures.draw(study) | study_figures.draw(one)
    assert drawn.keys() == study_figures.FIGURES.keys()
    yield from drawn.values()


def test_no_mark_of_a_page_is_outside_of_its_axes_and_each_series_has_a_name():
    for figure in of_pages():
        for panel in figure.panels:
            assert_inside(panel)
        colors = {mark.color for panel in figure.panels for mark in panel.marks if isinstance(mark, Line)}
        assert figure.legend() or len(colors) <= 4, figure.stem
        ElementTree.fromstring(as_file(figure))
        assert as_file(figure) == as_file(figure)


@pytest.mark.parametrize("far", [3.0, 60.0])
def test_every_parameter_is_inside_the_axis_of_the_brackets(far):
    low, high = 0.0, 2.0  # the centre is 1, and half of the width is 1
    at = 1.0 + far
    row = msgspec.structs.replace(KNOWN, bracket=(low, high), estimate=at, ci95=(at - 0.5, at + 0.5))
    near = msgspec.structs.replace(row, estimate=1.0, ci95=(0.9, 1.1))
    (panel,) = identification_figures.priors(
        identified_vehicle(parameters={"alpha8": row, "alpha3": near}), LOOK
    ).panels
    interval, points = (mark for mark in panel.marks if isinstance(mark, Line) and len(mark.x))
    np.testing.assert_allclose(interval.x[[0, 1, 3, 4]], [far - 0.5, far + 0.5, -0.1, 0.1], atol=1e-12)
    np.testing.assert_allclose(points.x, [far, 0], atol=1e-12)
    assert panel.x.ends[1] > far + 0.5
    assert panel.x.kind == ("symlog" if far > 5 else "linear")
    assert {"-1", "0", "1"} <= {*panel.x.labelled()[0].values()}
    assert_inside(panel)


def test_the_gain_has_the_mean_that_the_verdict_is_about_and_an_axis_that_shows_it():
    found = synthetic_response()
    figure = identification_figures.frequency_responses(found, LOOK)
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
    figure = identification_figures.residual_figure(behind_an_estimate()["correlations"])
    assert [*figure.legend()] == ["95 % by chance", "roll torque", "pitch torque", "yaw torque"]
    for panel in figure.panels:
        assert len(panel.y.labelled(2)[0]) >= 2


def test_each_row_and_column_of_the_correlations_has_its_name():
    (panel,) = identification_figures.correlation_matrix(identified_flight(**behind_an_estimate()), LOOK).panels
    assert [(each.text, each.y) for each in panel.marks if isinstance(each, Words)] == [("alpha3", 0), ("alpha6", 1)]
    (pair,) = (mark for mark in panel.marks if isinstance(mark, Line) and mark.hollow)
    assert (pair.tip, [*pair.x], [*pair.y]) == ("alpha6, alpha3: -0.95", [0], [1])
