"""A reader of COLMAP's old binary format, as trainers of Gaussian splatting have it, reads undistorted exports."""

import struct
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
import pycolmap
import pytest
from exported_models import HEIGHT, WIDTH, contents, make_model, write_photographs

from colmap_vg.errors import ImageFolderError, MappingError
from colmap_vg.exports.export import export_model

PINHOLE = 1


def take(file: BinaryIO, kinds: str) -> tuple[Any, ...]:
    return struct.unpack("<" + kinds, file.read(struct.calcsize("<" + kinds)))


def read_sparse(folder: Path) -> tuple[dict[int, Any], dict[str, Any], np.ndarray]:
    """Cameras (model, width, height, parameters), images (quaternion w first, translation, camera, x y id), points."""
    cameras, images, points = {}, {}, []
    with (folder / "cameras.bin").open("rb") as file:
        for _ in range(take(file, "Q")[0]):
            camera_id, model, width, height = take(file, "iiQQ")
            assert model == PINHOLE
            cameras[camera_id] = (width, height, take(file, "dddd"))
        assert file.read() == b""
    with (folder / "images.bin").open("rb") as file:
        for _ in range(take(file, "Q")[0]):
            _, *pose, camera_id = take(file, "idddddddi")
            name = b""
            while (letter := file.read(1)) != b"\0":
                name += letter
            (count,) = take(file, "Q")
            seen = np.array(take(file, "ddq" * count)).reshape(count, 3)
            images[name.decode()] = (np.array(pose[:4]), np.array(pose[4:]), camera_id, seen)
        assert file.read() == b""
    with (folder / "points3D.bin").open("rb") as file:
        for _ in range(take(file, "Q")[0]):
            point_id, *xyz, _, _, _, _ = take(file, "QdddBBBd")
            take(file, "ii" * take(file, "Q")[0])
            points.append([point_id, *xyz])
        assert file.read() == b""
    return cameras, images, np.array(points)


def rotation(w: float, x: float, y: float, z: float) -> np.ndarray:
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@pytest.mark.parametrize(
    "lenses", [["SIMPLE_PINHOLE"], ["PINHOLE", "OPENCV", "SIMPLE_RADIAL"], ["OPENCV_FISHEYE", "FOV"]], ids="-".join
)
@pytest.mark.parametrize("max_image_size", [None, 100])
def test_trainers_read_pinhole_cameras(tmp_path: Path, lenses: list[str], max_image_size: int | None) -> None:
    model = make_model(tmp_path / "model", lenses)
    photographs = write_photographs(tmp_path / "photos", model)
    inputs = contents(tmp_path)
    out = tmp_path / "out"
    export_model(tmp_path / "model", out, "splat", image_path=photographs, max_image_size=max_image_size)
    assert {name: data for name, data in contents(tmp_path).items() if not name.startswith("out/")} == inputs
    assert sorted(path.name for path in out.iterdir()) == ["export.json", "images", "sparse"]
    assert sorted(path.name for path in (out / "sparse/0").iterdir()) == ["cameras.bin", "images.bin", "points3D.bin"]
    cameras, images, points = read_sparse(out / "sparse" / "0")
    assert set(contents(out / "images")) == set(images) == {image.name for image in model.images.values()}
    place = {int(row[0]): row[1:] for row in points}
    for name, (quaternion, t, camera_id, seen) in images.items():
        width, height, (fx, fy, cx, cy) = cameras[camera_id]
        assert cv2.imread(str(out / "images" / name)).shape[:2] == (height, width)
        assert max(width, height) == (max_image_size or max(width, height))
        linked = seen[seen[:, 2] >= 0]
        x, y, z = (np.array([place[int(k)] for k in linked[:, 2]]) @ rotation(*quaternion).T + t).T
        pixels = np.stack([fx * x / z + cx, fy * y / z + cy], axis=1)
        assert len(linked) == 40
        np.testing.assert_allclose(pixels, linked[:, :2], atol=1e-3)


def test_images_are_undistorted(tmp_path: Path) -> None:
    model = make_model(tmp_path / "model", ["OPENCV"])
    photographs = write_photographs(tmp_path / "photos", model)
    export_model(tmp_path / "model", tmp_path / "out", "splat", image_path=photographs)
    cameras, images, _ = read_sparse(tmp_path / "out" / "sparse" / "0")
    for name, (_, _, camera_id, _) in images.items():
        width, height, (fx, fy, cx, cy) = cameras[camera_id]
        column, row = np.meshgrid(np.arange(20, width - 20), np.arange(20, height - 20))
        rays = np.stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, np.ones(row.shape)], axis=-1)
        source = model.camera(camera_id).img_from_cam(rays.reshape(-1, 3)).astype(np.float32).reshape(*row.shape, 2)
        before = cv2.imread(str(photographs / name))
        expected = cv2.remap(before, source[..., 0] - 0.5, source[..., 1] - 0.5, cv2.INTER_LINEAR)
        found = cv2.imread(str(tmp_path / "out" / "images" / name))[20:-20, 20:-20]
        assert np.abs(found.astype(int) - expected.astype(int)).mean() < 1.0
        assert np.abs(before[20 : height - 20, 20 : width - 20].astype(int) - expected).mean() > 5.0


def test_images_of_a_rig_have_their_own_poses(tmp_path: Path) -> None:
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=2, camera_width=WIDTH, camera_height=HEIGHT
    )
    options.camera_params = [150.0, 80.0, 60.0, 0.05]
    model = pycolmap.synthesize_dataset(options)
    (tmp_path / "model").mkdir()
    model.write(tmp_path / "model")
    photographs = write_photographs(tmp_path / "photos", model)
    export_model(tmp_path / "model", tmp_path / "out", "splat", image_path=photographs)
    _, images, _ = read_sparse(tmp_path / "out" / "sparse" / "0")
    assert len(images) == 4
    for name, (quaternion, t, _, _) in images.items():
        pose = model.find_image_with_name(name).cam_from_world()
        np.testing.assert_allclose(rotation(*quaternion), pose.rotation.matrix(), atol=1e-9)
        np.testing.assert_allclose(t, pose.translation, atol=1e-9)


def test_images_have_any_name_inside_the_folder(tmp_path: Path) -> None:
    names = ["a/x.jpg", "b/x.jpg", "two\nlines 'é' \"q\".png"]
    photographs = write_photographs(tmp_path / "photos", make_model(tmp_path / "model", names=names))
    done = export_model(tmp_path / "model", tmp_path / "out", "splat", image_path=photographs)
    assert sorted(contents(tmp_path / "out" / "images")) == sorted(names)
    assert set(read_sparse(tmp_path / "out" / "sparse" / "0")[1]) == set(names)
    assert ["folders" in done.notes[0], "ASCII" in done.notes[1]] == [True, True]


@pytest.mark.parametrize("name", ["../x.png", "a/../../x.png", "/x.png"])
def test_names_that_leave_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "photos").mkdir()
    make_model(tmp_path / "model", names=[name if name[0] == "." else f"{tmp_path}{name}"])
    with pytest.raises(MappingError, match="leads out of the output folder"):
        export_model(tmp_path / "model", tmp_path / "out", "splat", image_path=tmp_path / "photos")


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-30])


def smaller(path: Path) -> None:
    cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH - 1, 3), np.uint8))


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (Path.unlink, "there is no such file"),
        (truncated, "the PNG file is truncated"),
        (smaller, "has 159 x 120 pixels, and its camera 160 x 120"),
    ],
)
def test_photographs_that_are_not_those_of_the_model_are_told(tmp_path: Path, damage: Any, told: str) -> None:
    model = make_model(tmp_path / "model")
    photographs = write_photographs(tmp_path / "photos", model)
    damage(photographs / model.image(2).name)
    with pytest.raises(ImageFolderError, match=told):
        export_model(tmp_path / "model", tmp_path / "out", "splat", image_path=photographs)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model", "photos"]


def test_names_that_no_file_system_holds_are_told(tmp_path: Path) -> None:
    make_model(tmp_path / "model", names=["a" * 300 + ".png"])
    (tmp_path / "photos").mkdir()
    with pytest.raises(ImageFolderError, match="File name too long"):
        export_model(tmp_path / "model", tmp_path / "out", "splat", image_path=tmp_path / "photos")


def test_images_that_colmap_does_not_write_are_told(tmp_path: Path) -> None:
    photographs = write_photographs(tmp_path / "photos", make_model(tmp_path / "model", names=["a.webp"]))
    with pytest.raises(MappingError, match=r"could not undistort 'a.webp'.*convert"):
        export_model(tmp_path / "model", tmp_path / "out", "splat", image_path=photographs)


def test_spherical_cameras_are_refused(tmp_path: Path) -> None:
    model = make_model(tmp_path / "model")
    camera = model.camera(1)
    camera.model = pycolmap.CameraModelId.EQUIRECTANGULAR
    camera.params = [WIDTH, HEIGHT]
    model.write(tmp_path / "model")
    photographs = write_photographs(tmp_path / "photos", model)
    with pytest.raises(MappingError, match="has a spherical camera"):
        export_model(tmp_path / "model", tmp_path / "out", "splat", image_path=photographs)
