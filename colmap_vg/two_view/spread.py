"""Few matches of each pair that cover the image as all of them do not: one of each cell before two of any."""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.two_view.segments import rows_of_segments, segment_of_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

CELLS = 12
"""Cells along each side of the part of image 1 that the matches of a pair cover."""


def well_spread(offsets: IntArray, bearings: Array, limit: int) -> NDArray[np.bool_]:
    """Rows that thin each segment to at most `limit` of them, well spread over the image.

    Cells give up their matches in turn, in the order of the list, so that crowded cells give no more than empty ones
    have to leave.

    Parameters
    ----------
    offsets : (m + 1,) int64 array
    bearings : (k, 3) array
        Rays in one image of each pair.
    limit : int
        0: all.

    Returns
    -------
    (k,) bool array
    """
    kept = np.ones(int(offsets[-1]), dtype=np.bool_)
    crowded = np.flatnonzero(np.diff(offsets) > limit)
    if limit == 0 or len(crowded) == 0:
        return kept
    rows, starts = rows_of_segments(offsets, crowded)
    segment = segment_of_rows(starts)
    cell = segment
    # Rays at a right angle to the axis have no place in a plane; those of wide lenses are scaled, not lost.
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
    """How many earlier ones of the same group there are."""
    order = np.argsort(group, kind="stable")
    ordered = group[order]
    first = np.concatenate([[True], ordered[1:] != ordered[:-1]])
    starts = np.flatnonzero(first)[np.cumsum(first) - 1]
    rank = np.empty(len(group), dtype=np.int64)
    rank[order] = np.arange(len(group)) - starts
    return rank
