"""Files are there whole, or as they were before."""

from pathlib import Path

import pytest

from colmap_vg.errors import OutputError
from colmap_vg.jobs.atomic_write import atomic_write


def test_the_file_is_replaced_and_nothing_is_left_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for text in ("first\n", "é, x\udcff\r\n"):
        atomic_write(path, text)
        assert path.read_bytes() == text.encode("utf-8", "surrogateescape")
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    atomic_write(path, "first")

    def full(self: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OutputError, match=r"a\.json: No space left on device; free disk space"):
        atomic_write(path, "second")
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(OutputError, match="No such file"):
        atomic_write(tmp_path / "gone" / "a.json", "third")
