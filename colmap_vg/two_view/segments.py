"""Sums and medians over the segments of a concatenated array, without a loop over segments.

Segment k is rows ``offsets[k]:offsets[k + 1]``; segments may be empty.
"""

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


def segment_of_rows(offsets: IntArray) -> IntArray:
    """Segment of each row: (m + 1,) offsets to (k,)."""
    return np.repeat(np.arange(len(offsets) - 1, dtype=np.int64), np.diff(offsets))


def segment_sums(offsets: IntArray, values: Array, weights: Array | None = None) -> Array:
    """Sums of (weighted) rows within each segment; empty segments give zero.

    Parameters
    ----------
    offsets : (m + 1,) int array
    values : (k, ...) array
    weights : (k,) array, optional
        One where missing.

    Returns
    -------
    (m, ...) array
    """
    k = len(values)
    data = np.ones(k) if weights is None else weights
    # A product with a sparse indicator matrix: one pass in C, whatever the row length, and empty segments are right.
    select = sp.csr_array((data, np.arange(k), offsets), shape=(len(offsets) - 1, k))
    width = int(np.prod(values.shape[1:], dtype=np.int64))
    return np.asarray(select @ values.reshape(k, width)).reshape(len(offsets) - 1, *values.shape[1:])


def segment_quantiles(offsets: IntArray, values: Array, quantile: float = 0.5) -> Array:
    """Quantiles of (k,) values within each segment, interpolated as ``np.quantile`` does; NaN where empty: (m,)."""
    count = np.diff(offsets)
    quantiles = np.full(len(count), np.nan)
    # Segments of up to twice each other's size are sorted as rows of one array, many times faster than one long sort by
    # two keys. NaN, the padding, sorts last.
    size = np.where(count > 0, np.frexp(count.astype(np.float64))[1], 0)
    for kind in np.unique(size[size > 0]):
        chosen = np.flatnonzero(size == kind)
        n = count[chosen]
        table = np.full((len(chosen), int(n.max())), np.nan)
        table[np.arange(table.shape[1]) < n[:, None]] = values[rows_of_segments(offsets, chosen)[0]]
        table.sort(axis=1)
        place = quantile * (n - 1)
        low = np.floor(place).astype(np.int64)
        share, row = place - low, np.arange(len(chosen))
        below, above = table[row, low], table[row, np.minimum(low + 1, n - 1)]
        quantiles[chosen] = np.where(share > 0, (1.0 - share) * below + share * above, below)
    return quantiles


def segment_subset(offsets: IntArray, keep: NDArray[np.bool_]) -> IntArray:
    """Offsets (m + 1,) of the rows that are kept, for a mask (k,) over the rows."""
    return np.concatenate([[0], np.cumsum(keep)])[offsets].astype(np.int64)


def rows_of_segments(offsets: IntArray, chosen: IntArray) -> tuple[IntArray, IntArray]:
    """Rows of some segments in order, and their new offsets: (m + 1,), (s,) to (k',), (s + 1,)."""
    count = np.diff(offsets)[chosen]
    subset = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    return np.arange(subset[-1]) + np.repeat(offsets[:-1][chosen] - subset[:-1], count), subset


def evenly_thinned(offsets: IntArray, limit: int) -> NDArray[np.bool_]:
    """Rows that thin each segment to at most `limit` of them, evenly over its order: (k,); all where limit is 0."""
    counts = np.diff(offsets)
    if limit == 0 or (counts <= limit).all():
        return np.ones(int(offsets[-1]), dtype=bool)
    segment = segment_of_rows(offsets)
    rank = np.arange(len(segment)) - offsets[:-1][segment]
    kept = np.minimum(counts, limit)[segment]
    # Row r of c stays where floor(r kept / c) rises: just `kept` rows.
    return np.asarray((rank * kept) // counts[segment] != ((rank - 1) * kept) // counts[segment])
