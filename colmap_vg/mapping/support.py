"""Count the observations that determine each image's pose: those of points that three views see at an angle."""

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.model_observations import ModelObservations

Array = NDArray[np.float64]


def supported_observations(
    reconstruction: "pycolmap.Reconstruction",
    min_angle_deg: float,
    min_track_length: int = 3,
    without_frames: frozenset[int] = frozenset(),
) -> dict[int, int]:
    """Count each registered image's observations of well-triangulated points.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
    min_angle_deg : float
        Minimum triangulation angle of a point, degrees.
    min_track_length : int
        Minimum number of views of a point.
    without_frames : frozenset of int
        Ids of frames whose images are not asked for.

    Returns
    -------
    dict of image id to int
    """
    registered = np.array(sorted(reconstruction.reg_image_ids()), dtype=np.int64)
    asked = np.array([reconstruction.image(i).frame_id not in without_frames for i in registered.tolist()], dtype=bool)
    seen = ModelObservations.of(reconstruction)
    image_row = np.searchsorted(registered, seen.image_ids)
    every, row, length = np.unique(seen.point_ids, return_inverse=True, return_counts=True)
    long = (length >= min_track_length) & (np.bincount(row, asked[image_row], len(every)) > 0.0)
    by_point = np.argsort(row, kind="stable")
    by_point = by_point[long[row[by_point]]]
    image_row = image_row[by_point]
    point_row = (np.cumsum(long) - 1)[row[by_point]]
    if not long.any():
        return dict.fromkeys(registered[asked].tolist(), 0)
    centers = np.array([reconstruction.image(i).projection_center() for i in registered.tolist()])
    rays = centers[image_row] - seen.positions_of(every[long])[point_row]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    offsets = np.searchsorted(point_row, np.arange(long.sum() + 1))
    wide = _widest_angles(rays, offsets) >= np.radians(min_angle_deg)
    counts = np.bincount(image_row[wide[point_row]], minlength=len(registered))
    return dict(zip(registered[asked].tolist(), counts[asked].tolist(), strict=True))


def _widest_angles(rays: Array, offsets: NDArray[np.int64]) -> Array:
    """Approximate the widest angle between two rays of each point, radians: between half of it and the whole.

    Instead of comparing all pairs, two passes find the ray farthest from an arbitrary one, and the farthest from that.
    """
    point = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    reference = rays[offsets[:-1]]
    for _ in range(2):
        cosine = np.einsum("ka,ka->k", rays, reference[point])
        least = np.minimum.reduceat(cosine, offsets[:-1])
        candidates = np.flatnonzero(cosine == least[point])
        reference = rays[candidates[np.searchsorted(point[candidates], np.arange(len(least)))]]
    return np.asarray(np.arccos(np.clip(least, -1.0, 1.0)))
