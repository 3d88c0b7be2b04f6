"""Bundler's format: ``bundle.out`` with cameras and points, and ``list.txt`` with the images' names.

A camera is ``f k1 k2``, a rotation R and a translation t from world to camera, and looks along -z with y upwards. A
point P = (x, y, z) in its frame is seen at ``f (1 + k1 r^2 + k2 r^4) p`` pixels from the principal point, to the right
and upwards, with p = -(x, y) / z and r = ||p|| (Bundler 0.3, user's manual).
"""

from pathlib import Path

import numpy as np
import pycolmap

from colmap_vg.errors import MappingError
from colmap_vg.exports.source import Source

BUNDLE_NAME, LIST_NAME = "bundle.out", "list.txt"
BUNDLER_FROM_COLMAP = np.diag([1.0, -1.0, -1.0])
SAME_FOCAL = 1e-9
"""Relative difference of two focal lengths that are one."""
CENTRED_PX = 1.0
"""Distance of the principal point from the image's centre, pixels, beyond which a note says that Bundler assumes it."""
_COEFFICIENTS = {"SIMPLE_PINHOLE": (), "PINHOLE": (), "SIMPLE_RADIAL": (3,), "RADIAL": (3, 4)}
"""Places of k1 and k2 among the parameters of the camera models that Bundler can express."""


def write_bundler(source: Source, folder: Path) -> list[str]:
    """Write ``bundle.out`` and ``list.txt``.

    Returns
    -------
    list of str
        A note, where principal points are not in the centre.

    Raises
    ------
    MappingError
        A camera has another model than Bundler's or two focal lengths, or a name has a line break.
    """
    images, model = source.images(), source.reconstruction
    for image in images:
        if "\n" in image.name or "\r" in image.name:
            raise MappingError(f"Bundler's list cannot hold the image name {image.name!r}, which has a line break")
    cameras = {image.camera_id: model.camera(image.camera_id) for image in images}
    intrinsics = {camera_id: _intrinsics(camera) for camera_id, camera in cameras.items()}
    lines = ["# Bundle file v0.3", f"{len(images)} {model.num_points3D()}"]
    for image in images:
        pose = image.cam_from_world()
        R, t = BUNDLER_FROM_COLMAP @ pose.rotation.matrix(), BUNDLER_FROM_COLMAP @ pose.translation
        lines += [_row(values) for values in (intrinsics[image.camera_id], *R, t)]
    rows = {image.image_id: row for row, image in enumerate(images)}
    for point_id in sorted(model.points3D):
        point = model.point3D(point_id)
        views = []
        for element in point.track.elements:
            image = model.image(element.image_id)
            camera = cameras[image.camera_id]
            x, y = image.point2D(element.point2D_idx).xy
            place = _row([x - camera.principal_point_x, camera.principal_point_y - y])
            views.append(f"{rows[element.image_id]} {element.point2D_idx} {place}")
        lines += [_row(point.xyz), " ".join(map(str, point.color.tolist())), " ".join([str(len(views)), *views])]
    (folder / BUNDLE_NAME).write_text("\n".join(lines) + "\n", encoding="ascii")
    (folder / LIST_NAME).write_text("".join(f"{image.name}\n" for image in images), encoding="utf-8", newline="")
    off = max(
        float(np.hypot(camera.principal_point_x - camera.width / 2, camera.principal_point_y - camera.height / 2))
        for camera in cameras.values()
    )
    if off <= CENTRED_PX:
        return []
    return [f"Bundler takes the centre of an image for its principal point, which is up to {off:.1f} px away"]


def _intrinsics(camera: "pycolmap.Camera") -> tuple[float, float, float]:
    """Focal length in pixels, k1 and k2 of a camera."""
    places = _COEFFICIENTS.get(camera.model_name)
    if places is None:
        raise MappingError(
            f"Bundler has no {camera.model_name} cameras: export splat, which undistorts, or make the model with "
            "camera_model='SIMPLE_RADIAL'"
        )
    fx, fy = camera.focal_length_x, camera.focal_length_y
    if abs(fx - fy) > SAME_FOCAL * fx:
        raise MappingError(
            f"Bundler has one focal length per camera, and camera {camera.camera_id} has two, {fx:.6g} and {fy:.6g}: "
            "make the model with camera_model='SIMPLE_RADIAL'"
        )
    k1, k2 = [*(float(camera.params[place]) for place in places), 0.0, 0.0][:2]
    return float(fx), k1, k2


def _row(values: object) -> str:
    return " ".join(repr(value) for value in np.asarray(values, dtype=np.float64).tolist())
