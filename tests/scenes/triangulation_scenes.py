"""Rays of a ring of cameras to points, with matches of which some are false."""

import numpy as np

from colmap_vg.bundle.tracks import MatchedRays
from colmap_vg.geometry.directions import normalized

NUM_IMAGES, NUM_POINTS = 8, 50


def matched_ring(
    false_share: float = 0.0, noise: float = 0.0, seed: int = 0
) -> tuple[MatchedRays, np.ndarray, np.ndarray]:
    """Every point seen by every image, keypoint of point p in image i at row ``i NUM_POINTS + p``, all pairs matched.

    Noise is in radians. Which of the matches (e,) are true, and the points (q, 3), are returned, too.
    """
    rng = np.random.default_rng(seed)
    angles = np.linspace(0.0, np.pi, NUM_IMAGES)
    centers = np.stack([5.0 * np.cos(angles), 5.0 * np.sin(angles), np.zeros(NUM_IMAGES)], axis=1)
    points = rng.uniform(-1.0, 1.0, (NUM_POINTS, 3))
    rays = normalized((points[None] - centers[:, None]).reshape(-1, 3))
    rays = normalized(rays + noise * rng.standard_normal(rays.shape))
    first, second = np.triu_indices(NUM_IMAGES, 1)
    point = np.tile(np.arange(NUM_POINTS), len(first))
    one = np.repeat(first, NUM_POINTS) * NUM_POINTS + point
    other = np.repeat(second, NUM_POINTS) * NUM_POINTS + point
    true = rng.random(len(one)) >= false_share
    wrong = (point + rng.integers(1, NUM_POINTS, len(point))) % NUM_POINTS
    other[~true] += (wrong - point)[~true]
    image_row = np.repeat(np.arange(NUM_IMAGES), NUM_POINTS)
    seen = MatchedRays(image_row, np.ascontiguousarray(rays.T), np.ascontiguousarray(centers.T), np.stack([one, other]))
    return seen, true, points
