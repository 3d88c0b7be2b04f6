"""Synthetic models with photographs of noise, to be exported."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pycolmap

WIDTH, HEIGHT = 160, 120
PARAMETERS = {
    "SIMPLE_PINHOLE": [150.0, 81.0, 59.0],
    "PINHOLE": [150.0, 140.0, 81.0, 59.0],
    "SIMPLE_RADIAL": [150.0, 81.0, 59.0, 0.08],
    "RADIAL": [150.0, 81.0, 59.0, -0.1, 0.03],
    "OPENCV": [150.0, 140.0, 81.0, 59.0, -0.1, 0.03, 0.004, -0.003],
    "SIMPLE_FISHEYE": [150.0, 81.0, 59.0],
    "FISHEYE": [150.0, 140.0, 81.0, 59.0],
    "SIMPLE_RADIAL_FISHEYE": [150.0, 81.0, 59.0, 0.05],
    "RADIAL_FISHEYE": [150.0, 81.0, 59.0, 0.05, -0.02],
    "OPENCV_FISHEYE": [150.0, 140.0, 81.0, 59.0, 0.05, -0.02, 0.01, -0.004],
    "FOV": [150.0, 140.0, 81.0, 59.0, 0.3],
    "FULL_OPENCV": [150.0, 140.0, 81.0, 59.0, -0.1, 0.03, 0.004, -0.003, 0.01, 0.02, 0.01, 0.003],
}


def make_model(
    folder: Path, lenses: Sequence[str] = ("SIMPLE_RADIAL",), names: Sequence[str] | None = None, num_points: int = 40
) -> pycolmap.Reconstruction:
    """Write a model of one camera per lens, three images each, to a folder.

    `names` are given to the images in the order of their ids; default: those of `pycolmap.synthesize_dataset`.
    """
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=len(lenses), num_frames_per_rig=3, num_points3D=num_points, camera_width=WIDTH, camera_height=HEIGHT
    )
    options.camera_params = [150.0, 80.0, 60.0, 0.05]
    model = pycolmap.synthesize_dataset(options)
    for camera_id, lens in zip(sorted(model.cameras), lenses, strict=True):
        camera = model.camera(camera_id)
        camera.model = pycolmap.CameraModelId.__members__[lens]
        camera.params = PARAMETERS[lens]
    for image_id, name in zip(sorted(model.images), names or (), strict=False):
        model.image(image_id).name = name
    for image in model.images.values():
        for point2D in image.points2D:
            if point2D.has_point3D():
                point = model.point3D(point2D.point3D_id).xyz
                point2D.xy = model.camera(image.camera_id).img_from_cam(image.cam_from_world() * point)
    folder.mkdir(parents=True)
    model.write(folder)
    return pycolmap.Reconstruction(folder)


def write_photographs(folder: Path, model: pycolmap.Reconstruction) -> Path:
    """Write an image of smooth noise for each image of a model, under its name."""
    rng = np.random.default_rng(0)
    for image in model.images.values():
        path = folder / image.name
        path.parent.mkdir(parents=True, exist_ok=True)
        coarse = rng.integers(0, 256, (HEIGHT // 10, WIDTH // 10, 3), dtype=np.uint8)
        _, data = cv2.imencode(path.suffix, cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC))
        path.write_bytes(data.tobytes())
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """Bytes of all files under a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
