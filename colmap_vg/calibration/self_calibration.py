"""Self-calibration: focal lengths of all cameras from matches, by fundamental matrices or by rotation cycles."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.calibration.focal import FocalAgreement, focal_agreement
from colmap_vg.calibration.focal_cycles import (
    CyclePairs,
    CycleVote,
    focal_fits_cycles,
    select_cycle_pairs,
    vote_focal_by_rotation_cycles,
)
from colmap_vg.errors import GraphError
from colmap_vg.two_view.eight_point import estimate_fundamental_from_inliers
from colmap_vg.two_view.fundamental_covariance import fundamental_covariances
from colmap_vg.two_view.segments import rows_of_segments

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

CYCLE_TOLERANCE = 0.08
"""Relative difference from the cycles' estimate up to which a given focal length is kept: several times its error."""


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """Focal lengths after self-calibration, with the estimates that they are based on.

    Attributes
    ----------
    focal_lengths : (c,) array
        Pixels: the given one unless it is contradicted; else the estimate from fundamental matrices if it is reliable;
        else that from rotation cycles.
    found : (c,) bool array
        Whether the focal length was estimated from matches rather than given.
    decided : (c,) bool array
        Whether an estimate confirmed or replaced the focal length; elsewhere the matches do not determine it.
    by_pairs : FocalAgreement
        Estimates from fundamental matrices.
    by_cycles : CycleVote or None
        Estimate from rotation cycles; None if fundamental matrices sufficed or given focal lengths are consistent.
    """

    focal_lengths: Array
    found: BoolArray
    decided: BoolArray
    by_pairs: FocalAgreement
    by_cycles: CycleVote | None


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
    given: BoolArray | None = None,
    lens_groups: IntArray | None = None,
    aspect_ratios: Array | None = None,
    min_num_matches: int = 16,
    max_effective_matches: float = 100.0,
    num_iterations: int = 5,
) -> SelfCalibration:
    """Estimate the focal length of every camera from verified matches.

    Fundamental matrices are refitted to the matches, so that the result depends neither on the focal lengths used for
    verification nor on the random samples of RANSAC.

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
        Given or guessed focal lengths, pixels.
    principal_points : (c, 2) array
        Pixels.
    image_sizes : (c,) or (c, 2) array
        Pixels.
    given : (c,) bool array, optional
        Cameras whose focal length was given, by EXIF or the user: it is replaced only by an estimate that contradicts
        it, a guess by any reliable estimate. Default: none.
    lens_groups : (c,) int array, optional
        Equal for cameras that probably have one lens. Where the pairs of one of them decide its focal length, rotation
        cycles are not used for the others, which then stay undecided. Default: each camera has its own.
    aspect_ratios : (c,) array, optional
        Vertical over horizontal focal length. Default: 1.
    min_num_matches : int
        Pairs with fewer matches are ignored.
    max_effective_matches : float
        See `fundamental_covariances`.
    num_iterations : int
        Number of reweighting iterations of the refits.

    Returns
    -------
    SelfCalibration

    Raises
    ------
    GraphError
        No pair has enough matches.
    """
    given = np.zeros(len(focal_lengths), dtype=bool) if given is None else given
    used = np.flatnonzero(np.diff(offsets) >= max(min_num_matches, 8))
    if not len(used):
        raise GraphError(
            f"no pair has the {min_num_matches} matches needed to estimate a focal length: give the focal length"
        )
    rows, of_used = rows_of_segments(offsets, used)
    p1, p2 = points1[rows], points2[rows]
    F = estimate_fundamental_from_inliers(of_used, p1, p2, num_iterations=num_iterations)
    known = fundamental_covariances(of_used, p1, p2, F, max_effective_matches=max_effective_matches)
    votes = focal_agreement(
        focal_lengths,
        F,
        camera_idx[edges[used]],
        principal_points,
        image_sizes,
        covariances=known.covariances,
        aspect_ratios=aspect_ratios,
    )
    by_pairs, reliable = votes.estimates, votes.estimates.reliable
    found = np.where(given, votes.contradicted, reliable).astype(bool)
    focal = np.where(found, by_pairs.focal_lengths, focal_lengths)
    by_cycles, decided = None, reliable.copy()
    # Cycles of other cameras do not determine the focal length of a camera without pairs.
    undecided = ~reliable & (by_pairs.num_pairs > 0)
    if lens_groups is not None:
        undecided &= given | ~np.isin(lens_groups, lens_groups[reliable & ~given])
    pairs = select_cycle_pairs(F, edges[used], camera_idx, of_used, p1, p2) if undecided.any() else None
    if pairs is not None:
        aspect = np.ones(len(focal)) if aspect_ratios is None else aspect_ratios
        longer = image_sizes if image_sizes.ndim == 1 else image_sizes.max(axis=1)
        by_cycles, replaced = _vote_by_cycles(pairs, focal, aspect, principal_points, longer, undecided, given)
        if by_cycles is not None:
            decided |= undecided & by_cycles.reliable
            focal = np.where(replaced, by_cycles.focal_lengths, focal)
        found |= replaced
    return SelfCalibration(focal, found, decided, votes, by_cycles)


def _vote_by_cycles(
    pairs: CyclePairs,
    focal_lengths: Array,
    aspect_ratios: Array,
    principal_points: Array,
    guesses: Array,
    undecided: BoolArray,
    given: BoolArray,
) -> tuple[CycleVote | None, BoolArray]:
    """Estimate the focal lengths of undecided cameras by rotation cycles; None if given ones are consistent with them.

    Also returns the mask (c,) of the cameras whose focal length the estimate replaces. Without given focal lengths the
    estimate starts at `guesses` (c,), pixels.
    """
    guessed = undecided & ~given
    if guessed.any():
        start = np.where(guessed, guesses, focal_lengths)
        vote = vote_focal_by_rotation_cycles(pairs, start, aspect_ratios, principal_points, guessed)
        return vote, guessed & vote.reliable
    if focal_fits_cycles(pairs, focal_lengths, aspect_ratios, principal_points, undecided):
        return None, np.zeros(len(focal_lengths), dtype=bool)
    vote = vote_focal_by_rotation_cycles(pairs, focal_lengths, aspect_ratios, principal_points, undecided)
    return vote, undecided & (vote.reliable and abs(np.log(vote.factor)) > np.log1p(CYCLE_TOLERANCE))
