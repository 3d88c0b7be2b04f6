"""Objects that turn before a camera that stands still.

The background then agrees with a camera that never moved, and where it has more matches than the object, verification
keeps it alone. Without the matches that stand still, the object's are left: as if the camera went around it.
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
"""Pixels; matches that move less stand still, but for the noise of keypoints."""
MIN_SHARE_STILL = 0.5
"""Of pairs whose median match stands still, above which the camera does. Half of the pairs of a camera that moves by so
little tell no direction either."""
MATCHES_LOOKED_AT, MIN_NUM_MATCHES = 50, 15
"""Matches of a pair whose median is taken, and the least number that makes one: COLMAP's of inliers."""


def without_still_background(
    tables: DatabaseTables, database_path: str | PathLike[str]
) -> tuple[DatabaseTables, BoolArray]:
    """Tables without the matches that stand still, where most pairs consist of them.

    Returns
    -------
    tables : DatabaseTables
        Of such a database, without the matches that stand still; pairs whose median match does have the other ones as
        they were before verification, and no matrices.
    changed : (m,) bool array
        Pairs that lost matches.
    """
    asked = np.diff(tables.offsets) >= MIN_NUM_MATCHES
    few = evenly_thinned(tables.offsets, MATCHES_LOOKED_AT)
    thinned = replace(tables, matches=tables.matches[few], offsets=segment_subset(tables.offsets, few))
    still = asked & (segment_quantiles(thinned.offsets, _motions(thinned)) <= MAX_STILL_PX)
    if still.sum() <= MIN_SHARE_STILL * asked.sum():
        return tables, np.zeros(len(still), dtype=bool)
    raw = with_raw_matches(tables, database_path, still)
    moving = _motions(raw) > MAX_STILL_PX
    offsets = segment_subset(raw.offsets, moving)
    if not (np.diff(offsets) >= MIN_NUM_MATCHES).any():
        # Nothing turns: the camera stood still before a scene that did.
        return tables, np.zeros(len(still), dtype=bool)
    caveat = (
        f"In {int(still.sum())} of {int(asked.sum())} pairs the background does not move with the object: matches that"
        f" stand still, {1.0 - moving.mean():.0%}, are left out. Masks of the background are safer."
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
