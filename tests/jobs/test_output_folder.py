"""The output folder is refused when it cannot take a model, and never holds a half one."""

from pathlib import Path

import pytest

from colmap_vg.errors import OutputError
from colmap_vg.jobs.output_folder import existing_models, prepare_output, publish_models


def model(path: Path, content: str) -> Path:
    path.mkdir(parents=True)
    (path / "cameras.bin").write_text(content)
    return path


def test_a_new_folder_and_an_empty_one_are_fine(tmp_path: Path) -> None:
    assert prepare_output(tmp_path / "a" / "b").is_dir()
    assert prepare_output(tmp_path / "a" / "b") == tmp_path / "a" / "b" / ".work"
    assert list((tmp_path / "a" / "b" / ".work").iterdir()) == []


def test_a_path_under_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match="choose another output_path"):
            prepare_output(path)


@pytest.mark.parametrize("place", ["0", "3", "."])
def test_a_model_is_not_overwritten_unasked(tmp_path: Path, place: str) -> None:
    model(tmp_path / "out" / place, "old")
    with pytest.raises(OutputError, match="overwrite=True"):
        prepare_output(tmp_path / "out")
    assert not (tmp_path / "out" / ".work").exists()
    prepare_output(tmp_path / "out", overwrite=True)
    assert (tmp_path / "out" / place / "cameras.bin").read_text() == "old"


def test_folders_that_hold_no_model_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "7").mkdir()
    (tmp_path / "7" / "notes.txt").write_text("mine")
    work = prepare_output(tmp_path)
    publish_models([model(work / "new", "new")], tmp_path)
    assert (tmp_path / "7" / "notes.txt").read_text() == "mine"


def test_models_replace_all_older_ones(tmp_path: Path) -> None:
    for index in range(3):
        model(tmp_path / str(index), f"old {index}")
    work = prepare_output(tmp_path, overwrite=True)
    published = publish_models([model(work / "a", "new 0"), model(work / "b", "new 1")], tmp_path)
    assert published == [tmp_path / "0", tmp_path / "1"] == existing_models(tmp_path)
    assert [(path / "cameras.bin").read_text() for path in published] == ["new 0", "new 1"]
