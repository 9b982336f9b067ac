"""The report as a reader sees it: in chromium, on a desktop and on a phone, in light and in dark."""

import os
import shutil

import pytest
from synthetic_study import synthetic_study

from jaxos4.report import write_report

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

NAMES = ("chromium", "chromium-browser", "google-chrome")
BACKGROUND = {"light": "rgb(255, 255, 255)", "dark": "rgb(22, 25, 29)"}


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    study = synthetic_study(flights=12, estimators=("ibss", "network", "svsf"), scales=(0.1, 1.0))
    return write_report(study.isel(state=[0, 2, 4, 7]), folder)[0].as_uri()


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
def opened(browser, address):
    """Opens the page; whatever it logs or asks the network for fails the test at its end."""
    said, contexts = [], []

    def open_page(width=1280, height=900, scheme="light"):
        context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: request.url in (address, "about:blank") or said.append(request.url))
        page.goto(address)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert [line for line in said if not line.startswith(("blob:", "data:"))] == []


def chart(page, name):
    box = page.locator(f"[data-chart='{name}']")
    box.scroll_into_view_if_needed()
    box.locator(".main-svg").first.wait_for()
    return box


def shown(box):
    """The names of the traces that a chart draws."""
    return set(box.evaluate("box => box._fullData.filter(t => t.visible === true).map(t => t.name)"))


@pytest.mark.parametrize(("width", "scheme"), [(375, "light"), (1280, "dark")])
def test_it_fits_the_screen_and_follows_the_theme(opened, width, scheme):
    page = opened(width=width, scheme=scheme)
    for name in ("error-1", "efficiency-1", "distribution-1", "rollouts-1"):
        box = chart(page, name)
        size = box.bounding_box()
        assert size["width"] <= width
        assert size["height"] > 200
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == BACKGROUND[scheme]
    # Wide tables scroll inside their own box, and no chart spills out of the text.
    table = page.locator("#efficiency-1")
    inside = table.evaluate("t => [t.offsetWidth, t.parentElement.clientWidth, t.parentElement.scrollWidth]")
    assert inside[2] >= inside[0] - 1
    if width == 375:
        assert inside[0] > inside[1]
    page.get_by_role("button").filter(has_text="Dark" if scheme == "light" else "Light").click()
    other = {"light": "dark", "dark": "light"}[scheme]
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == BACKGROUND[other]


def test_a_checkbox_hides_an_estimator_everywhere(opened):
    page = opened()
    boxes = [chart(page, name) for name in ("error-1", "efficiency-1", "distribution-1", "rollouts-1")]
    for box in boxes:
        assert {"ibss", "network"} <= shown(box)
    rows = page.locator("tr[data-estimator='1']")
    drawn = page.locator("#figure-trajectories [data-estimator='1']")
    assert rows.count() == 5 * 2
    assert drawn.count() == 4 + 2
    page.get_by_role("checkbox", name="network").uncheck()
    for box in boxes:
        assert "network" not in shown(box)
        assert "ibss" in shown(box)
    assert not any(rows.nth(i).is_visible() for i in range(rows.count()))
    assert not any(drawn.nth(i).is_visible() for i in range(drawn.count()))
    assert page.locator("#error-1 tr[data-estimator='0']").first.is_visible()
    assert page.locator("#error-1 tr.reference").first.is_visible()
    page.get_by_role("checkbox", name="network").check()
    assert "network" in shown(boxes[0])
    assert page.locator("#error-1 tr[data-estimator='1']").first.is_visible()


def test_charts_tell_values_and_zoom_and_show_the_noise_that_is_chosen(opened):
    page = opened()
    box = chart(page, "rollouts-1")
    point = box.locator(".scatterlayer .point").first.bounding_box()
    page.mouse.move(point["x"] + point["width"] / 2, point["y"] + point["height"] / 2)
    box.locator(".hoverlayer .hovertext").first.wait_for()
    assert "rollouts" in box.locator(".hoverlayer").text_content()
    before = box.evaluate("box => box._fullLayout.xaxis.range.slice()")
    area = box.locator(".nsewdrag").first.bounding_box()
    page.mouse.move(area["x"] + 100, area["y"] + 60)
    page.mouse.down()
    page.mouse.move(area["x"] + 400, area["y"] + 250, steps=4)
    page.mouse.up()
    page.wait_for_function(
        "before => { const b = document.querySelector(\"[data-chart='rollouts-1']\");"
        " return b._fullLayout.xaxis.range[0] > before; }",
        arg=before[0],
    )
    box = chart(page, "distribution-1")
    read = "box => box._fullData.find(t => t.name === 'ibss').q3[0]"
    before = box.evaluate(read)
    page.get_by_label("Shown:").select_option(label="noise x 0.1")
    assert box.evaluate(read) != before
