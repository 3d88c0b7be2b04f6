"""Estimate the similarity between two models from shared points, by reprojection errors in both models' images."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry.directions import normalized
from colmap_vg.geometry.similarity import Similarity, align_positions, best_similarities

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

NUM_TRIALS = 400
"""Number of random triples of points. None of them has three correct points once in 57,000 runs where three tenths of
the points are correct, and once in 25 where a fifth is."""
MAX_ERROR_PX = 8.0
"""Maximum reprojection error, pixels: twice COLMAP's threshold, since the models were adjusted separately."""
NUM_REFITS = 3


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Points of a model, each with one image of that model that observes it.

    Attributes
    ----------
    points : (k, 3) array
        In the model's frame.
    rotations : (k, 3, 3) array
        cam_from_world of the image.
    centers : (k, 3) array
        Projection centre of the image, in the model's frame.
    rays : (k, 3) array
        Unit ray of the keypoint, in the camera's frame; NaN where it has none.
    focal_lengths : (k,) array
        Pixels.
    """

    points: Array
    rotations: Array
    centers: Array
    rays: Array
    focal_lengths: Array

    def errors(self, points: Array) -> Array:
        """Errors (..., k) of other positions (..., k, 3): the distance from the ray on the unit sphere, in pixels."""
        local = np.einsum("kab,...kb->...ka", self.rotations, points - self.centers)
        far = np.linalg.norm(normalized(local) - self.rays, axis=-1) * self.focal_lengths
        return np.asarray(np.nan_to_num(far, nan=np.inf))


def similarity_of_points(own: SeenPoints, other: SeenPoints, seed: int = 0) -> tuple[Similarity | None, BoolArray]:
    """Estimate the similarity that maximises the number of shared points with small reprojection errors in both models.

    Parameters
    ----------
    own, other : SeenPoints
        The same k points in either model.
    seed : int

    Returns
    -------
    similarity : Similarity or None
        From the other model's frame to the first one's; None for fewer than three points, or where no three agree.
    agree : (k,) bool array
        Points within `MAX_ERROR_PX` in both images.
    """
    k = len(own.points)
    nothing = np.zeros(k, dtype=bool)
    if k < 3:
        return None, nothing
    rng = np.random.default_rng(seed)
    triples = np.argsort(rng.random((NUM_TRIALS, k)), axis=1)[:, :3]
    scales, rotations, translations = best_similarities(other.points[triples], own.points[triples])
    usable = np.isfinite(scales) & (scales > 0)
    scales, rotations, translations = scales[usable], rotations[usable], translations[usable]
    if len(scales) == 0:
        return None, nothing
    forward = scales[:, None, None] * (other.points @ np.swapaxes(rotations, 1, 2)) + translations[:, None]
    back = (own.points - translations[:, None]) @ rotations / scales[:, None, None]
    agree = (own.errors(forward) <= MAX_ERROR_PX) & (other.errors(back) <= MAX_ERROR_PX)
    best = int(np.argmax(agree.sum(axis=1)))
    found, inside = Similarity(float(scales[best]), rotations[best], translations[best]), agree[best]
    for _ in range(NUM_REFITS):
        if inside.sum() < 3:
            break
        _, refit = align_positions(other.points[inside], own.points[inside])
        errors = np.maximum(own.errors(refit.apply(other.points)), other.errors(refit.inverse().apply(own.points)))
        if (errors <= MAX_ERROR_PX).sum() < inside.sum():
            break
        found, inside = refit, errors <= MAX_ERROR_PX
    return (found, np.asarray(inside)) if inside.sum() >= 3 else (None, nothing)
