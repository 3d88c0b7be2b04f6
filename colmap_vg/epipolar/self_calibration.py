"""Focal lengths of a whole database from its matches alone: pairs vote, and where they cannot, rotation cycles do."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.epipolar.focal import FocalEstimates, vote_focal_lengths
from colmap_vg.epipolar.focal_cycles import CycleVote, vote_focal_by_rotation_cycles
from colmap_vg.errors import GraphError
from colmap_vg.two_view.eight_point import estimate_fundamental_from_inliers
from colmap_vg.two_view.fundamental_covariance import fundamental_covariances
from colmap_vg.two_view.segments import rows_of_segments

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """Focal lengths found from matches, and the fundamental matrices they were found with.

    Attributes
    ----------
    focal_lengths : (c,) array
        Pixels: the pairs' vote where it is reliable, else the cycles' where that is, else the given ones.
    reliable : (c,) bool array
        Whether one of the two votes was.
    by_pairs : FocalEstimates
    by_cycles : CycleVote or None
        None where the pairs' vote sufficed or too few images are connected.
    fundamental_matrices : (m, 3, 3) array
        Refitted to the matches; NaN for pairs with too few.
    """

    focal_lengths: Array
    reliable: BoolArray
    by_pairs: FocalEstimates
    by_cycles: CycleVote | None
    fundamental_matrices: Array


def estimate_focal_lengths(
    edges: IntArray,
    camera_idx: IntArray,
    offsets: IntArray,
    points1: Array,
    points2: Array,
    focal_lengths: Array,
    principal_points: Array,
    image_sizes: Array,
    *,
    fundamental_matrices: Array | None = None,
    aspect_ratios: Array | None = None,
    min_num_matches: int = 30,
    max_effective_matches: float = 300.0,
    num_iterations: int = 5,
) -> SelfCalibration:
    """Focal length of every camera from verified matches, whatever focal length they were verified under.

    Fundamental matrices are refitted to the matches, so that neither a wrong focal length nor the sampling of a RANSAC
    is left in them.

    Parameters
    ----------
    edges : (m, 2) int array
        Image rows of each pair.
    camera_idx : (n,) int array
        Camera row of each image.
    offsets : (m + 1,) int array
    points1, points2 : (k, 2) array
        Matched keypoints in undistorted pixels.
    focal_lengths : (c,) array
        Given focal lengths, pixels; returned where neither vote is reliable.
    principal_points : (c, 2) array
        Pixels.
    image_sizes : (c,) or (c, 2) array
        Pixels.
    fundamental_matrices : (m, 3, 3) array, optional
        To start the refits from; NaN or missing: from the matches alone.
    aspect_ratios : (c,) array, optional
        Vertical over horizontal focal length; 1 where missing.
    min_num_matches : int
        Pairs with fewer are left out.
    max_effective_matches : float
        See `fundamental_covariances`.
    num_iterations : int
        Reweighting rounds of the refits.

    Returns
    -------
    SelfCalibration

    Raises
    ------
    GraphError
        No pair has enough matches.
    """
    used = np.flatnonzero(np.diff(offsets) >= max(min_num_matches, 8))
    if not len(used):
        raise GraphError(
            f"no pair has the {min_num_matches} matches it takes to vote for a focal length: give the focal length"
        )
    rows, of_used = rows_of_segments(offsets, used)
    p1, p2 = points1[rows], points2[rows]
    start = None
    if fundamental_matrices is not None and np.isfinite(fundamental_matrices[used]).all():
        start = fundamental_matrices[used]
    fitted = estimate_fundamental_from_inliers(of_used, p1, p2, start, num_iterations=num_iterations)
    known = fundamental_covariances(of_used, p1, p2, fitted, max_effective_matches=max_effective_matches)
    by_pairs = vote_focal_lengths(
        fitted,
        camera_idx[edges[used]],
        principal_points,
        image_sizes,
        covariances=known.covariances,
        aspect_ratios=aspect_ratios,
    )
    F = np.full((len(edges), 3, 3), np.nan)
    F[used] = fitted
    found = np.where(by_pairs.reliable, by_pairs.focal_lengths, np.nan)
    by_cycles, reliable = None, by_pairs.reliable
    if not reliable.all() and len(np.unique(edges[used])) >= 3:
        by_cycles = vote_focal_by_rotation_cycles(
            F,
            edges,
            camera_idx,
            offsets,
            points1,
            points2,
            principal_points,
            image_sizes,
            known_focal_lengths=found,
            aspect_ratios=aspect_ratios,
            min_num_matches=min_num_matches,
        )
        if by_cycles.reliable:
            found = by_cycles.focal_lengths
            # A camera without pairs is not made reliable by what other cameras' cycles say.
            reliable = reliable | (by_pairs.num_pairs > 0)
    focal = np.where(np.isnan(found) | ~reliable, focal_lengths, found)
    return SelfCalibration(focal, reliable, by_pairs, by_cycles, F)
