"""The report's page: what it says, hostile names as text, one file, and inputs that stay as they are."""

import html
import json
from html.parser import HTMLParser
from pathlib import Path

import pytest
from report_outputs import HOSTILE_NAMES, hostile_job, large_job, page_data
from synthetic_databases import sha256

from colmap_vg.errors import ColmapVgError
from colmap_vg.report.contents import MAX_PAIRS, NUM_WORST
from colmap_vg.report.models import MAX_POINTS
from colmap_vg.report.page import write_report

MAX_BYTES = 10_000_000


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hostile_job(tmp_path_factory.mktemp("hostile"))


@pytest.fixture(scope="module")
def page(output: Path) -> str:
    return write_report(output).read_text(encoding="utf-8")


class Tags(HTMLParser):
    """Collects the tags and attributes of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def tags(page: str) -> list[tuple[str, dict[str, str | None]]]:
    parser = Tags()
    parser.feed(page)
    return parser.found


def edited(output: Path, target: Path, **entries: object) -> Path:
    """A copy of a job's summary and tables with other entries in the summary."""
    target.mkdir()
    for name in ("images.csv", "pairs.csv"):
        (target / name).write_bytes((output / name).read_bytes())
    summary = json.loads((output / "summary.json").read_text(encoding="utf-8"))
    (target / "summary.json").write_text(json.dumps({**summary, **entries}), encoding="utf-8")
    return target


def test_it_says_what_matters(page: str, output: Path) -> None:
    summary = json.loads((output / "summary.json").read_text(encoding="utf-8"))
    assert "10 of 10 images registered" in page
    assert summary["status"] == "solved"
    assert "Every image has a pose in one frame." in page
    assert f"{summary['models'][0]['agreement']['inliers']:.1%}" in page
    for stage in summary["stages"]:
        assert f'<th scope="row">{stage["stage"]}</th>' in page
    assert "mapping.random_seed" in page
    for warning in summary["warnings"]:
        assert html.escape(warning).replace("&#x27;", "&#39;").replace("&quot;", "&#34;") in page


def test_its_data_are_those_of_the_tables_and_models(page: str, output: Path) -> None:
    data = page_data(page)
    assert set(HOSTILE_NAMES) <= set(data["images"]["name"])
    assert len(data["models"]) == 1
    assert len(data["models"][0]["images"]) == 10
    assert sum(data["models"][0]["errorCounts"]) == data["models"][0]["numPoints"]
    assert len(data["pairs"]["a"]) == 45
    assert len(data["matches"]) == NUM_WORST
    assert all(0 <= share <= 1 for match in data["matches"].values() for row in match for share in row)
    shown = [name for name, uri in zip(data["images"]["name"], data["images"]["photograph"], strict=True) if uri]
    assert set(shown) == {HOSTILE_NAMES[3], HOSTILE_NAMES[4]}
    assert "8 photographs are missing" in page


def test_hostile_names_are_text(page: str, output: Path, tmp_path: Path) -> None:
    assert "alert(1)</script>" not in page
    assert "onerror=alert(1)>" not in page
    assert "\u2028" not in page.partition('id="data">')[2].partition("</script>")[0]
    left_out = edited(output, tmp_path / "edited", warnings=[f"a warning on {name}" for name in HOSTILE_NAMES])
    table = (left_out / "images.csv").read_text(encoding="utf-8").replace(",0,registered,", ",,cut_off,")
    (left_out / "images.csv").write_text(table, encoding="utf-8", newline="")
    (left_out / "0").mkdir()
    text = write_report(left_out).read_text(encoding="utf-8")
    assert "0 of 10 images registered" in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text
    assert "{{ 7*7 }}" in text
    assert [tag for tag, _ in tags(text)].count("script") == [tag for tag, _ in tags(page)].count("script")
    assert not any("onerror" in attributes for _, attributes in tags(text))


def test_it_asks_for_no_other_file(page: str) -> None:
    for tag, attributes in tags(page):
        assert tag not in ("link", "iframe", "object", "embed", "base"), tag
        assert not {"src", "srcset", "action", "data"} & set(attributes), (tag, attributes)
        assert (attributes.get("href") or "#").startswith("#")


@pytest.mark.parametrize("status", ["doubtful", "not_converged", "unsolvable"])
def test_a_result_in_doubt_is_striking(output: Path, tmp_path: Path, status: str) -> None:
    text = write_report(edited(output, tmp_path / "edited", status=status)).read_text(encoding="utf-8")
    assert '<div class="status grave">' in text
    assert f"<strong>{status}</strong>" in text


def test_inputs_are_not_changed(output: Path) -> None:
    before = {path: sha256(path) for path in output.parent.rglob("*") if path.is_file() and path.suffix != ".html"}
    first = write_report(output).read_bytes()
    assert write_report(output).read_bytes() == first
    after = {path: sha256(path) for path in output.parent.rglob("*") if path.is_file() and path.suffix != ".html"}
    assert after == before


def test_without_photographs_and_database_it_says_so(output: Path, tmp_path: Path) -> None:
    text = write_report(edited(output, tmp_path / "edited", options={})).read_text(encoding="utf-8")
    assert "Without the database, no matches are shown." in text
    assert "no thumbnails are shown" in text


def test_a_damaged_database_leaves_only_the_matches_out(output: Path, tmp_path: Path) -> None:
    (tmp_path / "damaged.db").write_text("no database")
    text = write_report(edited(output, tmp_path / "edited"), database_path=tmp_path / "damaged.db").read_text("utf-8")
    assert "No matches are shown: " in text
    assert page_data(text)["matches"] == {}


@pytest.mark.parametrize("entries", [{"status": None, "edges": 3}, {"stages": [1]}, {"warnings": 2}, {"options": None}])
def test_a_damaged_summary_is_an_error(output: Path, tmp_path: Path, entries: dict[str, object]) -> None:
    folder = edited(output, tmp_path / "edited", **entries)
    if entries == {"options": None}:
        assert write_report(folder).exists()
        return
    with pytest.raises(ColmapVgError, match="run the job again"):
        write_report(folder)
    assert not (folder / "report.html").exists()


def test_a_damaged_model_is_an_error(output: Path, tmp_path: Path) -> None:
    folder = edited(output, tmp_path / "edited")
    (folder / "0").mkdir()
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        (folder / "0" / name).write_bytes(b"\xff" * 40)
    with pytest.raises(ColmapVgError, match="cannot be read"):
        write_report(folder)


@pytest.mark.slow
def test_a_large_job_stays_small(tmp_path: Path) -> None:
    path = write_report(large_job(tmp_path / "out"))
    assert path.stat().st_size < MAX_BYTES
    text = path.read_text(encoding="utf-8")
    data = page_data(text)
    assert len(data["pairs"]["a"]) == MAX_PAIRS
    assert len(data["models"][0]["points"]) < 17 * MAX_POINTS
    assert all(data["images"]["photograph"])
    assert "of 100,000" in text
    assert "20,000 of 25,000 pairs" in text
