"""The reports as a reader sees them: in chromium, on a desktop and on a phone, in light and in dark."""

import os
import shutil

import pytest
from synthetic_identification import identified_vehicle
from synthetic_study import synthetic_study

from jaxos4.report import write_flight_page, write_report

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

NAMES = ("chromium", "chromium-browser", "google-chrome")
# The width and an attribute of each element, in one question to the browser.
WIDTHS = "(all, name) => all.map(element => [element.getBoundingClientRect().width, element.getAttribute(name)])"
BACKGROUND = {"light": "rgb(255, 255, 255)", "dark": "rgb(22, 25, 29)"}


@pytest.fixture(scope="module")
def addresses(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    study = synthetic_study(flights=12, estimators=("ibss", "network", "svsf"), scales=(0.1, 1.0))
    report = write_report(study.isel(state=[0, 2, 4, 7]), folder, with_pdf=False)[0]  # the page has the SVG
    flight, bare = folder / "flight.html", folder / "bare.html"
    write_flight_page(flight, identified_vehicle(), title="A flight")
    write_flight_page(bare, identified_vehicle(predictions=None), title="A flight")
    return {"study": report.as_uri(), "flight": flight.as_uri(), "without predictions": bare.as_uri()}


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


@pytest.mark.parametrize(("width", "scheme"), [(390, "light"), (390, "dark"), (1280, "light"), (1280, "dark")])
@pytest.mark.parametrize("name", ["study", "flight", "without predictions"])
def test_it_fits_the_screen_and_follows_the_theme(opened, name, width, scheme):
    page = opened(name, width, scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    # What is wider scrolls inside its own box, and can be reached by the keyboard.
    wide = page.locator(".scroll:visible, .drawing:visible").evaluate_all(WIDTHS, "tabindex")
    assert len(wide) >= 2
    for pixels, place in wide:
        assert pixels <= width
        assert place == "0"
    for pixels, box in page.locator(".drawing:visible svg").evaluate_all(WIDTHS, "viewBox"):
        assert pixels >= float(box.split()[2])  # letters of 8 points keep at least 8 pixels
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == BACKGROUND[scheme]
    page.get_by_role("button").filter(has_text="Dark" if scheme == "light" else "Light").click()
    other = {"light": "dark", "dark": "light"}[scheme]
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == BACKGROUND[other]


def test_a_checkbox_hides_an_estimator_everywhere(opened):
    page = opened()
    assert page.locator("tr[data-estimator='1']").count() == 5 * 2
    for figure in ("error", "efficiency", "distribution", "rollouts", "coverage", "trajectories", "deviations"):
        assert page.locator(f"#figure-{figure} [data-estimator='1']").count() > 1, figure
    shown = """place => [...document.querySelectorAll(`[data-estimator="${place}"]`)]
        .map(element => getComputedStyle(element).display !== "none")"""
    page.get_by_role("checkbox", name="network").uncheck()
    assert not any(page.evaluate(shown, 1))
    assert all(page.evaluate(shown, 0))
    assert page.locator("#error-1 tr.reference").first.is_visible()
    page.get_by_role("checkbox", name="network").check()
    assert all(page.evaluate(shown, 1))


def test_a_list_chooses_what_a_figure_shows(opened):
    page = opened("flight")
    shown, choice = page.locator("#figure-predictions .drawing:visible"), page.get_by_label("Shown:")
    assert choice.locator("option:checked").text_content() == "0.248 s ahead"
    assert shown.count() == 1
    before = shown.get_attribute("aria-label")
    choice.select_option(label="0.5 s ahead")
    assert shown.count() == 1
    assert before.endswith("0.248 s ahead")
    assert shown.get_attribute("aria-label").endswith("0.5 s ahead")


def test_figures_tell_names_and_values_as_tooltips(opened):
    page = opened()
    title = "#figure-{} [data-estimator='0'] > title"
    assert page.locator(title.format("error")).first.text_content() == "ibss"
    assert any("rollouts" in text for text in page.locator(title.format("rollouts")).all_text_contents())
    assert any("median" in text for text in page.locator(title.format("distribution")).all_text_contents())
