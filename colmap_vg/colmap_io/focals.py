"""Whether the focal lengths of a database can be trusted, and those to use where they cannot.

The database's own words do not tell: with a prior, COLMAP verifies pairs by essential matrices and calls them
CALIBRATED under a focal length 15 % off; without one, nearly every pair is UNCALIBRATED, and so are false pairs under a
right focal length. The matches tell: each pair's fundamental matrix votes for the focals that make it essential.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.colmap_io.tables import DatabaseTables
from colmap_vg.epipolar.focal import FocalAgreement, focal_agreement
from colmap_vg.options import ReadOptions
from colmap_vg.two_view.eight_point import estimate_fundamental_from_inliers
from colmap_vg.two_view.fundamental_covariance import fundamental_covariances
from colmap_vg.two_view.segments import evenly_thinned, rows_of_segments, segment_subset

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

CALIBRATED, UNCALIBRATED = 2, 3
"""COLMAP's two-view configurations of general scenes."""
MAX_MATCHES_PER_VOTE = 300
"""Matches of a pair that its vote uses, evenly over its list; more change the vote by less than its own error."""
MAX_EFFECTIVE_MATCHES = 100.0
"""Beyond this number matches add no certainty to a vote: what the lens model leaves out does not average away."""


@dataclass(frozen=True, eq=False)
class FocalDecision:
    """Focal lengths to read a database with.

    Attributes
    ----------
    scales : (c,) array
        Factor on each camera's focal length in the database.
    known : (c,) bool array
        The focal length was given and is not contradicted.
    caveats : tuple of str
        What was changed or could not be decided, one sentence each.
    """

    scales: Array
    known: BoolArray
    caveats: tuple[str, ...]


def decide_focal_lengths(tables: DatabaseTables, options: ReadOptions) -> FocalDecision:
    """Decide for each camera whether its focal length is kept, and by what factor it changes where not."""
    prior = np.array([c.has_prior_focal_length for c in tables.cameras], dtype=bool)
    as_given = np.ones(len(prior))
    if options.trust_focal_lengths == "always":
        return FocalDecision(as_given, np.ones(len(prior), dtype=bool), ())
    return _voted(tables, prior, options)


def _voted(tables: DatabaseTables, prior: BoolArray, options: ReadOptions) -> FocalDecision:
    given = np.array([c.focal_length_x for c in tables.cameras])
    agreement = _agreement(tables, given, options)
    if agreement is None:
        caveat = "No pair has enough matches to check the focal lengths; they are taken as they are in the database."
        return FocalDecision(np.ones(len(given)), prior, (caveat,))
    found, size = agreement.estimates, np.array([max(c.width, c.height) for c in tables.cameras])
    # A focal length given by EXIF or the user falls only to a vote that contradicts it, a guess to any reliable vote.
    changed = np.where(prior, agreement.contradicted, found.reliable).astype(bool)
    scales = np.where(changed, found.focal_lengths / given, 1.0)
    # Cameras that cannot vote for themselves take the ratio of focal length to size that the folder's others have.
    without = ~prior & ~found.reliable
    if found.reliable.any():
        common = float(np.median((scales * given / size)[found.reliable]))
        scales = np.where(without, common * size / given, scales)
    caveats = [
        f"Camera {c.camera_id}: the focal length {g:.1f} px of the database is contradicted by its image pairs;"
        f" {s * g:.1f} px is used instead."
        for c, g, s, bad in zip(tables.cameras, given, scales, changed & prior, strict=True)
        if bad
    ]
    if without.any():
        caveats.append(
            f"{int(without.sum())} of {len(given)} cameras have no focal length and too few pairs to find one;"
            + (" they take that of the other cameras." if found.reliable.any() else " COLMAP's guess is used.")
        )
    known = prior & ~changed & (options.trust_focal_lengths != "never")
    return FocalDecision(np.asarray(scales, dtype=float), known, tuple(caveats))


def _agreement(tables: DatabaseTables, given: Array, options: ReadOptions) -> FocalAgreement | None:
    counts = np.diff(tables.offsets)
    general = np.isin(tables.configs, (CALIBRATED, UNCALIBRATED)) & (counts >= max(options.min_num_inliers, 16))
    chosen = np.flatnonzero(general)
    if len(chosen) == 0:
        return None
    rows, offsets = rows_of_segments(tables.offsets, chosen)
    thin = evenly_thinned(offsets, MAX_MATCHES_PER_VOTE)
    rows, offsets = rows[thin], segment_subset(offsets, thin)
    points1, points2 = (tables.matched_points(rows, chosen, offsets, side) for side in (0, 1))
    F = estimate_fundamental_from_inliers(offsets, points1, points2)
    covariances = fundamental_covariances(offsets, points1, points2, F, max_effective_matches=MAX_EFFECTIVE_MATCHES)
    return focal_agreement(
        given,
        F,
        tables.camera_idx[tables.pairs[chosen]],
        np.array([[c.principal_point_x, c.principal_point_y] for c in tables.cameras]),
        np.array([[c.width, c.height] for c in tables.cameras], dtype=float),
        covariances=covariances.covariances,
        aspect_ratios=np.array([c.focal_length_y / c.focal_length_x for c in tables.cameras]),
    )
