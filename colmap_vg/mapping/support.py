"""How many observations really fix each image: those of points that three views see at an angle."""

import numpy as np
import pycolmap
from numpy.typing import NDArray

Array = NDArray[np.float64]


def supported_observations(
    reconstruction: "pycolmap.Reconstruction", min_angle_deg: float, min_track_length: int = 3
) -> dict[int, int]:
    """Observations of each registered image of well-triangulated points.

    Parameters
    ----------
    reconstruction : pycolmap.Reconstruction
    min_angle_deg : float
        Degrees; a point counts when two rays of its track meet at this angle or more.
    min_track_length : int
        Views.

    Returns
    -------
    dict of image id to int
    """
    image_ids = sorted(reconstruction.reg_image_ids())
    row_of = {image_id: row for row, image_id in enumerate(image_ids)}
    centers = np.array([reconstruction.image(i).projection_center() for i in image_ids]).reshape(-1, 3)
    points: list[Array] = []
    lengths: list[int] = []
    rows: list[int] = []
    for point in reconstruction.points3D.values():
        elements = point.track.elements
        if len(elements) >= min_track_length:
            points.append(point.xyz)
            lengths.append(len(elements))
            rows.extend(row_of[e.image_id] for e in elements)
    if not points:
        return dict.fromkeys(image_ids, 0)
    image_row, offsets = np.array(rows), np.concatenate([[0], np.cumsum(lengths)])
    point_row = np.repeat(np.arange(len(points)), lengths)
    rays = centers[image_row] - np.array(points)[point_row]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    wide = _widest_angles(rays, offsets) >= np.radians(min_angle_deg)
    counts = np.bincount(image_row[wide[point_row]], minlength=len(image_ids))
    return {image_id: int(counts[row]) for image_id, row in row_of.items()}


def _widest_angles(rays: Array, offsets: NDArray[np.int64]) -> Array:
    """For each point at least half of the widest angle between two of its rays, and never more than it, radians.

    The farthest ray from any one ray, then the farthest from that one: two passes in place of all pairs.
    """
    point = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    reference = rays[offsets[:-1]]
    for _ in range(2):
        cosine = np.einsum("ka,ka->k", rays, reference[point])
        order = np.lexsort((cosine, point))
        farthest = order[offsets[:-1]]
        reference = rays[farthest]
    return np.asarray(np.arccos(np.clip(cosine[farthest], -1.0, 1.0)))
