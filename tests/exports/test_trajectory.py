"""Trajectories in the TUM format."""

from pathlib import Path

import numpy as np
import pytest
from exported_models import make_model
from scipy.spatial.transform import Rotation

from colmap_vg.exports.source import find_source
from colmap_vg.exports.trajectory import write_tum


@pytest.mark.parametrize(
    ("names", "stamps", "told"),
    [
        (
            ["rgb/1305031102.175304.png", "rgb/1305031102.211214.png", "rgb/1305031101.9.png"],
            ["1305031101.9", "1305031102.175304", "1305031102.211214"],
            "numbers in the images' names",
        ),
        (["frame2.jpg", "frame10.jpg", "frame1.jpg"], ["1", "2", "10"], "numbers"),
        (["b1.jpg", "a1.jpg", "c2.jpg"], ["0", "1", "2"], "places of the images"),
        (["b.jpg", "a\n.jpg", "c2.jpg"], ["0", "1", "2"], "places of the images"),
        (["20200101_1.jpg", "20200101_2.jpg", "20200101_3.jpg"], ["0", "1", "2"], "places of the images"),
        (["1_7.jpg", "2_5.jpg", "3_8.jpg"], ["0", "1", "2"], "places of the images"),
        # Equal as floating-point numbers, as which they are read.
        (["1403636579763555584.png", "1403636579763555585.png", "3.png"], ["0", "1", "2"], "places of the images"),
    ],
)
def test_lines_are_camera_to_world_at_their_time(
    tmp_path: Path, names: list[str], stamps: list[str], told: str
) -> None:
    model = make_model(tmp_path / "model", names=names)
    (note,) = write_tum(find_source(tmp_path / "model"), tmp_path / "out.txt")
    assert told in note
    rows = np.loadtxt(tmp_path / "out.txt")
    assert [line.split()[0] for line in (tmp_path / "out.txt").read_text().splitlines()] == stamps
    order = sorted(names)
    if told.startswith("numbers"):
        order = [next(name for name in names if Path(name).stem.removeprefix("frame") == stamp) for stamp in stamps]
    for row, name in zip(rows, order, strict=True):
        pose = model.find_image_with_name(name).cam_from_world()
        np.testing.assert_allclose(row[1:4], -pose.rotation.matrix().T @ pose.translation, atol=1e-12)
        np.testing.assert_allclose(Rotation.from_quat(row[4:]).as_matrix(), pose.rotation.matrix().T, atol=1e-12)
