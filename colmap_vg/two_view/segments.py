"""Sums, medians and products over the segments of a concatenated array, without a loop over segments.

Segment k is rows ``offsets[k]:offsets[k + 1]``; segments may be empty.
"""

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

SEGMENTS_AT_A_TIME = 128
"""Segments whose rows are multiplied together."""


def segment_of_rows(offsets: IntArray) -> IntArray:
    """Index of the segment of each row: offsets (m + 1,) to (k,)."""
    return np.repeat(np.arange(len(offsets) - 1, dtype=np.int64), np.diff(offsets))


def segment_sums(offsets: IntArray, values: Array, weights: Array | None = None) -> Array:
    """Sums of (weighted) rows within each segment; empty segments give zero.

    Parameters
    ----------
    offsets : (m + 1,) int array
    values : (k, ...) array
    weights : (k,) array, optional
        Default: all one.

    Returns
    -------
    (m, ...) array
    """
    k = len(values)
    data = np.ones(k) if weights is None else weights
    # A product with a sparse indicator matrix: one pass in C for any row length, and zero for empty segments.
    select = sp.csr_array((data, np.arange(k), offsets), shape=(len(offsets) - 1, k))
    width = int(np.prod(values.shape[1:], dtype=np.int64))
    return np.asarray(select @ values.reshape(k, width)).reshape(len(offsets) - 1, *values.shape[1:])


def segment_quantiles(offsets: IntArray, values: Array, quantile: float = 0.5) -> Array:
    """Quantiles of (k,) values within each segment, interpolated as ``np.quantile`` does; NaN where empty: (m,)."""
    count = np.diff(offsets)
    quantiles = np.full(len(count), np.nan)
    # Segments whose sizes differ by less than a factor of two are sorted as rows of one array, many times faster than
    # one long sort by two keys. The padding, NaN, sorts last.
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
    """Offsets (m + 1,) of the segments after only the rows of a mask (k,) are kept."""
    return np.concatenate([[0], np.cumsum(keep)])[offsets].astype(np.int64)


def products_of_segments(matrices: Array, offsets: IntArray, vectors: Array) -> Array:
    """Multiply the vectors (k, b) of each segment by its matrix (m, a, b): (k, a).

    Some segments at a time, so that their matrices, repeated for each vector, stay in the processor's memory.
    """
    found = np.empty((len(vectors), matrices.shape[1]))
    for start in range(0, len(matrices), SEGMENTS_AT_A_TIME):
        bounds = offsets[start : start + SEGMENTS_AT_A_TIME + 1]
        rows, segment = slice(bounds[0], bounds[-1]), segment_of_rows(bounds - bounds[0])
        found[rows] = np.einsum("kab,kb->ka", matrices[start + segment], vectors[rows])
    return found


def rows_of_segments(offsets: IntArray, chosen: IntArray) -> tuple[IntArray, IntArray]:
    """Rows of the chosen segments (s,) and the offsets of these segments in them: (k',), (s + 1,)."""
    count = np.diff(offsets)[chosen]
    subset = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    return np.arange(subset[-1]) + np.repeat(offsets[:-1][chosen] - subset[:-1], count), subset


def evenly_thinned(offsets: IntArray, limit: int) -> NDArray[np.bool_]:
    """Mask (k,) that keeps at most `limit` rows of each segment at regular intervals; all rows where limit is 0."""
    counts = np.diff(offsets)
    if limit == 0 or (counts <= limit).all():
        return np.ones(int(offsets[-1]), dtype=bool)
    kept = np.minimum(counts, limit)
    chosen = np.concatenate([[0], np.cumsum(kept)]).astype(np.int64)
    segment = segment_of_rows(chosen)
    rank = np.arange(len(segment)) - chosen[:-1][segment]
    mask = np.zeros(int(offsets[-1]), dtype=bool)
    # The rows r of c where floor(r kept / c) increases.
    mask[offsets[:-1][segment] - (-rank * counts[segment]) // kept[segment]] = True
    return mask
