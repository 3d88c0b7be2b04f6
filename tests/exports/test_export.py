"""The verb, and what all formats have in common."""

import json
import resource
from pathlib import Path
from typing import get_args

import pytest
from exported_models import contents, make_model, write_photographs
from typer.testing import CliRunner, Result

import colmap_vg
from colmap_vg.cli.main import app
from colmap_vg.errors import MappingError, OptionError, OutputError
from colmap_vg.exports.source import find_source
from colmap_vg.options import ExportFormat

FORMATS = get_args(ExportFormat)
FILES = ("ply", "tum", "g2o")


def export(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["export", *map(str, arguments)])


@pytest.fixture
def job(tmp_path: Path) -> Path:
    """A finished job's folder with the photographs that its summary names."""
    model = make_model(tmp_path / "job" / "0", ["SIMPLE_RADIAL", "RADIAL"])
    photographs = write_photographs(tmp_path / "photos", model)
    (tmp_path / "job" / "summary.json").write_text(json.dumps({"options": {"image_path": str(photographs)}}))
    return tmp_path / "job"


@pytest.mark.parametrize("format", FORMATS)
def test_every_format_is_written_once(job: Path, tmp_path: Path, format: str) -> None:
    before, out = contents(tmp_path), tmp_path / "out"
    flags = ("--input_path", job, "--output_path", out, "--format", format)
    done = export(*flags)
    assert done.exit_code == 0, done.output
    assert f"{out}: 6 images, 40 points" in done.output
    assert out.is_file() == (format in FILES)
    first = out.read_bytes() if format in FILES else contents(out)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["job", "out", "photos"]
    refused = export(*flags)
    assert refused.exit_code == 1
    assert "--overwrite" in refused.stderr
    assert export(*flags, "--overwrite").exit_code == 0
    assert (out.read_bytes() if format in FILES else contents(out)) == first
    assert {name: data for name, data in contents(tmp_path).items() if not name.startswith("out")} == before
    if format not in FILES:
        assert json.loads(first["export.json"])["format"] == format


def test_the_model_of_a_job_is_chosen(job: Path, tmp_path: Path) -> None:
    make_model(job / "1")
    done = export("--input_path", job, "--model", 1, "--output_path", tmp_path / "out.txt", "--format", "tum")
    assert "3 images" in done.output
    wrong = export("--input_path", job, "--model", 2, "--output_path", tmp_path / "new.txt", "--format", "tum")
    assert wrong.exit_code == 2
    assert "has no model 2" in wrong.stderr


@pytest.mark.parametrize("format", ["splat", "nerfstudio"])
def test_photographs_are_asked_for(job: Path, tmp_path: Path, format: str) -> None:
    flags = ("--input_path", job / "0", "--output_path", tmp_path / "out", "--format", format)
    done = export(*flags)
    assert done.exit_code == 1
    assert "--image_path" in done.stderr
    assert not (tmp_path / "out").exists()
    assert export(*flags, "--image_path", tmp_path / "photos").exit_code == 0


def test_options_of_other_formats_are_refused(job: Path, tmp_path: Path) -> None:
    done = export("--input_path", job, "--output_path", tmp_path / "o", "--format", "ply", "--max_image_size", 100)
    assert done.exit_code == 2
    assert "for the format splat only" in done.stderr
    with pytest.raises(OptionError, match=r"format must be one of text, .* found 'obj'"):
        colmap_vg.export_model(job, tmp_path / "o", "obj")  # type: ignore[arg-type]


@pytest.mark.parametrize("format", FORMATS)
def test_files_that_are_cut_are_no_export(job: Path, tmp_path: Path, format: str) -> None:
    source, limits = find_source(job), resource.getrlimit(resource.RLIMIT_FSIZE)
    assert source.image_path is not None
    colmap_vg.export_model(job, tmp_path / "whole", format)  # type: ignore[arg-type]
    whole = contents(tmp_path / "whole").values() if format not in FILES else [(tmp_path / "whole").read_bytes()]
    before = contents(tmp_path)
    resource.setrlimit(resource.RLIMIT_FSIZE, (max(map(len, whole)) - 100, limits[1]))
    try:
        with pytest.raises((OutputError, MappingError), match="disk space"):
            colmap_vg.export_model(job, tmp_path / "out", format)  # type: ignore[arg-type]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert contents(tmp_path) == before
