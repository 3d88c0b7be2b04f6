"""The similarity between two models from points that both have, by how they project into each other's images."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry.similarity import Similarity, align_positions, best_similarities

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

NUM_TRIALS = 400
"""Triples that are tried: one of three right ones in a hundred is missed once in 10^5 where two thirds are right, and
once in 10^2 where a fifth is."""
MAX_ERROR_PX = 8.0
"""Twice COLMAP's threshold: the models were adjusted apart from each other."""
NUM_REFITS = 3


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Points of a model, each with one image of that model that sees it.

    Attributes
    ----------
    points : (k, 3) array
        In the model's frame.
    rotations : (k, 3, 3) array
        cam_from_world of the image.
    centers : (k, 3) array
        Its projection centre.
    coordinates : (k, 2) array
        Of the keypoint, normalised.
    focal_lengths : (k,) array
        Pixels.
    """

    points: Array
    rotations: Array
    centers: Array
    coordinates: Array
    focal_lengths: Array

    def errors(self, points: Array) -> Array:
        """Reprojection errors (..., k) in pixels of points (..., k, 3) in the places of these; infinite behind."""
        local = np.einsum("kab,...kb->...ka", self.rotations, points - self.centers)
        front = local[..., 2] > 0
        seen = local[..., :2] / np.where(front, local[..., 2], 1.0)[..., None]
        far = np.linalg.norm(seen - self.coordinates, axis=-1) * self.focal_lengths
        return np.asarray(np.where(front, far, np.inf))


def similarity_of_points(own: SeenPoints, other: SeenPoints, seed: int = 0) -> tuple[Similarity | None, BoolArray]:
    """The similarity under which most points of two models project into both models' images as they were seen.

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
