"""Exports appear whole or not at all, and replace nothing but exports."""

from pathlib import Path

import pytest

from colmap_vg.errors import MappingError, OutputError
from colmap_vg.exports.publishing import check_output, published


def export(output: Path, text: str, is_folder: bool, fails: bool = False) -> None:
    with published(output, is_folder, {}) as staged:
        (staged / "file" if is_folder else staged).write_text(text)
        assert not (output / "file").exists() or (output / "file").read_text() != text
        if fails:
            raise MappingError("half written")


@pytest.mark.parametrize("is_folder", [True, False])
def test_a_failed_export_leaves_no_trace(tmp_path: Path, is_folder: bool) -> None:
    with pytest.raises(MappingError):
        export(tmp_path / "new" / "out", "half", is_folder, fails=True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("is_folder", [True, False])
def test_a_failed_export_keeps_the_earlier_one(tmp_path: Path, is_folder: bool) -> None:
    output = tmp_path / "out"
    export(output, "first", is_folder)
    with pytest.raises(MappingError):
        export(output, "half", is_folder, fails=True)
    held = output / "file" if is_folder else output
    assert held.read_text() == "first"
    export(output, "second", is_folder)
    assert held.read_text() == "second"
    assert list(tmp_path.iterdir()) == [output]


def test_what_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        export(tmp_path / "file" / "out", "text", False)


def test_only_exports_are_replaced(tmp_path: Path) -> None:
    model = tmp_path / "model"
    model.mkdir()
    (tmp_path / "empty").mkdir()
    check_output(tmp_path / "empty", True, False, (model,))
    (tmp_path / "work" / "images").mkdir(parents=True)
    with pytest.raises(OutputError, match="holds files that are no export"):
        check_output(tmp_path / "work", True, True, (model,))
    export(tmp_path / "out", "first", True)
    with pytest.raises(OutputError, match="replace it with overwrite=True"):
        check_output(tmp_path / "out", True, False, (model,))
    check_output(tmp_path / "out", True, True, (model,))
    with pytest.raises(OutputError, match="is a folder, and this format is a file"):
        check_output(tmp_path / "out", False, True, (model,))
    with pytest.raises(OutputError, match="is a file, and this format is a folder"):
        check_output(tmp_path / "out" / "file", True, True, (model,))


def test_inputs_are_not_replaced(tmp_path: Path) -> None:
    model, photographs = tmp_path / "job" / "0", tmp_path / "photos"
    model.mkdir(parents=True)
    photographs.mkdir()
    (photographs / "a.jpg").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "job")
    for output in (model, model / "points.ply", tmp_path / "job", tmp_path, photographs, tmp_path / "link" / "0"):
        with pytest.raises(OutputError, match="would change the input"):
            check_output(output, True, True, (model, photographs))
    with pytest.raises(OutputError, match="lies in the input"):
        check_output(photographs / "a.jpg", False, True, (model, photographs))
    check_output(tmp_path / "job" / "splat", True, False, (model, photographs))
