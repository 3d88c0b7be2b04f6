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
    if without_frames:
        seen = seen.of_points_in(registered[asked].tolist())
    image_row = np.searchsorted(registered, seen.image_ids)
    every, row, length = np.unique(seen.point_ids, return_inverse=True, return_counts=True)
    long = length >= min_track_length
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


def is_supported(
    reconstruction: "pycolmap.Reconstruction", image_id: int, min_angle_deg: float, min_count: int, num_asked: int = 100
) -> bool:
    """Whether a sample of an image's keypoints has enough observations of those that `supported_observations` counts.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
    image_id : int
        A registered image.
    min_angle_deg : float
        Minimum angle between this image's ray to a point and another one's, degrees.
    min_count : int
    num_asked : int, optional
        Maximum number of keypoints of the sample that have points.

    Returns
    -------
    bool
        If not, only counting all of them tells.
    """
    image, max_cosine = reconstruction.image(image_id), np.cos(np.radians(min_angle_deg))
    center, found, asked = image.projection_center(), 0, 0
    # Consecutive keypoints are of similar scale: the stride makes neighbours in the sample far apart.
    count, centers = image.num_points2D(), dict[int, Array]()
    for place in np.argsort(np.arange(count) % max(count // num_asked, 1), kind="stable").tolist():
        if found >= min_count or asked >= num_asked:
            break
        keypoint = image.point2D(place)
        if not keypoint.has_point3D():
            continue
        asked += 1
        point = reconstruction.point3D(keypoint.point3D_id)
        seen_by = {element.image_id for element in point.track.elements}
        if len(seen_by) < 3:
            continue
        for other in seen_by:
            if other not in centers:
                centers[other] = reconstruction.image(other).projection_center()
        rays = np.array([center, *(centers[other] for other in sorted(seen_by))]) - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        found += bool((rays @ rays[0]).min() <= max_cosine)
    return found >= min_count


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
