"""What is said of focal lengths that no pair can check."""

from pathlib import Path
from typing import Any

import pytest
from synthetic_databases import changed_copy, make_database

from colmap_vg import ReadOptions
from colmap_vg.calibration.self_calibration import SelfCalibration, estimate_focal_lengths
from colmap_vg.reading import focals
from colmap_vg.reading.read import read_with_caveats

CHANGES = {
    "in 15 pairs all matches lie on one plane": "UPDATE two_view_geometries SET config = 4",
    "or the camera only rotated": "UPDATE two_view_geometries SET config = 5",
    "COLMAP found no geometry for the pairs": "UPDATE two_view_geometries SET config = 1",
    "no pair has the required 16 matches": "UPDATE two_view_geometries SET rows = 15, data = substr(data, 1, 120)",
}


@pytest.mark.parametrize("reason", CHANGES)
def test_the_reason_is_the_true_one(reason: str, tmp_path: Path) -> None:
    make_database(tmp_path / "a.db", num_images=6, num_points=100)
    path = changed_copy(tmp_path / "a.db", tmp_path / "b.db", CHANGES[reason])
    _, caveats = read_with_caveats(path, ReadOptions())
    (told,) = [caveat for caveat in caveats if "focal lengths" in caveat]
    assert told.startswith("The focal lengths cannot be checked")
    assert reason in told


def test_cameras_of_one_model_and_size_are_one_lens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_database(tmp_path / "a.db", num_images=6, num_points=100)
    asked: list[list[int]] = []

    def estimated(*arguments: Any, **options: Any) -> SelfCalibration:
        asked.append(options["lens_groups"].tolist())
        return estimate_focal_lengths(*arguments, **options)

    monkeypatch.setattr(focals, "estimate_focal_lengths", estimated)
    columns = "model, {}, height, params, prior_focal_length FROM cameras WHERE camera_id = 1"
    copies = [
        f"INSERT INTO cameras SELECT {number}, {columns.format(width)}"
        for number, width in ((2, "width"), (3, "width + 2"))
    ]
    moves = [f"UPDATE images SET camera_id = {number} WHERE image_id = {number}" for number in (2, 3)]
    path = changed_copy(tmp_path / "a.db", tmp_path / "b.db", *copies, *moves)
    read_with_caveats(path, ReadOptions())
    assert asked == [[0, 0, 1]]
