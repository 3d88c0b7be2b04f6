"""The report in a browser, where Chromium and Playwright are installed: filters count, tables sort, a click selects."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from report_outputs import HOSTILE_NAMES, hostile_job, two_models_job

from colmap_vg.report.page import write_report

playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"]
COUNT_COLORS = """async () => {
  const image = new Image(), canvas = document.createElement("canvas");
  image.src = await Plotly.toImage("model-view", {format: "png", width: 300, height: 300});
  await image.decode();
  canvas.width = canvas.height = 300;
  const context = canvas.getContext("2d");
  context.drawImage(image, 0, 0);
  return new Set(new Uint32Array(context.getImageData(0, 0, 300, 300).data.buffer)).size;
}"""
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_report(hostile_job(tmp_path_factory.mktemp("hostile")))


@contextmanager
def opened(browser: Any, report: Path, **options: object) -> Iterator[Any]:
    """A page of the browser with the report, which asks for nothing and has no error."""
    page = browser.new_page(**options)
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
    page.on("request", lambda request: problems.append(request.url) if request.url.startswith("http") else None)
    page.on("dialog", lambda dialog: problems.append(dialog.message))
    page.goto(report.as_uri())
    page.wait_for_function("document.documentElement.dataset.ready === '1'")
    yield page
    page.close()
    assert not problems


@pytest.fixture
def page(browser: Any, report: Path) -> Iterator[Any]:
    with opened(browser, report, viewport={"width": 1300, "height": 900}) as page:
        yield page


def test_filters_change_the_number_of_pairs(page: Any) -> None:
    assert page.inner_text("#count") == "45 of 45 pairs shown"
    page.fill("#max-error", "0")
    page.wait_for_function("document.getElementById('count').textContent === '0 of 45 pairs shown'")
    page.fill("#max-error", "")
    page.wait_for_function("document.getElementById('count').textContent === '45 of 45 pairs shown'")
    page.uncheck("#verdicts input[value=kept]")
    assert page.inner_text("#count").startswith("0 of")


def test_the_3d_view_is_not_blank(page: Any) -> None:
    colors = page.evaluate(COUNT_COLORS)
    assert colors > 20


def test_tables_sort_search_and_select(page: Any) -> None:
    header = page.locator("#pairs-table thead button", has_text="Inliers")
    header.click()
    assert header.locator("xpath=..").get_attribute("aria-sort") == "descending"
    cells = page.locator("#pairs-table tbody tr td:nth-child(4)").all_inner_texts()
    assert [int(cell) for cell in cells] == sorted((int(cell) for cell in cells), reverse=True)
    page.fill("#images-table input", "alert(1)")
    rows = page.locator("#images-table tbody tr")
    assert rows.count() == 2
    rows.first.focus()
    page.keyboard.press("Enter")
    assert page.inner_text("#selected .title") in HOSTILE_NAMES
    page.click("#worst")
    assert page.locator("#selected svg line").count() > 0


def test_a_click_in_the_view_selects_an_image(page: Any) -> None:
    page.evaluate(
        "document.getElementById('model-view').emit('plotly_click', {points: [{curveNumber: 2, customdata: 3}]})"
    )
    page.wait_for_selector("#selected .title")
    assert page.inner_text("#selected h3 >> nth=0") == "Image"
    assert page.locator("#images-table tr[aria-selected=true]").get_attribute("data-row") == "3"


def test_a_phone_needs_no_scrolling_sideways(browser: Any, report: Path) -> None:
    with opened(browser, report, viewport={"width": 390, "height": 800}, color_scheme="dark") as page:
        assert page.evaluate("document.documentElement.dataset.theme") == "dark"
        assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0


def test_each_model_has_its_view(browser: Any, tmp_path: Path) -> None:
    with opened(browser, write_report(two_models_job(tmp_path))) as page:
        counts, first = [], []
        for model in ("0", "1"):
            page.select_option("#model", model)
            counts.append(page.inner_text("#count"))
            first.append(page.evaluate("document.getElementById('model-view').data[2].customdata"))
        assert counts == ["15 of 15 pairs shown"] * 2
        assert sorted(first[0] + first[1]) == list(range(12))
        other = page.locator(f"#images-table tr[data-row='{first[0][0]}']")
        other.click()  # of the model that is not shown
        assert page.inner_text("#selected .title") == other.locator("td").first.inner_text()
