"""The explorer's page: in Chromium where that and Playwright are installed, and its controls without."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from report_outputs import HOSTILE_NAMES, hostile_job

from colmap_vg import MappingOptions, ReadOptions
from colmap_vg.cli.jobs import mapper
from colmap_vg.cli.reporter import Reporter
from colmap_vg.jobs.verdict_tables import read_tables
from colmap_vg.viewer.explorer import Explorer, printable
from colmap_vg.viewer.finished_job import FinishedJob, read_finished_job
from colmap_vg.viewer.session import Session

pytest.importorskip("viser")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"]
VALUES = "() => [...document.querySelectorAll('textarea, input')].map(field => field.value)"


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> FinishedJob:
    return read_finished_job(hostile_job(tmp_path_factory.mktemp("hostile")))


@pytest.fixture
def explorer(job: FinishedJob, tmp_path: Path) -> Iterator[Explorer]:
    started = Explorer(Session(job), tmp_path / "lists", port=0)
    yield started
    started.stop()


@pytest.fixture
def page(explorer: Explorer) -> Iterator[Any]:
    """A page of the browser, which asks no other site for anything, opens no dialog and has no error."""
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": 1400, "height": 1400})
        problems: list[str] = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("dialog", lambda dialog: problems.append(dialog.message))
        page.on(
            "request",
            lambda request: (
                None if request.url.startswith((explorer.url, "blob:", "data:")) else problems.append(request.url)
            ),
        )
        page.goto(explorer.url)
        page.get_by_role("button", name="Solve again").wait_for()
        yield page
        browser.close()
        assert problems == []


def wait_for(page: Any, shown: Callable[[str], bool]) -> str:
    """The text of all fields of a page, as soon as it is as it should be."""
    for _ in range(100):
        text = "\n".join(page.evaluate(VALUES))
        if shown(text):
            return text
        page.wait_for_timeout(100)
    raise AssertionError(text)


def test_a_pair_is_excluded_solved_saved_and_mapped(
    page: Any, explorer: Explorer, job: FinishedJob, tmp_path: Path
) -> None:
    text = wait_for(page, lambda text: "10 images registered before, 10 after" in text)
    # The first image's name is markup, and is shown as text; so are all names of the pair.
    assert f"1: {HOSTILE_NAMES[0]}" in text
    page.get_by_role("button", name="Exclude pair").click()
    text = wait_for(page, lambda text: "exclude <script>" in text)
    marked = next(line for line in text.splitlines() if line.startswith("exclude "))
    page.get_by_role("button", name="Exclude image").click()
    wait_for(page, lambda text: "It is marked as excluded" in text)
    page.get_by_role("button", name="Solve again").click()
    text = wait_for(page, lambda text: "10 images registered before, 9 after" in text)
    assert f"lost: {HOSTILE_NAMES[0]}: no verified pair of this image could be used" in text
    page.get_by_role("button", name="Save lists").click()
    text = wait_for(page, lambda text: "--excluded_pairs_path" in text)
    lists = tmp_path / "lists"
    assert f"--excluded_pairs_path {lists / 'excluded_pairs.txt'}" in text
    read = ReadOptions(excluded_pairs_path=lists / "excluded_pairs.txt", trusted_pairs_path=lists / "trusted_pairs.txt")
    options, out = MappingOptions(read=read), tmp_path / "out"
    mapper(job.database_path, None, out, options, False, Reporter(quiet=True), with_report=False)
    model = pycolmap.Reconstruction(out / "0")
    assert sorted(model.image(i).name for i in model.reg_image_ids()) == sorted(job.graph.image_names[1:])
    excluded = [row for row in read_tables(out).pairs if row.verdict == "excluded"]
    assert len(excluded) == int((job.graph.edges == 0).any(axis=1).sum())
    assert any(printable(f"exclude {row.image1} - {row.image2}") == marked for row in excluded)


def test_all_hostile_names_are_shown_as_text(page: Any, job: FinishedJob) -> None:
    for row in range(len(HOSTILE_NAMES)):
        page.get_by_role("button", name="Exclude image").click()
        wait_for(page, lambda text, row=row: f"exclude {printable(job.graph.image_names[row])}" in text)
        page.locator("input:visible").first.click()
        page.get_by_role("option").nth(row + 1).click()
        wait_for(page, lambda text, row=row: f"{row + 2}: {printable(job.graph.image_names[row + 1])}" in text)
    assert page.evaluate("document.querySelectorAll('script:not([src]):not([type])').length") <= 1
    assert page.evaluate("document.querySelectorAll('img[src=x]').length") == 0


def test_views_are_drawn(explorer: Explorer, job: FinishedJob) -> None:
    """Without a browser: what the server holds for one."""
    names = {node.name.removeprefix("/") for node in explorer._nodes}
    assert {f"after/camera{row}" for row in range(10)} <= names
    assert {"after/pairs", "points"} <= names
    explorer._session.exclude_image(3)
    explorer._session.solve()
    explorer._shown.value = "side by side"
    explorer._draw()
    names = {node.name.removeprefix("/") for node in explorer._nodes}
    assert "before/camera3" in names
    assert "after/camera3" not in names
    before, after = (next(n for n in explorer._nodes if n.name == f"/{k}/camera5") for k in ("before", "after"))
    assert np.linalg.norm(np.asarray(before.position) - after.position) > 0.1


def test_clicks_on_two_cameras_choose_their_pair(explorer: Explorer, job: FinishedJob) -> None:
    explorer._choose_image(2)
    explorer._choose_pair_with(7)
    assert sorted(job.graph.edges[explorer._pair].tolist()) == [2, 7]
    assert explorer._pairs.value.startswith("8: ")
    explorer._session.exclude_pair(explorer._pair)
    explorer._tell()
    assert explorer._marks.value.startswith("exclude ")


@pytest.mark.parametrize(
    ("text", "shown"), [("a\nb\x00", "a\\nb\\x00"), ("Größe 日本", "Größe 日本"), ("\u202e", "\\u202e")]
)
def test_what_cannot_be_seen_is_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown
