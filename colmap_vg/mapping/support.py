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
) -> dict[int, int]:
    """Count each registered image's observations of well-triangulated points.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
    min_angle_deg : float
        Minimum triangulation angle of a point, degrees.
    min_track_length : int
        Minimum number of views of a point.

    Returns
    -------
    dict of image id to int
    """
    registered = sorted(reconstruction.reg_image_ids())
    seen = ModelObservations.of(reconstruction)
    image_row = np.searchsorted(registered, seen.image_ids)
    _, row, length = np.unique(seen.point_ids, return_inverse=True, return_counts=True)
    by_point = np.argsort(row, kind="stable")
    by_point = by_point[length[row[by_point]] >= min_track_length]
    image_row = image_row[by_point]
    long, point_row = np.unique(seen.point_ids[by_point], return_inverse=True)
    if len(long) == 0:
        return dict.fromkeys(registered, 0)
    centers = np.array([reconstruction.image(i).projection_center() for i in registered])
    rays = centers[image_row] - seen.positions_of(long)[point_row]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    offsets = np.searchsorted(point_row, np.arange(len(long) + 1))
    wide = _widest_angles(rays, offsets) >= np.radians(min_angle_deg)
    counts = np.bincount(image_row[wide[point_row]], minlength=len(registered))
    return dict(zip(registered, counts.tolist(), strict=True))


def _widest_angles(rays: Array, offsets: NDArray[np.int64]) -> Array:
    """Approximate the widest angle between two rays of each point, radians: between half of it and the whole.

    Instead of comparing all pairs, two passes find the ray farthest from an arbitrary one, and the farthest from that.
    """
    point = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    reference = rays[offsets[:-1]]
    for _ in range(2):
        cosine = np.einsum("ka,ka->k", rays, reference[point])
        order = np.lexsort((cosine, point))
        farthest = order[offsets[:-1]]
        reference = rays[farthest]
    return np.asarray(np.arccos(np.clip(cosine[farthest], -1.0, 1.0)))
