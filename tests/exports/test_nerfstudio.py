"""A small reader of transforms.json projects points where pycolmap does."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exported_models import HEIGHT, WIDTH, make_model, write_photographs

from colmap_vg.errors import ImageFolderError, MappingError
from colmap_vg.exports.export import export_model

PERSPECTIVE = ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"]
FISHEYE = ["SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"]


def project(content: dict[str, Any], frame: dict[str, Any], points: np.ndarray) -> np.ndarray:
    """Pixels of world points (n, 3) by OpenCV's formulas, with axes as OpenGL has them."""
    lens = {**content, **frame}
    x, y, z = (np.c_[points, np.ones(len(points))] @ np.linalg.inv(frame["transform_matrix"]).T)[:, :3].T
    x, y = x / -z, -y / -z
    k1, k2, k3, k4, p1, p2 = (lens.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    r2 = x**2 + y**2
    if content["camera_model"] == "OPENCV_FISHEYE":
        theta = np.arctan(np.sqrt(r2))
        bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8) / np.sqrt(r2)
        u, v = bent * x, bent * y
    else:
        bent = 1 + k1 * r2 + k2 * r2**2
        u = bent * x + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
        v = bent * y + 2 * p2 * x * y + p1 * (r2 + 2 * y**2)
    return np.stack([lens["fl_x"] * u + lens["cx"], lens["fl_y"] * v + lens["cy"]], axis=1)


def read_points(path: Path) -> np.ndarray:
    data = path.read_bytes().partition(b"end_header\n")[2]
    return np.frombuffer(data, np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))["xyz"].astype(np.float64)


@pytest.mark.parametrize("lenses", [*([lens] for lens in PERSPECTIVE + FISHEYE), PERSPECTIVE, FISHEYE], ids="-".join)
def test_points_are_projected_as_pycolmap_does(tmp_path: Path, lenses: list[str]) -> None:
    model = make_model(tmp_path / "model", lenses)
    photographs = write_photographs(tmp_path / "photos", model)
    export_model(tmp_path / "model", tmp_path / "out", "nerfstudio", image_path=photographs)
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert len(content["frames"]) == 3 * len(lenses)
    np.testing.assert_array_equal(content["applied_transform"], np.eye(4)[:3])
    points = read_points(tmp_path / "out" / content["ply_file_path"])
    assert len(points) == 40
    for frame in content["frames"]:
        image = model.image(frame["colmap_im_id"])
        assert (tmp_path / "out" / frame["file_path"]).resolve() == photographs / image.name
        lens = {**content, **frame}
        assert (lens["w"], lens["h"]) == (WIDTH, HEIGHT)
        expected = model.camera(image.camera_id).img_from_cam(image.cam_from_world() * points)
        np.testing.assert_allclose(project(content, frame, points), expected, atol=1e-3)


@pytest.mark.parametrize(
    ("lenses", "told"),
    [
        (["FOV"], "nerfstudio has no FOV cameras: export splat"),
        (["FULL_OPENCV", "PINHOLE"], "nerfstudio has no FULL_OPENCV cameras"),
        (["PINHOLE", "OPENCV_FISHEYE"], "not both, and the model has OPENCV_FISHEYE, PINHOLE"),
    ],
)
def test_other_cameras_are_refused(tmp_path: Path, lenses: list[str], told: str) -> None:
    photographs = write_photographs(tmp_path / "photos", make_model(tmp_path / "model", lenses))
    with pytest.raises(MappingError, match=told):
        export_model(tmp_path / "model", tmp_path / "out", "nerfstudio", image_path=photographs)
    assert not (tmp_path / "out").exists()


def test_photographs_have_any_name(tmp_path: Path) -> None:
    names = ["a/x.png", "b/x.png", "two\nlines 'é' \"q\".png"]
    model = make_model(tmp_path / "model", names=names)
    photographs = write_photographs(tmp_path / "photos", model)
    export_model(tmp_path / "model", tmp_path / "out", "nerfstudio", image_path=photographs)
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [f"../photos/{name}" for name in names]
    (photographs / names[0]).unlink()
    with pytest.raises(ImageFolderError, match=r"1 of 3 photographs are not in .*, such as 'a/x.png'"):
        export_model(tmp_path / "model", tmp_path / "new", "nerfstudio", image_path=photographs)


def test_names_that_no_file_system_holds_are_told(tmp_path: Path) -> None:
    make_model(tmp_path / "model", names=["x" * 300 + ".png"])
    with pytest.raises(ImageFolderError, match="3 of 3 photographs are not in"):
        export_model(tmp_path / "model", tmp_path / "out", "nerfstudio", image_path=tmp_path)


def test_a_model_without_points_has_no_cloud(tmp_path: Path) -> None:
    model = make_model(tmp_path / "model")
    model.delete_all_points2D_and_points3D()
    model.write(tmp_path / "model")
    photographs = write_photographs(tmp_path / "photos", model)
    done = export_model(tmp_path / "model", tmp_path / "out", "nerfstudio", image_path=photographs)
    assert "no points" in done.notes[0]
    assert "ply_file_path" not in json.loads((tmp_path / "out" / "transforms.json").read_text())
