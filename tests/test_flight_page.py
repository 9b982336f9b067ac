"""The report of one flight: what it says with and without predictions, and how it looks in chromium."""

import html.parser
import json
import os
import re
import shutil

import numpy as np
import pytest

from jaxos4 import Predictions
from jaxos4.report import write_flight_page

NAMES = ("chromium", "chromium-browser", "google-chrome")
BACKGROUND = {"light": "rgb(255, 255, 255)", "dark": "rgb(22, 25, 29)"}
EVIL = "</script><script>alert(1)</script>"


def synthetic_report():
    row = {"unit": "1/(kg m^2)", "noise_limit": None}
    told = {"estimate": 57712.3, "std": 512.0, "bound": 130.0, "ci95": [56708.8, 58715.8], "note": ""}
    untold = {"estimate": None, "std": None, "bound": 2e6, "ci95": None, "note": "not identifiable from this flight"}
    each = {"skill": [0.91, 0.731, None], "std": [0.02, 0.14, None], "rmse": [0.2, 0.4, None]}
    return {
        "estimator": "ibss",
        "model": "flight",
        "result": "successful",
        "rollouts": 812,
        "cost": 1234.5,
        "seconds": 35.4,
        "parameters": {"alpha3": row | told, "alpha6": row | untold},
        "held": {"alpha1": {"value": -0.8125, "note": "not identifiable from these flights"}},
        "constants": {"Ix": {"estimate": 1.733e-5, "std": 1.5e-7, "unit": "kg m^2"}, "consistency_p": 0.21},
        "skill": {
            "horizons": [0.1, 0.248, 0.5],
            "starts": 377,
            **{rate: each | {"persistence": [0.7, 0.8, 0.9]} for rate in "pqr"},
        },
        "provenance": {
            "command": "jaxos4 estimate flight.csv --model flight --report flight.html",
            "flight": "flight.csv",
            "sample_time": 0.004,
            "windows": 80,
            "notes": ["t is not uniform"],
        },
    }


def synthetic_predictions(starts=160):
    start = 5 + 12 * np.arange(starts)
    start[starts // 2 :] += 300  # the next stretch
    horizons = np.array([0.1, 0.248, 0.5])
    time = 0.004 * start[:, None, None] + horizons[:, None] + 0.7 * np.arange(3)
    measured = np.sin(3 * time)
    measured[3, 1, 0] = np.nan
    predicted = np.sin(3 * time) + 0.3 * horizons[:, None] * np.cos(40 * time)
    return Predictions(start, horizons, np.sin(3 * time[:, 0]), predicted, measured)


class Words(html.parser.HTMLParser):
    """The page's text, without scripts and styles."""

    def __init__(self, text: str):
        super().__init__()
        self.said, self.inside = [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.inside = tag if tag in ("script", "style") else self.inside

    def handle_endtag(self, tag):
        self.inside = "" if tag == self.inside else self.inside

    def handle_data(self, data):
        if not self.inside:
            self.said.append(data)


def written(path, **arguments):
    given = {"report": synthetic_report(), "predicted": synthetic_predictions(), "title": "A flight"} | arguments
    write_flight_page(path, **given)
    text = path.read_text(encoding="utf-8")
    return text, " ".join(" ".join(Words(text).said).split())


def chart_of(text):
    return json.loads(re.search(r'id="charts">(.*?)</script>', text, re.DOTALL).group(1))


def test_it_says_what_the_report_holds(tmp_path):
    text, said = written(tmp_path / "flight.html")
    for words in (
        "ibss, flight model, successful, 812 rollouts, 35.4 s, cost 1230",
        "57710 56710 to 58720 130",
        "alpha6 1/(kg m^2) – 2.0e6 not identifiable from this flight",
        "alpha1 -0.8125 held: not identifiable from these flights",
        "1.733e-5 1.704e-5 to 1.762e-5",
        "p = 0.21",
        "377 starts",
        "0.248 0.73 ± 0.14 0.400 0.800",
        "jaxos4 estimate flight.csv --model flight --report flight.html",
        "t is not uniform",
        "windows 80",
    ):
        assert words in said, words
    # Nothing is fetched: no address in what is not a script.
    outside = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    assert not re.search(r"(src|href)=(?!\"#)|https?:|url\(", outside)


def test_the_chart_holds_the_predictions(tmp_path):
    predicted = synthetic_predictions()
    chart = chart_of(written(tmp_path / "flight.html")[0])["predictions"]
    assert [choice["label"] for choice in chart["choices"]] == ["0.1 s ahead", "0.248 s ahead", "0.5 s ahead"]
    assert chart["chosen"] == 1
    traces = chart["choices"][1]["panels"][1]["traces"]
    named = {trace["name"]: trace for trace in traces}
    line = named["predicted"]
    # A break between the stretches, and the numbers that were predicted at the time that they are of.
    assert line["y"].count(None) == 1
    at = 200 % len(predicted.start)
    assert line["y"][at + (at >= 80)] == pytest.approx(predicted.predicted[at, 1, 1], abs=1e-5)
    assert line["x"][at + (at >= 80)] == pytest.approx(0.004 * predicted.start[at] + 0.248, abs=1e-4)
    bands = [trace for trace in traces if trace["name"] == "95 % band"]
    assert len(bands) == 2
    # The band's half-width holds 95 % of the errors.
    half = bands[0]["y"][0] - line["y"][0]
    errors = np.abs(predicted.predicted - predicted.measured)[:, 1, 1]
    assert (errors <= half + 1e-5).mean() == pytest.approx(0.95, abs=0.015)


def test_without_predictions_there_is_no_chart(tmp_path):
    text, said = written(tmp_path / "flight.html", predicted=None)
    assert "Measured against predicted" not in said
    assert chart_of(text) == {}
    assert len(text) < 100_000


def test_what_is_absent_is_left_out(tmp_path):
    _, said = written(tmp_path / "flight.html", report={"estimator": "ibss", "parameters": {}}, predicted=None)
    assert "Skill" not in said
    assert "Constants" not in said


def test_the_skill_of_equation_error_has_a_column(tmp_path):
    report = synthetic_report()
    for rate in "pqr":
        report["skill"][rate]["equation_error"] = [0.5, 0.41, None]
    _, said = written(tmp_path / "flight.html", report=report)
    assert "0.248 0.73 ± 0.14 0.41 0.400 0.800" in said


def test_names_cannot_break_out_of_the_page(tmp_path):
    report = synthetic_report()
    report |= {"estimator": EVIL, "held": {EVIL: {"value": 0.0, "note": EVIL}}}
    report["provenance"] |= {"command": EVIL, "flight": {"of": EVIL}, "notes": [EVIL]}
    text, said = written(tmp_path / "flight.html", report=report, title=EVIL)
    assert "<script>alert" not in text
    assert text.count("<script") == text.count("</script") == 3
    assert said.count("alert(1)") >= 6


def test_an_older_page_stays_where_the_new_one_cannot_be_made(tmp_path):
    path = tmp_path / "flight.html"
    path.write_text("of before")
    with pytest.raises(AttributeError):
        write_flight_page(path, report={"parameters": {"alpha1": None}}, predicted=None, title="")
    assert path.read_text() == "of before"
    with pytest.raises(FileNotFoundError):
        write_flight_page(tmp_path / "none" / "a.html", report=synthetic_report(), predicted=None, title="")


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = os.environ.get("JAXOS4_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip("no chromium: install one (apt-get install chromium), or set JAXOS4_CHROMIUM to its path")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [375, 1280])
@pytest.mark.parametrize("charted", [True, False])
def test_it_fits_the_screen_and_logs_nothing(browser, tmp_path, width, scheme, charted):
    path = tmp_path / "flight.html"
    written(path, **({} if charted else {"predicted": None}))
    heard = []
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page = context.new_page()
    page.on("console", lambda message: heard.append(message.text))
    page.on("pageerror", lambda error: heard.append(str(error)))
    page.on("request", lambda request: request.url == path.as_uri() or heard.append(request.url))
    page.goto(path.as_uri())
    if charted:
        box = page.locator("[data-chart='predictions']")
        box.scroll_into_view_if_needed()
        box.locator(".main-svg").first.wait_for()
        assert box.bounding_box()["width"] <= width
        assert set(box.evaluate("box => box._fullData.map(t => t.name)")) == {"measured", "predicted", "95 % band"}
        read = "box => box._fullData.find(t => t.name === 'predicted').y[5]"
        before = box.evaluate(read)
        page.get_by_label("Shown:").select_option(label="0.5 s ahead")
        assert box.evaluate(read) != before
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == BACKGROUND[scheme]
    page.get_by_role("button").filter(has_text="Dark" if scheme == "light" else "Light").click()
    other = {"light": "dark", "dark": "light"}[scheme]
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == BACKGROUND[other]
    context.close()
    assert [line for line in heard if not line.startswith(("blob:", "data:"))] == []
