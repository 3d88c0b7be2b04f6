"""Colours of points: the mean over the images that observe each point."""

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_vg.colmap_io.model_observations import ModelObservations
from colmap_vg.events import StageLog
from colmap_vg.features.pixels import decoded, stretched

if TYPE_CHECKING:
    import pycolmap

Array = NDArray[np.float64]

MAX_ASPECT_CHANGE = 0.01
"""Maximum relative change of aspect ratio between a photograph and a resized copy, whose sides are rounded to pixels; a
file beyond it is a different picture."""


def extract_colors(
    reconstruction: "pycolmap.Reconstruction", image_path: str | PathLike[str] | None, log: StageLog
) -> None:
    """Set the colour of each point to the mean over its images, and warn of images that cannot be used.

    The files may be resized copies of the images.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
        Modified in place.
    image_path : path or None
        Folder of the images; with None all points stay black.
    log : StageLog
    """
    if image_path is None:
        return
    folder = Path(image_path)
    observed = ModelObservations.of(reconstruction)
    rows = np.searchsorted(observed.every_point, observed.point_ids)
    total, count = np.zeros((len(observed.every_point), 3)), np.zeros(len(observed.every_point))
    missing, unlike = [], []
    for image_id in sorted(reconstruction.reg_image_ids()):
        image = reconstruction.image(image_id)
        camera = reconstruction.camera(image.camera_id)
        pixels = _read(folder / image.name)
        if pixels is None:
            missing.append(image.name)
            continue
        scale = np.array([pixels.shape[1] / camera.width, pixels.shape[0] / camera.height])
        if abs(scale[0] / scale[1] - 1.0) > MAX_ASPECT_CHANGE:
            unlike.append(image.name)
            continue
        own = slice(*np.searchsorted(observed.image_ids, [image_id, image_id + 1]))
        total[rows[own]] += interpolated(pixels, observed.keypoints[own] * scale)[:, ::-1]
        count[rows[own]] += 1.0
    _warn(missing, f"are missing in {folder} or cannot be read", reconstruction, log)
    _warn(unlike, f"differ in aspect ratio from the files in {folder}", reconstruction, log)
    colors = np.round(total / np.maximum(count, 1.0)[:, None]).astype(np.uint8)
    for point_id, color in zip(observed.every_point.tolist(), colors, strict=True):
        reconstruction.point3D(point_id).color = color


def interpolated(pixels: NDArray[np.uint8], points: Array) -> Array:
    """Interpolate the colours of a picture bilinearly at points.

    Parameters
    ----------
    pixels : (h, w, 3) uint8 array
    points : (n, 2) array
        Pixels, in COLMAP's convention: the centre of the first pixel is at (0.5, 0.5).

    Returns
    -------
    (n, 3) array
        Points outside of the picture get the colour of its border.
    """
    height, width = pixels.shape[:2]
    at = np.clip(points - 0.5, 0.0, np.array([width - 1.0, height - 1.0]))
    low = np.minimum(at.astype(np.int64), np.maximum(np.array([width, height]) - 2, 0))
    (x, y), (u, v) = low.T, (at - low).T[:, :, None]
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    top = (1.0 - u) * pixels[y, x] + u * pixels[y, right]
    return np.asarray((1.0 - v) * top + v * ((1.0 - u) * pixels[below, x] + u * pixels[below, right]))


def _read(path: Path) -> NDArray[np.uint8] | None:
    """Read a picture as blue, green and red, without applying the EXIF orientation; None where it cannot be read."""
    try:
        pixels = decoded(path.read_bytes())
    except OSError:
        return None
    if pixels is None:
        return None
    if pixels.dtype == np.uint16:
        pixels = stretched(pixels) >> 8
    pixels = np.atleast_3d(pixels)[:, :, :3].astype(np.uint8, copy=False)
    return np.broadcast_to(pixels[:, :, :1], (*pixels.shape[:2], 3)) if pixels.shape[2] < 3 else pixels


def _warn(names: list[str], why: str, reconstruction: "pycolmap.Reconstruction", log: StageLog) -> None:
    if names:
        log.warn(
            f"{len(names)} of {reconstruction.num_reg_images()} registered images {why} (first: {min(names)}); points"
            " observed only in them stay black."
        )
