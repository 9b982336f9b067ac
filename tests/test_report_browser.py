"""The reports as a reader sees them: in chromium, on a phone, a tablet and a desktop, in light and in dark."""

import os
import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import CRAZYFLIE
from pages import CARDS, CUT, DRAWN, TEXTS, WIDE, WIDTHS, overlapping, stands_alone, without_matplotlib
from sign_flights import flown
from synthetic_identification import (
    SAMPLE_TIMES,
    behind_an_estimate,
    identified_flight,
    identified_vehicle,
    synthetic_traces,
)
from synthetic_study import ESTIMATORS, synthetic_study

from jaxos4 import PublishedOS4, compare_results
from jaxos4.design import Design
from jaxos4.design.task import Designed
from jaxos4.report import write_comparison, write_flight_page, write_log_page, write_report
from jaxos4.report.design import write_design_figure

pytestmark = pytest.mark.slow

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

NAMES = ("chromium", "chromium-browser", "google-chrome")
BACKGROUND = {"light": "rgb(255, 255, 255)", "dark": "rgb(22, 25, 29)"}


def synthetic_design(kind, names, units, history):
    """A design of four inputs that nobody computed, for `names` with `units`, beside a multisine."""
    count, time = len(names), np.arange(501)[:, None]
    inputs = 200 + 40 * np.sin(0.05 * time * np.arange(1, 5))
    root = np.sqrt(np.maximum(time, 1))
    made = [Designed(inputs + k, 0.01, (1 + k) * bounds, {}, 5.0, history and (1 + k) * bounds * 22 / root)
            for k, bounds in enumerate(2 * [np.geomspace(1e-6, 1e3, count)])]  # fmt: skip
    scale, unexcited = 50 * np.geomspace(1e-6, 1e3, count), np.full(count, 1e9)
    task = SimpleNamespace(kind=kind, names=names, units=units, scale=scale, unexcited=unexcited, vehicles=8)
    return Design(task, made[0], {"multisine": made[1]})


ALPHAS = tuple(f"alpha{i}" for i in range(1, 9))
DESIGNS = {
    "design": ("rotor speeds", ALPHAS, PublishedOS4().parameter_units, True),
    "references": ("references", ("Ix", "Iy", "Iz"), ("kg m^2",) * 3, None),
}


LONG = "A_flight_with_a_long_name_of_2026-11-24.csv"


def two_logs():
    log, time = np.repeat([0, 1], 100), 0.02 * np.arange(200)
    traces = synthetic_traces(time, log, np.ones((200, 3)))
    return identified_vehicle(predictions=None, traces=traces, provenance={"flights": ["first.csv", "other.csv"]})


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A page of each kind, made without matplotlib."""
    folder, flight = tmp_path_factory.mktemp("report"), flown(CRAZYFLIE, 0)
    found = {
        "vehicle": identified_vehicle(sample_times=SAMPLE_TIMES),
        "without predictions": identified_vehicle(predictions=None),
        "os4": identified_flight(**behind_an_estimate()),
        "two logs": two_logs(),
    }
    long = [identified_vehicle(provenance={"flights": [f"A_flight_with_a_long_name_{i}.csv"]}) for i in range(4)]
    study = synthetic_study(flights=12, estimators=tuple(ESTIMATORS), scales=(0.1, 1.0))
    (folder / "one").mkdir()
    names = [*found, "log", "late", "comparison"]
    files = {name: folder / f"{name}.html" for name in names} | {name: folder / f"{name}.svg" for name in DESIGNS}
    with pytest.MonkeyPatch.context() as patch:
        without_matplotlib(patch)
        files["study"] = write_report(study, folder)[0]
        files["one flight"] = write_report(study.isel(flight=[0], estimator=slice(4)), folder / "one")[0]
        for name, each in found.items():
            write_flight_page(files[name], each, title=LONG)
        write_log_page(files["log"], flight, CRAZYFLIE)
        write_log_page(files["late"], flight._replace(time=1234.3 + flight.time), CRAZYFLIE)
        write_comparison(files["comparison"], compare_results(long))
        for name, given in DESIGNS.items():
            write_design_figure(files[name], synthetic_design(*given), 0.01)
    return files


@pytest.fixture(scope="module")
def addresses(files):
    return {name: path.as_uri() for name, path in files.items()}


def test_pages_and_their_figures_are_made_without_matplotlib(files):
    for name, path in files.items():
        text = path.read_text(encoding="utf-8")
        assert "<svg" in text, name
        if name not in DESIGNS:
            stands_alone(text)


@pytest.fixture(scope="module")
def browser():
    path = os.environ.get("JAXOS4_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip("no chromium: install one (apt-get install chromium), or set JAXOS4_CHROMIUM to its path")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def opened(browser, addresses):
    """Opens a page; whatever it logs or asks the network for fails the test at its end."""
    said, contexts = [], []

    def open_page(name="study", width=1280, scheme="light"):
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: request.url == addresses[name] or said.append(request.url))
        page.goto(addresses[name])
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert said == []


@pytest.fixture
def drawn(opened):
    """Opens a page that keeps the texts that it draws on canvases, each with the place of its canvas."""

    def open_page(name):
        page = opened(name)
        page.evaluate(DRAWN)
        return page

    return open_page


@pytest.mark.parametrize("width", [390, 720, 768, 1280])  # 720: a sheet of paper
@pytest.mark.parametrize("name", ["study", "one flight", "vehicle", "os4", "log", "comparison", *DESIGNS])
def test_nothing_overlaps_or_scrolls_sideways(opened, name, width):
    page = opened(name, width)
    page.evaluate("document.querySelectorAll('details').forEach(each => { each.open = true; })")
    assert page.evaluate("document.scrollingElement.scrollWidth") <= width
    assert page.evaluate(WIDE) == []
    texts = page.evaluate(TEXTS)
    assert len(texts) > 20
    assert all(-1 <= left and right <= width + 1 for _, left, _, right, _ in texts)
    assert overlapping(texts) == []
    assert page.evaluate(CUT) == []
    for drawn, natural in page.locator(".panels svg").evaluate_all(WIDTHS):
        assert drawn >= 0.74 * natural  # letters of 12 pixels keep at least 8.9


@pytest.mark.parametrize("name", ["study", "one flight", "vehicle", "os4", "log", "comparison"])
def test_cards_on_a_phone_name_each_value_as_the_table_does(opened, name):
    """With the unit. The name of a row stands alone, unless it is a number."""
    found = opened(name, 390).evaluate(CARDS)
    assert len(found) > 20
    assert [each for each in found if each[0] != each[1] and (each[1] or each[2].isdigit())] == []


@pytest.mark.parametrize("name", ["vehicle", "log"])
def test_signals_fit_on_paper(opened, name):
    """A sheet is narrower than the window in which the signals were drawn."""
    page = opened(name)
    page.emulate_media(media="print")
    page.evaluate("document.body.style.width = '720px'")
    boxes = page.locator("#timeline canvas").evaluate_all(
        "all => all.map(each => each.getBoundingClientRect().toJSON())"
    )
    assert len(boxes) >= 2
    assert all(box["right"] <= 720 for box in boxes)
    assert all(box["width"] > 600 for box in boxes)
    assert overlapping(page.evaluate(TEXTS)) == []


def test_texts_that_overlap_are_found(opened):
    page = opened("os4")
    page.evaluate("document.querySelector('h2').style.marginBottom = '-1.5rem'")
    assert overlapping(page.evaluate(TEXTS))
    page = opened("vehicle")
    page.evaluate("(text => text.after(text.cloneNode(true)))(document.querySelector('#figure-response .panels text'))")
    assert overlapping(page.evaluate(TEXTS))


@pytest.mark.parametrize("name", ["study", "vehicle", "without predictions"])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_follows_the_theme(opened, name, scheme):
    page = opened(name, scheme=scheme)
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == BACKGROUND[scheme]
    page.evaluate("dispatchEvent(new Event('beforeprint'))")  # paper is white
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == BACKGROUND["light"]
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    page.get_by_role("button").filter(has_text="Dark" if scheme == "light" else "Light").click()
    other = {"light": "dark", "dark": "light"}[scheme]
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == BACKGROUND[other]


def test_a_checkbox_hides_an_estimator_everywhere(opened):
    page = opened()
    assert page.locator("tr[data-estimator='1']").count() == 5 * 2
    for figure in ("overview", "error", "efficiency", "coverage"):
        assert page.locator(f"#figure-{figure} [data-estimator='1']").count() > 1, figure
    shown = """place => [...document.querySelectorAll(`[data-estimator="${place}"]`)]
        .map(element => getComputedStyle(element).display !== "none")"""
    page.get_by_role("checkbox", name="network").uncheck()
    assert not any(page.evaluate(shown, 1))
    assert all(page.evaluate(shown, 0))
    assert page.locator("#error-1 tr.reference").first.is_visible()
    page.get_by_role("checkbox", name="network").check()
    assert all(page.evaluate(shown, 1))


def test_signals_zoom_together_and_stay_so(opened):
    page = opened("vehicle")
    values = page.locator("#timeline .u-value")
    page.locator("#timeline").scroll_into_view_if_needed()
    assert {*values.all_text_contents()} == {""}  # no mark of a missing number beside a name
    assert page.locator("#view option:checked").text_content() == "0.248 s ahead"
    drawn = "() => [...document.querySelectorAll('#timeline canvas')].map(canvas => canvas.toDataURL())"
    changed = "before => document.querySelector('#timeline canvas').toDataURL() !== before"
    before, box = page.evaluate(drawn), page.locator("#timeline .u-over").first.bounding_box()
    across = [box["x"] + share * box["width"] for share in (0.2, 0.4)]
    page.mouse.move(across[0], box["y"] + 20)
    assert any(any(digit.isdigit() for digit in text) for text in values.all_text_contents())
    page.mouse.down()
    page.mouse.move(across[1], box["y"] + 20, steps=4)
    page.mouse.up()
    page.wait_for_function(changed, arg=before[0])
    zoomed = page.evaluate(drawn)
    assert not set(zoomed) & set(before)  # all of them
    page.locator("#view").select_option(label="0.5 s ahead")
    page.locator("#view").select_option(label="0.248 s ahead")
    page.mouse.move(0, 0)
    assert page.evaluate(drawn) == zoomed  # the zoom survives
    page.get_by_role("button", name="All").click()
    page.wait_for_function(changed, arg=zoomed[0])
    assert page.evaluate(drawn) == before


def test_only_logs_in_sight_have_their_names(drawn):
    """The second of two logs is in sight: the name of the first is not drawn over its own."""
    page = drawn("two logs")
    names = "() => window.drawn.splice(0).map(each => each[1]).filter(text => text.endsWith('.csv'))"
    for clicks, shown in ((["Zoom in"] * 2 + ["Later"] * 3, {"other.csv"}), (["All"], {"first.csv", "other.csv"})):
        for name in clicks:
            page.wait_for_timeout(200)
            page.evaluate(names)
            page.get_by_role("button", name=name).click()
        page.wait_for_timeout(200)
        assert set(page.evaluate(names)) == shown


def test_one_start_is_chosen_and_drawn_as_a_trajectory(opened):
    page = opened("vehicle", 390)
    slider, said = page.locator("#start"), page.locator("#start + output")
    assert not slider.is_visible()
    page.locator("#view").select_option(label="from one start")
    assert slider.is_visible()
    drawn = "() => document.querySelectorAll('#timeline canvas')[1].toDataURL()"  # the residual
    before, first = page.evaluate(drawn), said.text_content()
    slider.focus()
    for _ in range(3):
        page.keyboard.press("ArrowRight")
    assert float(said.text_content()[:-2]) == pytest.approx(float(first[:-2]) + 0.57, abs=0.02)
    assert slider.get_attribute("aria-valuetext") == said.text_content()
    assert page.evaluate(drawn) != before
    assert overlapping(page.evaluate(TEXTS)) == []
    assert page.evaluate("document.scrollingElement.scrollWidth") <= 390
    box = slider.bounding_box()
    assert box["height"] >= 24
    page.mouse.click(box["x"] + box["width"] - 3, box["y"] + box["height"] / 2)
    assert slider.input_value() == slider.get_attribute("max") == "39"
    page.locator("#view").select_option(label="0.5 s ahead")
    assert not slider.is_visible()


def test_without_scripts_the_page_reads_and_has_no_dead_buttons(browser, addresses):
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(addresses["vehicle"])
    assert page.locator("noscript").is_visible()
    assert page.locator("#quantities-table").is_visible()
    assert page.locator(".tools").count() == 1
    assert not page.locator(".tools, #start").first.is_visible()
    context.close()


def test_a_range_of_a_log_is_ready_to_copy_and_a_finger_moves_it(opened):
    page = opened("log", 390)
    before = page.locator("#range").text_content()
    page.get_by_role("button", name="Zoom in").click()
    zoomed = page.locator("#range").text_content()
    assert re.fullmatch(r"--begin \d+\.\d\d --end \d+\.\d\d", zoomed)
    assert zoomed != before
    finger = """how => document.querySelector("#timeline .u-over").dispatchEvent(new PointerEvent(how[0],
        {bubbles: true, pointerType: "touch", pointerId: 1, clientX: how[1]}))"""
    for how in (("pointerdown", 200), ("pointermove", 150), ("pointerup", 150)):
        page.evaluate(finger, how)
    begin, end = (float(x) for x in re.findall(r"[\d.]{3,}", page.locator("#range").text_content()))
    before, after = (float(x) for x in re.findall(r"[\d.]{3,}", zoomed))
    assert begin > before
    assert end - begin == pytest.approx(after - before, abs=0.02)


def test_labels_of_the_time_axis_differ_late_in_a_log(drawn):
    page = drawn("late")
    for _ in range(3):
        page.get_by_role("button", name="Zoom in").click()
        page.wait_for_timeout(200)
        panel, _ = page.evaluate("() => window.drawn[0]")
        texts = [text for other, text in page.evaluate("() => window.drawn.splice(0)") if other == panel]
        labels = [float(text) for text in texts if re.fullmatch(r"12\d\d(\.\d+)?", text)]
        assert len(labels) > 4
        np.testing.assert_allclose(np.diff(labels), labels[1] - labels[0], atol=1e-6)
        assert labels[1] > labels[0]


def test_figures_tell_names_and_values_as_tooltips(opened):
    page = opened()
    title = "#figure-{} [data-estimator='0'] > title"
    assert page.locator(title.format("error")).first.text_content() == "ibss"
    assert any("rollouts" in text for text in page.locator(title.format("overview")).all_text_contents())
