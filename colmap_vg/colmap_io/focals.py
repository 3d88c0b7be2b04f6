"""Whether the focal lengths of a database can be trusted, and those to use where they cannot.

The database's own words do not tell: with a prior, COLMAP verifies pairs by essential matrices and calls them
CALIBRATED under a focal length 15 % off; without one, nearly every pair is UNCALIBRATED, and so are false pairs under a
right focal length. The matches tell: each pair's fundamental matrix votes for the focals that make it essential.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.colmap_io.tables import DatabaseTables
from colmap_vg.epipolar.self_calibration import SelfCalibration, estimate_focal_lengths
from colmap_vg.options import ReadOptions
from colmap_vg.two_view.segments import evenly_thinned, rows_of_segments, segment_subset

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

CALIBRATED, UNCALIBRATED = 2, 3
"""COLMAP's two-view configurations of general scenes."""
MAX_MATCHES_PER_VOTE = 300
"""Matches of a pair that its vote uses, evenly over its list; more change the vote by less than its own error."""


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
    focals = np.array([c.focal_length_x for c in tables.cameras])
    given = prior & (options.trust_focal_lengths != "never")
    calibration = _self_calibration(tables, focals, given, options)
    if calibration is None:
        caveat = "No pair has enough matches to check the focal lengths; they are taken as they are in the database."
        return FocalDecision(np.ones(len(focals)), prior, (caveat,))
    scales, size = calibration.focal_lengths / focals, np.array([max(c.width, c.height) for c in tables.cameras])
    # Cameras that cannot vote for themselves take the ratio of focal length to size that the folder's others have.
    without = ~given & ~calibration.decided
    if calibration.decided.any():
        common = float(np.median((scales * focals / size)[calibration.decided]))
        scales = np.where(without, common * size / focals, scales)
    caveats = [
        f"Camera {c.camera_id}: the focal length {f:.1f} px of the database is contradicted by its image pairs;"
        f" {s * f:.1f} px is used instead."
        for c, f, s, bad in zip(tables.cameras, focals, scales, calibration.found & prior, strict=True)
        if bad
    ]
    if without.any():
        source = "they take that of the other cameras" if calibration.decided.any() else "COLMAP's guess is used"
        caveats.append(
            f"{int(without.sum())} of {len(focals)} cameras have no focal length, and their pairs do not tell it;"
            f" {source}."
        )
    return FocalDecision(np.asarray(scales, dtype=float), given & ~calibration.found, tuple(caveats))


def _self_calibration(
    tables: DatabaseTables, focals: Array, given: BoolArray, options: ReadOptions
) -> SelfCalibration | None:
    enough = np.diff(tables.offsets) >= max(options.min_num_inliers, 16)
    chosen = np.flatnonzero(np.isin(tables.configs, (CALIBRATED, UNCALIBRATED)) & enough)
    if len(chosen) == 0:
        return None
    rows, offsets = rows_of_segments(tables.offsets, chosen)
    thin = evenly_thinned(offsets, MAX_MATCHES_PER_VOTE)
    rows, offsets = rows[thin], segment_subset(offsets, thin)
    points1, points2 = (tables.matched_points(rows, chosen, offsets, side) for side in (0, 1))
    return estimate_focal_lengths(
        tables.pairs[chosen],
        tables.camera_idx,
        offsets,
        points1,
        points2,
        focals,
        np.array([[c.principal_point_x, c.principal_point_y] for c in tables.cameras]),
        np.array([[c.width, c.height] for c in tables.cameras], dtype=float),
        given=given,
        aspect_ratios=np.array([c.focal_length_y / c.focal_length_x for c in tables.cameras]),
    )
