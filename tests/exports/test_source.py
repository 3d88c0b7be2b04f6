"""Which model is exported, and which photographs belong to it."""

import json
from pathlib import Path

import pytest
from exported_models import make_model

from colmap_vg.errors import DataFileError, ImageFolderError, OptionError
from colmap_vg.exports.source import find_source


@pytest.fixture
def job(tmp_path: Path) -> Path:
    make_model(tmp_path / "job" / "0")
    make_model(tmp_path / "job" / "1", ("PINHOLE", "PINHOLE"))
    (tmp_path / "photos").mkdir()
    summary = {"options": {"image_path": str(tmp_path / "photos")}}
    (tmp_path / "job" / "summary.json").write_text(json.dumps(summary))
    return tmp_path / "job"


def test_a_job_has_models_and_photographs(job: Path) -> None:
    first, second = find_source(job), find_source(job, model=1)
    assert [len(first.images()), len(second.images())] == [3, 6]
    assert first.folder == job / "0"
    assert first.photographs() == job.parent / "photos"
    assert find_source(job, job / "0").photographs() == job / "0"


def test_a_model_has_no_photographs_of_its_own(job: Path) -> None:
    source = find_source(job / "1")
    assert len(source.images()) == 6
    assert source.job is None
    with pytest.raises(ImageFolderError, match="give their folder as image_path"):
        source.photographs()
    with pytest.raises(ImageFolderError, match="no such image folder"):
        find_source(job / "1", job / "nothing").photographs()


def test_images_without_a_pose_are_not_exported(tmp_path: Path) -> None:
    model = make_model(tmp_path / "model")
    for frame_id in model.reg_frame_ids()[:2]:
        model.deregister_frame(frame_id)
    (tmp_path / "part").mkdir()
    model.write(tmp_path / "part")
    assert len(find_source(tmp_path / "part").images()) == 1
    model.deregister_frame(model.reg_frame_ids()[0])
    (tmp_path / "none").mkdir()
    model.write(tmp_path / "none")
    with pytest.raises(DataFileError, match="no image of the model has a pose"):
        find_source(tmp_path / "none")


def test_what_is_no_model_is_told(job: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="has no model 2; it has 0, 1"):
        find_source(job, model=2)
    with pytest.raises(OptionError, match="is the folder of one model"):
        find_source(job / "0", model=0)
    for folder in (tmp_path / "photos", tmp_path / "nothing"):
        with pytest.raises(DataFileError, match="no COLMAP model"):
            find_source(folder)
    (job / "0" / "images.bin").write_bytes((job / "0" / "images.bin").read_bytes()[:20])
    with pytest.raises(DataFileError, match="that can be read"):
        find_source(job)
