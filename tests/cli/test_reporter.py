"""Progress lines: plain ones off a terminal, all kept for the summary."""

import json
from pathlib import Path

import pytest

from colmap_vg.cli.reporter import Reporter
from colmap_vg.errors import OutputError
from colmap_vg.events import StageEvent, StageLog
from colmap_vg.jobs.summary import edge_summary, image_summary, job_summary, write_summary
from colmap_vg.options import MappingOptions


def some_job(reporter: Reporter) -> None:
    log = StageLog(reporter.on_event)
    with log.stage("features"):
        log.progress("1 of 2", 0.5)
        log.warn("skipped a[red].jpg: the file is empty")
        log.result("12 features")
    with log.stage("matching"):
        pass


def shown(capsys: pytest.CaptureFixture[str], quiet: bool = False, verbose: bool = False) -> tuple[Reporter, list[str]]:
    with Reporter(quiet, verbose) as reporter:
        some_job(reporter)
    captured = capsys.readouterr()
    assert captured.err == ""
    return reporter, captured.out.splitlines()


def test_plain_lines(capsys: pytest.CaptureFixture[str]) -> None:
    _, lines = shown(capsys)
    assert lines == [
        "warning: skipped a[red].jpg: the file is empty",
        "features: 12 features (0.0 s)",
        "matching: done (0.0 s)",
    ]


def test_verbose_shows_every_event(capsys: pytest.CaptureFixture[str]) -> None:
    _, lines = shown(capsys, verbose=True)
    assert lines[:2] == ["features: started", "features: 1 of 2 (50 %)"]


def test_progress_has_a_rate_and_the_time_left(capsys: pytest.CaptureFixture[str]) -> None:
    with Reporter(verbose=True) as reporter:
        for seconds, count in ((0.5, 800), (0.9, 802), (10.5, 820), (60.5, 920), (70.5, None)):
            share = None if count is None else count / 8000
            reporter.on_event(StageEvent("matching", "progress", "of 8000 pairs", share, seconds, count))
        reporter.on_event(StageEvent("write", "started"))
        reporter.on_event(StageEvent("write", "progress", "models", 0.5, 5.0))
        reporter.on_event(StageEvent("write", "progress", "models", 0.75, 30.0))
    assert capsys.readouterr().out.splitlines() == [
        "matching: of 8000 pairs (10 %)",
        "matching: of 8000 pairs (10 %)",
        "matching: of 8000 pairs (10 %, 2.0/s, 59 min 50 s left)",
        "matching: of 8000 pairs (12 %, 2.0/s, 59 min 0 s left)",
        "matching: of 8000 pairs",
        "write: started",
        "write: models (50 %)",
        "write: models (75 %, 25 s left)",
    ]


def test_quiet_shows_nothing_and_keeps_everything(capsys: pytest.CaptureFixture[str]) -> None:
    reporter, lines = shown(capsys, quiet=True)
    assert lines == []
    assert [record.stage for record in reporter.records] == ["features", "matching"]
    assert reporter.warnings == ["skipped a[red].jpg: the file is empty"]


def test_a_terminal_gets_lines_with_brackets_unharmed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    _, lines = shown(capsys)
    assert any("a[red].jpg" in line for line in lines)


def test_summary_is_plain_json(tmp_path: Path) -> None:
    reporter = Reporter(quiet=True)
    some_job(reporter)
    content = job_summary(
        "mapper", {"output_path": tmp_path, "mapping": MappingOptions()}, reporter.records, reporter.warnings
    )
    content["images"] = image_summary(["a", "b", "c"], ["registered", "no_edges", "registered"], [True, False, True])
    content["edges"] = edge_summary(
        ["kept", "reversed", "kept", "reversed", "watermark"], [True, False, True, False, False]
    )
    write_summary(tmp_path, content)
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]
    read = json.loads((tmp_path / "summary.json").read_text())
    assert read["options"]["mapping"]["read"]["min_num_inliers"] == 15
    assert read["options"]["output_path"] == str(tmp_path)
    assert read["images"]["num_registered"] == 2
    assert read["images"]["left_out"] == {"b": "no_edges"}
    assert read["edges"] == {"num_edges": 5, "num_kept": 2, "dropped": {"reversed": 2, "watermark": 1}}
    assert [stage["stage"] for stage in read["stages"]] == ["features", "matching"]
    with pytest.raises(OutputError, match=r"summary\.json"):
        write_summary(tmp_path / "gone", content)
