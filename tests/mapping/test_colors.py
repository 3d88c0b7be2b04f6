"""Colours of points, from photographs of any size and format."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.ndimage import map_coordinates
from synthetic_databases import make_database

from colmap_vg.events import StageLog
from colmap_vg.mapping.colors import extract_colors, interpolated

COLOR = (200, 100, 50)


@pytest.fixture
def model(tmp_path: Path) -> pycolmap.Reconstruction:
    truth = make_database(tmp_path / "database.db", num_images=4, num_points=30)
    for point in truth.points3D.values():
        point.color = np.zeros(3, dtype=np.uint8)
    return truth


def paint(folder: Path, names: list[str], height: int = 768) -> Path:
    folder.mkdir(exist_ok=True)
    for name in names:
        pixels = np.broadcast_to(np.array(COLOR, dtype=np.uint8), (height, 1024 * height // 768, 3))
        pycolmap.Bitmap.from_array(np.ascontiguousarray(pixels)).write(folder / name)
    return folder


def test_points_take_the_colours_of_their_photographs(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    log = StageLog()
    folder = paint(tmp_path / "images", [image.name for image in model.images.values()])
    extract_colors(model, folder, log)
    assert {tuple(point.color.tolist()) for point in model.points3D.values()} == {COLOR}
    assert log.warnings == []


def test_missing_photographs_are_named_and_the_others_used(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    log = StageLog()
    names = sorted(image.name for image in model.images.values())
    folder = paint(tmp_path / "images", names[2:])
    extract_colors(model, folder, log)
    assert {tuple(point.color.tolist()) for point in model.points3D.values()} == {COLOR}
    assert len(log.warnings) == 1
    assert log.warnings[0].startswith(
        f"2 of 4 registered images are missing in {folder} or cannot be read (first: {names[0]})"
    )


def test_a_photograph_that_cannot_be_read_costs_its_colours_only(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    log = StageLog()
    names = sorted(image.name for image in model.images.values())
    folder = paint(tmp_path / "images", names[1:])
    (folder / names[0]).write_bytes(b"\x89PNG\r\n\x1a\n but cut off")
    extract_colors(model, folder, log)
    assert {tuple(point.color.tolist()) for point in model.points3D.values()} == {COLOR}


def test_without_a_folder_nothing_is_asked_or_said(model: pycolmap.Reconstruction) -> None:
    log = StageLog()
    extract_colors(model, None, log)
    assert {tuple(point.color.tolist()) for point in model.points3D.values()} == {(0, 0, 0)}
    assert log.warnings == []


def test_smaller_copies_give_the_same_colours(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    """Points at the right border of the photographs would be outside of copies of a quarter of their size."""
    log = StageLog()
    folder = paint(tmp_path / "images", [image.name for image in model.images.values()], height=192)
    extract_colors(model, folder, log)
    assert {tuple(point.color.tolist()) for point in model.points3D.values()} == {COLOR}
    assert log.warnings == []


def test_files_of_other_proportions_are_named(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    log = StageLog()
    names = sorted(image.name for image in model.images.values())
    folder = paint(tmp_path / "images", names[1:])
    cv2.imwrite(str(folder / names[0]), np.zeros((1024, 768, 3), np.uint8))
    extract_colors(model, folder, log)
    assert {tuple(point.color.tolist()) for point in model.points3D.values()} == {COLOR}
    (warning,) = log.warnings
    assert warning.startswith("1 of 4 registered images differ in aspect ratio")


@pytest.mark.parametrize("suffix", [".webp", ".tif"])
def test_formats_and_bits_that_colmap_does_not_read(
    model: pycolmap.Reconstruction, tmp_path: Path, suffix: str
) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    bgr = np.broadcast_to(np.array(COLOR[::-1], np.uint16), (768, 1024, 3))
    pixels, options = (bgr * 16, []) if suffix == ".tif" else (bgr.astype(np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101])
    for image in model.images.values():
        data = cv2.imencode(suffix, np.ascontiguousarray(pixels), options)[1]
        (folder / image.name).write_bytes(data.tobytes())
    extract_colors(model, folder, StageLog())
    colors = np.array([point.color for point in model.points3D.values()])
    assert np.abs(colors.astype(int) - COLOR).max() <= 1


def test_colours_between_pixels_as_scipy_has_them() -> None:
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (7, 9, 3), dtype=np.uint8)
    points = rng.uniform(-1.0, 10.0, (50, 2))
    channels = [
        map_coordinates(pixels[:, :, channel].astype(float), points.T[::-1] - 0.5, order=1, mode="nearest")
        for channel in range(3)
    ]
    assert np.abs(interpolated(pixels, points) - np.stack(channels, axis=1)).max() < 1e-9
