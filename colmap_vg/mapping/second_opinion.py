"""What points say of poses that the viewing graph leaves in doubt: is what should be seen there seen?

Where a fold lays one part of a scene over another that looks alike, its points fit as well as those of the right model.
But images that now stand side by side should see the same points, and see them only where the parts are alike
(missing correspondences: Zach et al., CVPR 2008; Jiang et al., CVPR 2012).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.geometry.directions import normalized
from colmap_vg.mapping.options import MAX_REPROJECTION_PX, MIN_TRIANGULATION_ANGLE_DEG, triangulator_options
from colmap_vg.mapping.visibility import NEAR_DEG, in_frame, sampled_tracks
from colmap_vg.options import MappingOptions

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

CLEARLY_MORE, MIN_SHARE_EXPLAINED = 1.2, 0.8
"""Share of what should be seen that is, over that in another arrangement of the images, which settles between them: 1.5
to 2.5 where one was folded and part of the scene did not repeat itself, 1.0 between two folds. An arrangement whose
points explain much fewer observations than another's does not count."""


@dataclass(frozen=True)
class PointEvidence:
    """What the points of a model explain.

    Attributes
    ----------
    num_observations : int
        Observations of points that three images or more see.
    num_expected : int
        Of the points looked for, pairs of point and image in which the point should be seen.
    num_seen : int
        Those in which it is.
    """

    num_observations: int
    num_expected: int
    num_seen: int

    @property
    def share_seen(self) -> float:
        """Share of what should be seen that is."""
        return self.num_seen / self.num_expected if self.num_expected else 0.0


def point_evidence(
    cache: "pycolmap.DatabaseCache", reconstruction: "pycolmap.Reconstruction", options: MappingOptions
) -> PointEvidence:
    """Triangulate a reconstruction of poses, in place, and count what its points explain.

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
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(reconstruction)
    triangulator = triangulator_options(options)
    for image_id in sorted(reconstruction.reg_image_ids()):
        mapper.triangulate_image(triangulator, image_id)
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
    """The arrangement that points speak for, and whether they settle it.

    Parameters
    ----------
    found : sequence of PointEvidence
        Of two arrangements or more; the first is the one that pairs prefer, and stays where points are not clear.

    Returns
    -------
    best : int
    settled : bool
        Whether clearly more of what should be seen is seen in it than in every other one. Never where nothing is.
    """
    most = max(evidence.num_observations for evidence in found)
    shares = [e.share_seen if e.num_observations >= MIN_SHARE_EXPLAINED * most else 0.0 for e in found]
    best = int(np.argmax(shares))
    if shares[best] < CLEARLY_MORE * shares[0]:
        best = 0
    others = [share for k, share in enumerate(shares) if k != best]
    return best, shares[best] > 0.0 and shares[best] >= CLEARLY_MORE * max(others)


def _seen_from_near(xyz: Array, centers: Array, sees: BoolArray) -> BoolArray:
    """Images (k, n) from whose place another one that sees the point looks at it from nearly the same side."""
    near = np.zeros(sees.shape, dtype=bool)
    least = np.cos(np.radians(NEAR_DEG))
    for row, point in enumerate(xyz):
        rays = normalized(centers - point)
        cosine = rays @ rays[sees[row]].T
        own = np.flatnonzero(sees[row])
        cosine[own, np.arange(len(own))] = -1.0  # not by itself
        near[row] = cosine.max(axis=1) >= least
    return near
