"""Count the observations that determine each image's pose: those of points that three views see at an angle."""

from collections.abc import Iterable
from itertools import chain

import numpy as np
import pycolmap
from numpy.typing import NDArray

Array = NDArray[np.float64]


def supported_observations(
    reconstruction: "pycolmap.Reconstruction",
    min_angle_deg: float,
    min_track_length: int = 3,
    image_ids: Iterable[int] | None = None,
) -> dict[int, int]:
    """Count each registered image's observations of well-triangulated points.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
    min_angle_deg : float
        Minimum triangulation angle of a point, degrees.
    min_track_length : int
        Minimum number of views of a point.
    image_ids : iterable of int, optional
        Ids of the registered images that are asked for. Default: all.

    Returns
    -------
    dict of image id to int
    """
    registered = sorted(reconstruction.reg_image_ids())
    asked = registered if image_ids is None else sorted(image_ids)
    seen = [reconstruction.image(i).get_observation_points2D() for i in asked]
    point_ids = np.array([p.point3D_id for p in chain.from_iterable(seen)], dtype=np.int64)
    if image_ids is None:
        image_row = np.repeat(np.arange(len(registered)), [len(s) for s in seen])
    else:
        tracks = [
            (i, e.image_id) for i in np.unique(point_ids).tolist() for e in reconstruction.point3D(i).track.elements
        ]
        point_ids, image_of = np.array(tracks, dtype=np.int64).reshape(-1, 2).T
        image_row = np.searchsorted(registered, image_of)
    _, row, length = np.unique(point_ids, return_inverse=True, return_counts=True)
    by_point = np.argsort(row, kind="stable")
    by_point = by_point[length[row[by_point]] >= min_track_length]
    image_row = image_row[by_point]
    long, point_row = np.unique(point_ids[by_point], return_inverse=True)
    if len(long) == 0:
        return dict.fromkeys(asked, 0)
    centers = np.array([reconstruction.image(i).projection_center() for i in registered])
    positions = np.array([reconstruction.point3D(i).xyz for i in long.tolist()])
    rays = centers[image_row] - positions[point_row]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    offsets = np.searchsorted(point_row, np.arange(len(long) + 1))
    wide = _widest_angles(rays, offsets) >= np.radians(min_angle_deg)
    counts = np.bincount(image_row[wide[point_row]], minlength=len(registered))
    return dict(zip(asked, counts[np.searchsorted(registered, asked)].tolist(), strict=True))


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
