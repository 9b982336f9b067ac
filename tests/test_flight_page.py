"""An identification as a page and as text: what they say, with and without predictions, with and without an answer."""

import html
import io
import re

import msgspec
import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console
from synthetic_identification import (
    COLOURED,
    CONSTANTS,
    WHITE,
    identified_flight,
    identified_vehicle,
    synthetic_predictions,
    synthetic_response,
)

from jaxos4.identification.results import HeldParameter, RigidBody, Validation
from jaxos4.report import print_identification, write_flight_page
from jaxos4.report.identification_page import frequency_responses, predicted_rates
from jaxos4.report.style import drawing, pdf, styles, svg

EVIL = "</script><script>alert(1)</script>"


def written(path, title="A flight", **changes):
    write_flight_page(path, identified_vehicle(**changes), title=title)
    text = path.read_text(encoding="utf-8")
    said = re.sub(r"<(script|style).*?</\1>|<[^>]+>", " ", text, flags=re.DOTALL)
    return text, " ".join(html.unescape(said).split())


def printed(found):
    console = Console(width=100, file=io.StringIO())
    print_identification(console, found)
    return " ".join(console.file.getvalue().split())


def test_the_page_says_what_was_found(tmp_path):
    text, said = written(tmp_path / "flight.html")
    for words in (
        "ibss, flight model, successful, 812 rollouts, 35.4 s, cost 1230",
        "57710 56710 to 58720 130",
        "alpha6 1/(kg m^2) – 2.0e6 not identifiable: not excited",
        "alpha1 1 -0.8125 held: not identifiable",
        "1.733e-5 1.704e-5 to 1.762e-5 if arms and mass are right",
        "p = 0.21",
        "377 starts",
        "0.248 0.73 ± 0.14 0.41 0.400 0.800",
        "0.5 s ahead",
        "Frequency response Measured angular acceleration over",
        "jaxos4 estimate flight.csv --model flight --report flight.html",
        "t is not uniform",
        "window 0.25",
    ):
        assert words in said, words
    # Nothing is fetched: no address outside scripts, but for the names of XML.
    outside = re.sub(r'<script>.*?</script>|xmlns(:\w+)?="[^"]*"', "", text, flags=re.DOTALL)
    assert not re.search(r"(src|href)=(?!\"#)|https?:|url\((?!#)", outside)


def test_the_figure_holds_the_predictions_and_a_band_of_95_percent():
    predicted = synthetic_predictions()
    figure = predicted_rates(predicted, 0.004, 1, styles(["ibss"])["ibss"])
    line, measured = (line.get_xydata() for line in figure.axes[1].lines)
    # A break between the stretches, and each prediction at the time that it is of.
    assert np.flatnonzero(np.isnan(line[:, 0])).tolist() == [80]
    keep = ~np.isnan(line[:, 0])
    np.testing.assert_allclose(line[keep, 0], 0.004 * predicted.start + 0.248)
    np.testing.assert_array_equal(line[keep, 1], predicted.predicted[:, 1, 1])
    np.testing.assert_array_equal(measured[keep, 1], predicted.measured[:, 1, 1])
    band = np.concatenate([path.vertices for path in figure.axes[1].collections[0].get_paths()])
    half = band[:, 1].max() - np.nanmax(line[:, 1])
    errors = np.abs(predicted.predicted - predicted.measured)[:, 1, 1]
    assert (errors <= half + 1e-9).mean() == pytest.approx(0.95, abs=0.015)


def test_the_figure_says_how_strongly_each_axis_answers():
    found = synthetic_response()
    with drawing():
        figure = frequency_responses(found, styles(["ibss"])["ibss"])
    low, high = found.roll.agreement().interval
    titles = [panel.get_title(loc="left") for panel in figure.axes[:3]]
    assert titles[0] == f"roll: 1.25 ({low:.2f} to {high:.2f}) times the model"
    assert titles[1].startswith("pitch: 0.50 (")
    assert titles[2] == "yaw: no clear response"
    for row, values in ((0, found.roll.gain), (3, np.degrees(found.roll.phase)), (6, found.roll.coherence)):
        np.testing.assert_allclose(figure.axes[row].lines[0].get_ydata(), values)
    # What is not clear has no band and no strong line.
    assert not figure.axes[2].collections[0].get_paths()
    assert np.isnan(np.asarray(figure.axes[2].lines[1].get_ydata(), dtype=float)).all()


def test_without_predictions_and_constants_the_page_leaves_them_out(tmp_path):
    changes = {"predictions": None, "skill": None, "response": None, "rigid_body": RigidBody()}
    text, said = written(tmp_path / "flight.html", **changes)
    for words in ("Measured against predicted", "Skill", "Constants", "Frequency response"):
        assert words not in said
    assert len(text) < 100_000


def test_names_cannot_break_out_of_the_page(tmp_path):
    text, said = written(
        tmp_path / "flight.html",
        title=EVIL,
        estimator=EVIL,
        held={EVIL: HeldParameter(0.0, "1", EVIL)},
        provenance={"command": EVIL, "flight": {"of": EVIL}, "notes": [EVIL]},
    )
    assert "<script>alert" not in text
    assert text.count("<script") == text.count("</script") == 1
    assert said.count("alert(1)") >= 6


def test_an_older_page_is_kept_if_the_new_one_cannot_be_made(tmp_path):
    path = tmp_path / "flight.html"
    path.write_text("of before")
    with pytest.raises(KeyError):
        write_flight_page(path, msgspec.structs.replace(identified_vehicle(), provenance={}), title="")
    assert path.read_text() == "of before"
    with pytest.raises(FileNotFoundError):
        write_flight_page(tmp_path / "none" / "a.html", identified_vehicle(), title="")


def test_the_text_of_a_flight():
    text = printed(identified_flight())
    for words in (
        "alpha3 1/(kg m^2) 57712 [56709, 58716] 1.3e+02",
        "alpha6 1/(kg m^2) - - - not identifiable: not excited",
        "cannot be distinguished from 0.",
        "multiple of the noise: alpha2 0.25.",
        "p 97.5, q 81.3",
        "The residuals of q are not white noise: the model does not explain",
        "residuals white (Ljung-Box), tests at 1%: not those of q.",
        "residuals free of the inputs (cross-correlation), tests at 1%: not those of q.",
        "Ix 1.733e-05 +- 2.9e-07, J_R below noise; the alphas agree with one rigid body, p = 0.21.",
        "validation on other.csv [%] (residuals in multiples of the noise): p 81.3 (2).",
        "ibss, published model, rates channels: successful, 812 rollouts, 35.4 s",
    ):
        assert words in text, words
    clean = printed(identified_flight(fit={"p": WHITE}, validation=None, provenance={"windows": 4}))
    for words in ("white noise", "Ljung-Box", "validation"):
        assert words not in clean
    assert "tests at 1%: all." in clean


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"estimator": "network", "fit": {"q": COLOURED}}, "The hybrid continues the search"),
        (
            {"rigid_body": RigidBody(CONSTANTS, 1e-4, True)},
            "not those of one rigid body",
        ),
        ({"rigid_body": RigidBody(CONSTANTS, 0.5, False)}, "no rigid body has such"),
        ({"validation": Validation("other.csv", None, None)}, "trajectory diverges before the flight ends"),
    ],
)
def test_the_text_of_a_flight_warns(changes, words):
    assert words in printed(identified_flight(**changes))


def test_without_an_answer_the_text_says_why():
    lost = printed(identified_flight(result="nonfinite_trajectory"))
    assert "No estimate" in lost
    assert "(try --window" in lost
    assert "--window" not in printed(identified_flight(result="nonfinite_trajectory", estimator="rls"))
    assert printed(identified_flight(result="bracket_invalid")) == ""
    assert printed(identified_vehicle(result="nonfinite_trajectory")) == "note: t is not uniform"


def test_the_text_of_a_vehicle():
    text = printed(identified_vehicle())
    for words in (
        "alpha3 1/(kg m^2) 5.771e+04 [5.671e+04, 5.872e+04]",
        "held, not identifiable: alpha1 -0.8125.",
        "Ix 1.733e-05 +- 2.9e-07 (if arms and mass are right)",
        "p 0.41; the intervals allow for their correlation. Outliers cut: 22 %",
        "(377 starts)",
        "0.25 s 0.73 +- 0.14 0.73 +- 0.14 0.73 +- 0.14 0.41, 0.41, 0.41",
        "0.50 s - +- -",
        "flight model (offset, damping), 32 s in windows of 0.25 s, a sample every 4 ms: successful, 812 rollouts",
    ):
        assert words in text, words
    assert "Predictions" not in printed(identified_vehicle(skill=None))


def test_a_figure_with_an_image_has_the_same_bytes_again():
    with drawing():
        figure = Figure()
        figure.add_subplot().imshow(np.arange(16.0).reshape(4, 4))
        assert [svg(figure), pdf(figure)] == [svg(figure), pdf(figure)]
