"""`colmap-vg view` as a process: it says where its page is, and ends by Ctrl-C."""

import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from synthetic_databases import make_database
from typer.testing import CliRunner

from colmap_vg import MappingOptions
from colmap_vg.cli import exploring
from colmap_vg.cli.jobs import mapper
from colmap_vg.cli.main import app
from colmap_vg.cli.reporter import Reporter

pytest.importorskip("viser")


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("view")
    make_database(folder / "database.db", num_images=6, num_points=200)
    mapper(folder / "database.db", None, folder / "out", MappingOptions(), False, Reporter(quiet=True), False)
    return folder / "out"


def test_it_serves_until_interrupted_and_changes_nothing(output: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in output.rglob("*")}
    command = [sys.executable, "-m", "colmap_vg", "view", "--output_path", str(output), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        url = None
        for line in process.stdout:
            url = re.match(r"explorer: (http://127\.0\.0\.1:\d+) \(Ctrl-C ends it\)", line)
            if url:
                break
        assert url is not None
        with urllib.request.urlopen(url[1], timeout=20) as answer:
            assert answer.status == 200
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    assert "explorer closed" in rest
    assert "Traceback" not in errors
    assert {path: path.stat().st_mtime_ns for path in output.rglob("*")} == before


def test_other_addresses_than_the_own_one_are_warned_of(output: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exploring.Explorer, "wait", lambda self: None)
    told = CliRunner().invoke(app, ["view", "--output_path", str(output), "--host", "0.0.0.0", "--port", "0"])
    assert told.exit_code == 0, told.output
    assert "warning: everyone who reaches 0.0.0.0 can see this job" in told.output
    told = CliRunner().invoke(app, ["view", "--output_path", str(output), "--port", "0"])
    assert "warning" not in told.output


def test_without_viser_the_error_says_what_to_install(output: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    told = CliRunner().invoke(app, ["view", "--output_path", str(output)])
    assert told.exit_code == 1
    assert "pip install 'colmap-vg[view]'" in told.output
