"""Bundler files hold the poses, and project the points where they are seen."""

from pathlib import Path

import numpy as np
import pytest
from exported_models import HEIGHT, WIDTH, make_model

from colmap_vg.datasets.bundle import read_bundle
from colmap_vg.errors import MappingError
from colmap_vg.exports.bundler import write_bundler
from colmap_vg.exports.source import find_source


def reprojection_errors(path: Path) -> np.ndarray:
    """Distances in pixels between points projected by Bundler's formula and where they are seen."""
    values = [list(map(float, line.split())) for line in path.read_text().splitlines()[1:]]
    num_cameras, num_points = map(int, values[0])
    cameras = [values[1 + 5 * k : 6 + 5 * k] for k in range(num_cameras)]
    errors = []
    for k in range(num_points):
        xyz, _, views = values[1 + 5 * num_cameras + 3 * k : 4 + 5 * num_cameras + 3 * k]
        for camera, _, x, y in np.reshape(views[1:], (int(views[0]), 4)):
            (f, k1, k2), *R, t = cameras[int(camera)]
            P = np.array(R) @ xyz + t
            p = -P[:2] / P[2]
            r2 = p @ p
            errors.append(np.linalg.norm(f * (1 + k1 * r2 + k2 * r2**2) * p - [x, y]))
    return np.array(errors)


@pytest.mark.parametrize("lens", ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"])
def test_points_are_projected_where_they_are_seen(tmp_path: Path, lens: str) -> None:
    make_model(tmp_path / "model", (lens, "SIMPLE_RADIAL"))
    (note,) = write_bundler(find_source(tmp_path / "model"), tmp_path)
    assert f"{np.hypot(81 - WIDTH / 2, 59 - HEIGHT / 2):.1f} px away" in note
    errors = reprojection_errors(tmp_path / "bundle.out")
    assert len(errors) == 6 * 40
    assert errors.max() < 1e-9


def test_poses_are_those_of_the_list(tmp_path: Path) -> None:
    model = make_model(tmp_path / "model", names=["b/x.jpg", "a/x.jpg", "é 'q'.jpg"])
    write_bundler(find_source(tmp_path / "model"), tmp_path)
    names = (tmp_path / "list.txt").read_text(encoding="utf-8").splitlines()
    assert names == ["a/x.jpg", "b/x.jpg", "é 'q'.jpg"]
    poses = read_bundle(tmp_path / "bundle.out")
    for row, name in enumerate(names):
        image = model.find_image_with_name(name)
        np.testing.assert_allclose(poses[row][0], image.cam_from_world().rotation.matrix(), atol=1e-12)
        np.testing.assert_allclose(poses[row][1], image.projection_center(), atol=1e-12)


@pytest.mark.parametrize(
    ("lens", "name", "told"),
    [
        ("OPENCV", "a.jpg", "no OPENCV cameras: export splat"),
        ("PINHOLE", "a.jpg", "one focal length per camera, and camera 1 has two, 150 and 140"),
        ("SIMPLE_RADIAL", "two\nlines.jpg", "which has a line break"),
    ],
)
def test_what_bundler_cannot_hold_is_refused(tmp_path: Path, lens: str, name: str, told: str) -> None:
    make_model(tmp_path / "model", (lens,), [name])
    with pytest.raises(MappingError, match=told):
        write_bundler(find_source(tmp_path / "model"), tmp_path)
