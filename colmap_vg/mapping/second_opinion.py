"""Choose between arrangements of the images by missing correspondences: the points that images should see but do not.

Where a folded model lays one part of a scene over another that looks alike, its points fit as well as those of the
correct model. But images that are then side by side should see the same points, and see them only where the parts are
alike (missing correspondences: Zach et al., CVPR 2008; Jiang et al., CVPR 2012).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.geometry.directions import normalized
from colmap_vg.mapping.options import MAX_REPROJECTION_PX, MIN_TRIANGULATION_ANGLE_DEG, triangulator_options
from colmap_vg.mapping.points import with_triangulated_points
from colmap_vg.mapping.visibility import NEAR_DEG, in_frame, sampled_tracks
from colmap_vg.options import MappingOptions

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

CLEARLY_MORE, MIN_SHARE_EXPLAINED = 1.2, 0.8
"""Minimum ratio of one arrangement's share of expected observations that exist to another's, to prefer it: measured 1.5
to 2.5 where the other was folded and part of the scene did not repeat itself, 1.0 between two folds. Minimum number of
observations of an arrangement, as a share of the largest; one with fewer is not considered."""


@dataclass(frozen=True)
class PointEvidence:
    """Numbers of observations of a model that exist and that should exist.

    Attributes
    ----------
    num_observations : int
        Observations of points that three images or more see.
    num_expected : int
        Expected observations: pairs of a sampled point and an image that should see it.
    num_seen : int
        Expected observations that exist.
    """

    num_observations: int
    num_expected: int
    num_seen: int

    @property
    def share_seen(self) -> float:
        """Share of the expected observations that exist; 0 without any."""
        return self.num_seen / self.num_expected if self.num_expected else 0.0


def point_evidence(
    cache: "pycolmap.DatabaseCache", reconstruction: "pycolmap.Reconstruction", options: MappingOptions
) -> PointEvidence:
    """Triangulate a reconstruction of poses and count its expected and existing observations.

    Parameters
    ----------
    cache : pycolmap.DatabaseCache
    reconstruction : pycolmap.Reconstruction
        With poses, no points.
    options : MappingOptions

    Returns
    -------
    PointEvidence
    """
    reconstruction = with_triangulated_points(cache, reconstruction)
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(reconstruction)
    triangulator = triangulator_options(options)
    mapper.complete_and_merge_tracks(triangulator)
    mapper.observation_manager.filter_observations_with_negative_depth()
    mapper.observation_manager.filter_all_points3D(MAX_REPROJECTION_PX, MIN_TRIANGULATION_ANGLE_DEG)
    mapper.end_reconstruction(False)
    image_ids = sorted(reconstruction.reg_image_ids())
    tracks = sampled_tracks(reconstruction, image_ids)
    if len(tracks.points) == 0:
        return PointEvidence(0, 0, 0)
    centers = np.array([reconstruction.image(i).projection_center() for i in image_ids])
    expected = in_frame(reconstruction, image_ids, tracks.points) & _seen_from_near(tracks.points, centers, tracks.sees)
    return PointEvidence(tracks.num_observations, int(expected.sum()), int((expected & tracks.sees).sum()))


def best_arrangement(found: Sequence[PointEvidence]) -> tuple[int, bool]:
    """Choose the arrangement with the largest share of expected observations that exist.

    Parameters
    ----------
    found : sequence of PointEvidence
        Of two arrangements or more; the first is the one that pairs prefer, chosen unless another is clearly better.

    Returns
    -------
    best : int
    settled : bool
        Whether its share is at least `CLEARLY_MORE` times that of every other one, and above 0.
    """
    most = max(evidence.num_observations for evidence in found)
    shares = [e.share_seen if e.num_observations >= MIN_SHARE_EXPLAINED * most else 0.0 for e in found]
    best = int(np.argmax(shares))
    if shares[best] < CLEARLY_MORE * shares[0]:
        best = 0
    others = [share for k, share in enumerate(shares) if k != best]
    return best, shares[best] > 0.0 and shares[best] >= CLEARLY_MORE * max(others)


def _seen_from_near(xyz: Array, centers: Array, sees: BoolArray) -> BoolArray:
    """Whether another image that sees the point has a viewing angle within `NEAR_DEG` of this image's, (k, n)."""
    near = np.zeros(sees.shape, dtype=bool)
    least = np.cos(np.radians(NEAR_DEG))
    for row, point in enumerate(xyz):
        rays = normalized(centers - point)
        cosine = rays @ rays[sees[row]].T
        own = np.flatnonzero(sees[row])
        cosine[own, np.arange(len(own))] = -1.0  # not by itself
        near[row] = cosine.max(axis=1) >= least
    return near
