"""Subsampling of the matches of each pair, evenly over the image."""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.two_view.segments import rows_of_segments, segment_of_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

CELLS = 12
"""Number of grid cells along each side of the bounding box of a pair's matches."""


def well_spread(offsets: IntArray, bearings: Array, limit: int) -> NDArray[np.bool_]:
    """Subsample each segment to at most `limit` rows that are spread evenly over the image.

    The bounding box of a segment's rays is divided into a grid. The first row of every cell is kept before the second
    row of any, and so on.

    Parameters
    ----------
    offsets : (m + 1,) int64 array
        Matches of pair k are rows ``offsets[k]:offsets[k + 1]``.
    bearings : (k, 3) array
        Unit rays in one image of each pair.
    limit : int
        Maximum number of rows per segment; 0 keeps all.

    Returns
    -------
    (k,) bool array
        True for rows that are kept.
    """
    kept = np.ones(int(offsets[-1]), dtype=np.bool_)
    crowded = np.flatnonzero(np.diff(offsets) > limit)
    if limit == 0 or len(crowded) == 0:
        return kept
    rows, starts = rows_of_segments(offsets, crowded)
    segment = segment_of_rows(starts)
    cell = segment
    # Rays at a right angle to the optical axis have no image in a plane: this projection is finite for all of them.
    for place in (bearings[rows, :2] / (1.0 + np.abs(bearings[rows, 2:]))).T:
        low, high = np.minimum.reduceat(place, starts[:-1]), np.maximum.reduceat(place, starts[:-1])
        width = np.maximum(high - low, np.finfo(np.float64).tiny)
        number = ((place - low[segment]) / width[segment] * CELLS).astype(np.int64)
        cell = cell * CELLS + np.minimum(number, CELLS - 1)
    rank = _rank_in_group(cell)
    order = np.lexsort((rank, segment))
    chosen = np.empty(len(rows), dtype=np.bool_)
    chosen[order] = np.arange(len(rows)) - starts[:-1][segment] < limit
    kept[rows] = chosen
    return kept


def _rank_in_group(group: IntArray) -> IntArray:
    """Number of earlier elements of the same group, for each element."""
    order = np.argsort(group, kind="stable")
    ordered = group[order]
    first = np.concatenate([[True], ordered[1:] != ordered[:-1]])
    starts = np.flatnonzero(first)[np.cumsum(first) - 1]
    rank = np.empty(len(group), dtype=np.int64)
    rank[order] = np.arange(len(group)) - starts
    return rank
