"""The verb `report`, the flag `--report`, and jobs whose report cannot be written."""

import json
from pathlib import Path

import pytest
from synthetic_databases import make_database
from typer.testing import CliRunner, Result

import colmap_vg.cli.jobs
from colmap_vg.cli.main import app
from colmap_vg.errors import OutputError
from colmap_vg.jobs.job_record import recorded_job


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def database_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("small") / "database.db"
    make_database(path, num_images=5, num_points=100, noise_px=0.5)
    return path


def test_a_job_names_its_report_at_the_end(database_path: Path, tmp_path: Path) -> None:
    job = ("mapper", "--database_path", database_path, "--output_path", tmp_path / "out")
    result = invoke(*job)
    assert result.exit_code == 0, result.output
    report = tmp_path / "out" / "report.html"
    *_, said, named = result.output.splitlines()
    assert said.startswith(f"{tmp_path / 'out' / '0'}: 5 of 5 images, ")
    assert said.endswith(" of the pairs agree")
    assert named == f"report: {report}"
    assert report.stat().st_size > 0
    assert "nothing is left to do" in invoke(*job, "--resume").output
    report.unlink()
    assert "nothing is left to do" in invoke(*job, "--resume").output
    assert invoke(*job).exit_code == 1
    assert invoke(*job, "--overwrite").exit_code == 0
    assert report.exists()


def test_no_report_is_written_unless_wanted(database_path: Path, tmp_path: Path) -> None:
    result = invoke("mapper", "--database_path", database_path, "--output_path", tmp_path / "out", "--report", "0")
    assert result.exit_code == 0
    assert "report:" not in result.output
    assert not (tmp_path / "out" / "report.html").exists()


def test_a_report_of_a_finished_folder(database_path: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    assert invoke("solve", "--database_path", database_path, "--output_path", output).exit_code == 0
    result = invoke("report", "--output_path", output, "--database_path", database_path)
    assert result.exit_code == 0, result.output
    assert result.output.strip() == f"report: {output / 'report.html'}"
    assert "5 of 5 images registered" in (output / "report.html").read_text(encoding="utf-8")


def test_a_folder_without_a_job_is_an_error(tmp_path: Path) -> None:
    result = invoke("report", "--output_path", tmp_path)
    assert result.exit_code == 1
    assert result.stderr.startswith("error: cannot read")
    assert not list(tmp_path.iterdir())


def test_a_report_among_the_photographs_is_no_change_of_them(tmp_path: Path) -> None:
    def job(resume: bool) -> bool:
        with recorded_job(tmp_path, "run", {}, tmp_path, overwrite=False, resume=resume) as state:
            (tmp_path / "0").mkdir(exist_ok=True)
            (tmp_path / "0" / "images.bin").write_bytes(b"model")
            (tmp_path / "report.html").write_text("report")
            return state.finished

    (tmp_path / "photograph.jpg").write_bytes(b"photograph")
    assert not job(resume=False)
    assert job(resume=True)


def test_a_report_that_fails_leaves_the_model(
    database_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full_disk(output_path: Path) -> Path:
        raise OutputError("the disk is full")

    monkeypatch.setattr(colmap_vg.cli.jobs, "write_report", full_disk)
    job = ("mapper", "--database_path", database_path, "--output_path", tmp_path / "out")
    result = invoke(*job)
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out" / "0" / "images.bin").exists()
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert "The report was not written: the disk is full" in summary["warnings"]
    assert "nothing is left to do" in invoke(*job, "--resume").output


def test_relative_inputs_are_found_from_another_folder(
    database_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(database_path.parent)
    job = ("mapper", "--database_path", database_path.name, "--output_path", tmp_path / "out", "--report", "0")
    assert invoke(*job).exit_code == 0
    monkeypatch.chdir(tmp_path)
    assert invoke("report", "--output_path", "out").exit_code == 0
    assert "Without the database" not in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
