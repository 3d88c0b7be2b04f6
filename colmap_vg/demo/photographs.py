"""Render a folder of photographs, and keep their true cameras."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.demo.exif import with_focal_length
from colmap_vg.demo.render import RayCaster, photograph, pixel_rays
from colmap_vg.demo.scene import build_ruin
from colmap_vg.demo.texture import paint
from colmap_vg.linear.threads import num_workers
from colmap_vg.simulation.ring_scenes import look_at

Array = NDArray[np.float64]

RING_RADIUS = 4.0
"""Mean radius of the ring of cameras, metres."""
_WIDTH, _HEIGHT = 800, 600  # pixels
_FOCAL_35MM = 40.3  # millimetres; EXIF stores integers
_RADIAL = -0.06  # COLMAP's radial term, dimensionless
_MAX_STEP = np.radians(20.0)  # radians between neighbours


@dataclass(frozen=True, eq=False)
class TrueCameras:
    """Poses and calibration of the rendered photographs.

    Attributes
    ----------
    names : tuple of str
        File names.
    rotations : (n, 3, 3) array
        cam_from_world.
    centers : (n, 3) array
        Projection centres, world frame, metres.
    camera : pycolmap.Camera
        The calibration of all photographs.
    """

    names: tuple[str, ...]
    rotations: Array
    centers: Array
    camera: "pycolmap.Camera"


def true_camera() -> "pycolmap.Camera":
    """Camera of the demo: 800 x 600 pixels, with a radial term and a principal point off the image centre."""
    focal = _FOCAL_35MM / 35.0 * max(_WIDTH, _HEIGHT)  # as COLMAP interprets the EXIF field
    params = [focal, _WIDTH / 2 + 1.5, _HEIGHT / 2 - 1.0, _RADIAL]
    return pycolmap.Camera(model="SIMPLE_RADIAL", width=_WIDTH, height=_HEIGHT, params=params)


def camera_ring(num_images: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Cameras on a ring around the scene with jitter: cam_from_world rotations (n, 3, 3) and centres (n, 3), metres.

    Few cameras cover only part of the ring, so that neighbours can be matched.
    """
    step = min(2 * np.pi / num_images, _MAX_STEP)
    angle = step * (np.arange(num_images) + rng.uniform(-0.15, 0.15, num_images))
    radius = RING_RADIUS * rng.uniform(0.94, 1.06, num_images)
    height = rng.uniform(1.2, 2.2, num_images)
    centers = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    targets = np.array([0.0, 0.0, 0.45]) + rng.uniform(-0.15, 0.15, (num_images, 3))
    return look_at(centers, targets), centers


def render_photographs(
    image_path: Path,
    *,
    num_images: int = 24,
    seed: int = 0,
    num_threads: int = 1,
    on_image: Callable[[int], None] | None = None,
) -> TrueCameras:
    """Render a scene to JPEG files with EXIF data.

    Parameters
    ----------
    image_path : Path
        An existing folder.
    num_images : int
    seed : int
        Random seed of the scene, the cameras and the noise.
    num_threads : int
        Photographs rendered at once, 150 MB each; they do not depend on it. -1: as many as there are cores.
    on_image : callable, optional
        Called with the number of photographs that are done.

    Returns
    -------
    TrueCameras
    """
    import cv2

    scene_rng, _, *image_rngs = np.random.default_rng(seed).spawn(2 + num_images)
    caster = RayCaster(paint(build_ruin(scene_rng), scene_rng))
    cameras = true_cameras(num_images, seed)
    rays = pixel_rays(cameras.camera)

    def render(k: int) -> bytes:
        pixels = photograph(caster, rays, cameras.rotations[k], cameras.centers[k], image_rngs[k])
        _, jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 93])
        return with_focal_length(jpeg.tobytes(), "colmap_vg", "demo", _FOCAL_35MM / 5.6, round(_FOCAL_35MM))

    with ThreadPoolExecutor(num_workers(num_threads)) as pool:
        for k, file in enumerate(pool.map(render, range(num_images))):
            (image_path / cameras.names[k]).write_bytes(file)
            if on_image is not None:
                on_image(k + 1)
    return cameras


def true_cameras(num_images: int, seed: int) -> TrueCameras:
    """Make the cameras of :func:`render_photographs` without rendering."""
    _, ring_rng, *_ = np.random.default_rng(seed).spawn(2 + num_images)
    rotations, centers = camera_ring(num_images, ring_rng)
    return TrueCameras(tuple(f"{k:04d}.jpg" for k in range(num_images)), rotations, centers, true_camera())


def write_truth(path: Path, cameras: TrueCameras) -> None:
    """Write one line per image: name, cam_from_world quaternion (x y z w) and translation, projection centre."""
    lines = [
        "# name  qx qy qz qw  tx ty tz (cam_from_world)  cx cy cz (projection centre, metres)",
        f"# camera {cameras.camera.model_name} {cameras.camera.width} {cameras.camera.height} "
        + " ".join(f"{value:.10g}" for value in cameras.camera.params),
    ]
    for name, R, center in zip(cameras.names, cameras.rotations, cameras.centers, strict=True):
        values = [*pycolmap.Rotation3d(R).quat, *(-R @ center), *center]
        lines.append(" ".join([name, *(f"{value:.10g}" for value in values)]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
