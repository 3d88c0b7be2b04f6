"""Remove the matches of a static background behind a rotating object, where the camera does not move.

The background's matches agree with a camera that never moved, and where they outnumber the object's, verification keeps
only them. Without them, the object's matches remain, as if the camera moved around it.
"""

from dataclasses import replace
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from colmap_vg.colmap_io.raw_matches import with_raw_matches
from colmap_vg.colmap_io.tables import UNDEFINED, DatabaseTables
from colmap_vg.two_view.segments import evenly_thinned, segment_quantiles, segment_subset

BoolArray = NDArray[np.bool_]

MAX_STILL_PX = 2.0
"""Maximum displacement of a static match, pixels, allowing for keypoint noise."""
MIN_SHARE_STILL = 0.5
"""Share of pairs with a static median match above which the camera is static. A moving camera with so small
displacements would not determine the directions of half of its pairs either."""
MAX_MATCHES_CHECKED, MIN_NUM_MATCHES = 50, 15
"""Maximum number of a pair's matches whose median is computed; minimum number of matches of a pair, as COLMAP's of
inliers."""


def without_still_background(
    tables: DatabaseTables, database_path: str | PathLike[str]
) -> tuple[DatabaseTables, BoolArray]:
    """Remove static matches where the median match of most pairs is static.

    Returns
    -------
    tables : DatabaseTables
        Without static matches, if the camera is static. Pairs whose median match is static then have no matrices, and
        the other matches as they were before verification.
    changed : (m,) bool array
        Whether each pair's matches changed.
    """
    enough = np.diff(tables.offsets) >= MIN_NUM_MATCHES
    few = evenly_thinned(tables.offsets, MAX_MATCHES_CHECKED)
    thinned = replace(tables, matches=tables.matches[few], offsets=segment_subset(tables.offsets, few))
    still = enough & (segment_quantiles(thinned.offsets, _motions(thinned)) <= MAX_STILL_PX)
    if still.sum() <= MIN_SHARE_STILL * enough.sum():
        return tables, np.zeros(len(still), dtype=bool)
    raw = with_raw_matches(tables, database_path, still)
    moving = _motions(raw) > MAX_STILL_PX
    offsets = segment_subset(raw.offsets, moving)
    if not (np.diff(offsets) >= MIN_NUM_MATCHES).any():
        # Nothing moves: camera and scene are both static.
        return tables, np.zeros(len(still), dtype=bool)
    caveat = (
        f"In {int(still.sum())} of {int(enough.sum())} pairs the background does not move with the object: static"
        f" matches ({1.0 - moving.mean():.0%} of all) are removed. Masking the background is more reliable."
    )
    found = replace(
        raw,
        matches=raw.matches[moving],
        offsets=offsets,
        configs=np.where(still, UNDEFINED, raw.configs),
        caveats=(*raw.caveats, caveat),
    )
    return found, still | (np.diff(offsets) < np.diff(raw.offsets))


def _motions(tables: DatabaseTables) -> NDArray[np.float64]:
    """Distances (k,) between the keypoints of each match, pixels."""
    starts = np.concatenate([[0], np.cumsum([len(k) for k in tables.keypoints])]).astype(np.int64)
    points = np.concatenate([*tables.keypoints, np.zeros((0, 2))]).astype(np.float64)
    rows = starts[np.repeat(tables.pairs, np.diff(tables.offsets), axis=0)] + tables.matches
    return np.asarray(np.linalg.norm(points[rows[:, 0]] - points[rows[:, 1]], axis=1))
