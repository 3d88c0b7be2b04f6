"""The log for programs: every event a line of JSON, at once, and the result last."""

import json
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from synthetic_databases import make_database, sha256
from typer.testing import CliRunner, Result

import colmap_vg.cli.jobs as jobs
from colmap_vg.cli.json_log import JsonLog
from colmap_vg.cli.main import app
from colmap_vg.cli.reporter import Reporter
from colmap_vg.errors import MappingError, OptionError, OutputError
from colmap_vg.events import StageEvent, StageLog

EVENT_KEYS = ["time", "stage", "state", "message", "fraction", "count", "seconds"]
RESULT_KEYS = ["time", "status", "exit_code", "message", "models", "registered"]


@pytest.fixture(scope="module")
def database_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("small") / "database.db"
    make_database(path, num_images=5, num_points=80, noise_px=0.5)
    return path


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def lines_of(text: str) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The events and the result of a log."""
    assert text.endswith("\n")
    *events, result = [json.loads(line) for line in text.split("\n")[:-1]]
    assert all(list(event) == EVENT_KEYS for event in events)
    assert list(result) == RESULT_KEYS
    return events, result


@pytest.mark.parametrize("verb", ["mapper", "solve"])
def test_a_job_on_standard_output(verb: str, database_path: Path, tmp_path: Path) -> None:
    told = invoke(verb, "--database_path", database_path, "--output_path", tmp_path / "out", "--log_json", "-")
    assert told.exit_code == 0
    events, result = lines_of(told.stdout)
    stages = json.loads((tmp_path / "out" / "summary.json").read_text())["stages"]
    assert [e["stage"] for e in events if e["state"] == "finished"] == [stage["stage"] for stage in stages]
    assert {k: v for k, v in result.items() if k != "time"} == {
        "status": "finished",
        "exit_code": 0,
        "message": "",
        "models": 1,
        "registered": 5,
    }


def test_times_are_utc_and_in_order(database_path: Path, tmp_path: Path) -> None:
    began = datetime.now(UTC) - timedelta(milliseconds=1)
    told = invoke("solve", "--database_path", database_path, "--output_path", tmp_path / "out", "--log_json", "-")
    events, result = lines_of(told.stdout)
    times = [datetime.fromisoformat(line["time"]) for line in (*events, result)]
    assert all(line["time"].endswith("Z") for line in events)
    assert began <= times[0]
    assert times == sorted(times)
    assert times[-1] <= datetime.now(UTC)


def test_a_file_holds_the_log_beside_the_ordinary_lines(database_path: Path, tmp_path: Path) -> None:
    log = tmp_path / "job.jsonl"
    arguments = ("mapper", "--database_path", database_path, "--output_path", tmp_path / "out", "--report", 0)
    told = invoke(*arguments, "--log_json", log, "--Mapper.max_num_models", 1)
    assert "5 of 5 images" in told.stdout
    events, result = lines_of(log.read_text())
    assert (events[0]["state"], events[0]["stage"]) == ("warning", "")
    assert "--Mapper.max_num_models" in events[0]["message"]
    assert any(event["count"] == 3 and event["fraction"] == 0.6 for event in events)
    again = invoke(*arguments, "--log_json", log, "--resume")
    assert "nothing is left to do" in again.stdout
    events, result = lines_of(log.read_text())
    assert events == []
    assert (result["status"], result["models"], result["registered"]) == ("finished", 1, 5)


def test_a_failed_job_says_so_last(tmp_path: Path) -> None:
    told = invoke("mapper", "--database_path", tmp_path / "none", "--output_path", tmp_path / "out", "--log_json", "-")
    assert told.exit_code == 1
    assert told.stderr.startswith("error: ")
    _, result = lines_of(told.stdout)
    assert (result["status"], result["exit_code"], result["models"]) == ("failed", 1, 0)
    assert f"error: {result['message']}\n" == told.stderr


@pytest.mark.parametrize(
    ("error", "status", "code"),
    [
        (KeyboardInterrupt(), "interrupted", 130),
        (OptionError("x"), "failed", 2),
        (MappingError("x"), "failed", 1),
        (ZeroDivisionError("x"), "failed", 1),
    ],
)
def test_every_end_has_its_exit_code(
    error: BaseException, status: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object) -> None:
        raise error

    monkeypatch.setattr(jobs, "mapper", fail)
    log = tmp_path / "log"
    told = invoke("mapper", "--database_path", "d", "--output_path", tmp_path / "out", "--log_json", log)
    assert told.exit_code == code
    _, result = lines_of(log.read_text())
    assert (result["status"], result["exit_code"]) == (status, code)


def test_lines_are_written_at_once(tmp_path: Path) -> None:
    path = tmp_path / "log"
    with JsonLog(str(path)) as log:
        for count in (1, 2, 3):
            log.event(StageEvent("solve", "progress", count=count))
            assert len(path.read_text().splitlines()) == count


def test_hostile_text_stays_one_line_of_json(tmp_path: Path) -> None:
    text = 'a"b\\c\n\r\u2028\u0085\x00\x1b[2J {"status": "finished"} é \udcff.jpg'
    path = tmp_path / "log"
    with JsonLog(str(path)) as log, Reporter(quiet=True, json_log=log) as reporter:
        job = StageLog(reporter.on_event)
        with job.stage("features"):
            job.warn(text)
            job.progress(text, float("nan"))
    raw = path.read_bytes()
    assert raw.isascii()
    assert len(raw.decode().splitlines()) == 5
    events, _ = lines_of(raw.decode())
    assert events[1]["message"] == text.replace("\udcff", "\\udcff")
    assert events[2]["fraction"] is None
    assert reporter.warnings == [text]


def test_no_other_file_is_overwritten(database_path: Path, tmp_path: Path) -> None:
    before = sha256(database_path)
    told = invoke(
        "mapper", "--database_path", database_path, "--output_path", tmp_path / "out", "--log_json", database_path
    )
    assert told.exit_code == 1
    assert "is not a log" in told.stderr
    assert sha256(database_path) == before
    assert not (tmp_path / "out").exists()


def test_a_log_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    for target in ("missing/log", "."):
        told = invoke("solve", "--database_path", "d", "--output_path", "o", "--log_json", tmp_path / target)
        assert told.exit_code == 1
        assert len(told.stderr.splitlines()) == 1
        assert "--log_json" in told.stderr
    with JsonLog("/dev/full") as log, pytest.raises(OutputError, match="No space left"):
        log.event(StageEvent("solve", "started"))


def test_a_reader_that_leaves_ends_the_job_with_one_line(database_path: Path, tmp_path: Path) -> None:
    words = ["mapper", "--database_path", str(database_path), "--output_path", str(tmp_path / "out")]
    with subprocess.Popen(
        [sys.executable, "-m", "colmap_vg", *words, "--log_json", "-"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        process.stdout.close()
        errors = process.stderr.read()
        assert process.wait(timeout=60) == 1
    assert len(errors.splitlines()) == 1, errors
    assert not (tmp_path / "out" / "0").exists()
