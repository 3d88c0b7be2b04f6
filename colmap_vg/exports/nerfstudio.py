"""nerfstudio's ``transforms.json``: intrinsics, camera-to-world matrices, paths of the images and a cloud of points.

Cameras look along -z with y upwards (OpenGL). Distortion is OpenCV's, of the perspective or of the fisheye camera.
World coordinates are the model's own: ``applied_transform`` is the identity, so that versions of nerfstudio that expect
the points before it and those that expect them after it agree.
"""

import json
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pycolmap

from colmap_vg.errors import ImageFolderError, MappingError
from colmap_vg.exports.colmap_files import write_ply
from colmap_vg.exports.source import Source

FILE_NAME, POINTS_NAME = "transforms.json", "sparse_pc.ply"
_COLMAP_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_PERSPECTIVE = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
}
_FISHEYE = {
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "SIMPLE_RADIAL_FISHEYE": ("k1",),
    "RADIAL_FISHEYE": ("k1", "k2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
"""nerfstudio's names of the last parameters of COLMAP's camera models."""


def write_nerfstudio(source: Source, folder: Path, place: Path) -> list[str]:
    """Write ``transforms.json`` and ``sparse_pc.ply``.

    Parameters
    ----------
    source : Source
    folder : Path
        To write to.
    place : Path
        Where the folder is going to be: paths of images are relative to it, or absolute where only the root of the
        file system is above both.

    Returns
    -------
    list of str
        A note on a model without points.

    Raises
    ------
    ImageFolderError
        The photographs are not known, or one is missing.
    MappingError
        nerfstudio does not know a camera model, or perspective and fisheye cameras are mixed.
    OutputError
        A file cannot be written.
    """
    images, photographs = source.images(), source.photographs().resolve()
    # Unlike Path.is_file, this is False for names that are too long.
    missing = [image.name for image in images if not os.path.isfile(photographs / image.name)]  # noqa: PTH113
    if missing:
        raise ImageFolderError(
            f"{len(missing)} of {len(images)} photographs are not in {photographs}, such as {missing[0]!r}: check"
            " image_path"
        )
    camera_ids = {image.camera_id for image in images}
    cameras = {camera_id: source.reconstruction.camera(camera_id) for camera_id in camera_ids}
    intrinsics = {camera_id: _intrinsics(camera) for camera_id, camera in cameras.items()}
    shared = next(iter(intrinsics.values())) if len(intrinsics) == 1 else {}
    frames = [
        {
            "file_path": _path_from(place.resolve(), photographs / image.name),
            "transform_matrix": _opengl_pose(image).tolist(),
            "colmap_im_id": image.image_id,
            **({} if shared else intrinsics[image.camera_id]),
        }
        for image in images
    ]
    content = {
        "camera_model": _camera_model(camera.model_name for camera in cameras.values()),
        **shared,
        "frames": frames,
        "applied_transform": np.eye(4)[:3].tolist(),
    }
    notes = ["the model has no points; nerfstudio starts from random ones"]
    if source.reconstruction.num_points3D() > 0:
        write_ply(source, folder / POINTS_NAME)
        content["ply_file_path"] = POINTS_NAME
        notes = []
    (folder / FILE_NAME).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return notes


def _camera_model(names: Iterable[str]) -> str:
    """nerfstudio's camera model, which holds for all images."""
    names = set(names)
    if names <= {"SIMPLE_PINHOLE", "PINHOLE"}:
        return "PINHOLE"
    if names <= set(_PERSPECTIVE):
        return "OPENCV"
    if names <= set(_FISHEYE):
        return "OPENCV_FISHEYE"
    raise MappingError(
        f"nerfstudio takes perspective or fisheye cameras, not both, and the model has {', '.join(sorted(names))}: "
        "export splat, which undistorts"
    )


def _intrinsics(camera: "pycolmap.Camera") -> dict[str, float | int]:
    """Intrinsics under nerfstudio's names, pixels; the first pixel has its middle at 0.5."""
    names = {**_PERSPECTIVE, **_FISHEYE}.get(camera.model_name)
    if names is None:
        raise MappingError(f"nerfstudio has no {camera.model_name} cameras: export splat, which undistorts")
    given = dict(zip(names, camera.params[len(camera.params) - len(names) :], strict=True))
    last = ("k3", "k4") if camera.model_name in _FISHEYE else ("p1", "p2")
    return {
        "w": int(camera.width),
        "h": int(camera.height),
        "fl_x": float(camera.focal_length_x),
        "fl_y": float(camera.focal_length_y),
        "cx": float(camera.principal_point_x),
        "cy": float(camera.principal_point_y),
        **{name: float(given.get(name, 0.0)) for name in ("k1", "k2", *last)},
    }


def _opengl_pose(image: "pycolmap.Image") -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """World from camera (4, 4), with OpenGL's axes of the camera."""
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().inverse().matrix()
    return np.asarray(pose @ _COLMAP_FROM_OPENGL)


def _path_from(folder: Path, file: Path) -> str:
    if os.path.commonpath([folder, file]) == os.sep:
        return str(file)
    return Path(os.path.relpath(file, folder)).as_posix()
