"""Segments of rows cut into zero-padded pieces of equal length, so that values per segment broadcast over the rows.

Matches of edges and tracks of triplets are stored as one long array with offsets. Cut into pieces of equal length and
padded with zeros, they form arrays (pieces, length): values per edge are columns that broadcast, and sums of products
over the matches are small matrix products. This is five times faster than repeating values per edge for every match.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from colmap_vg.two_view.segments import rows_of_segments, segment_of_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

_LENGTHS = (8, 16, 24, 32, 48, 64, 96, 128, 192, 256)
_ROWS_PER_PIECE = 24  # overhead of a piece, expressed in rows that are computed in the same time
ROWS_PER_BLOCK = 8192
"""Rows per block. A column has 64 kB; the thirty columns of a block fit in the second-level cache."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """Rows of segments in zero-padded pieces of equal length.

    Attributes
    ----------
    starts : (m + 1,) int64 array
        Pieces of segment k are ``starts[k]:starts[k + 1]``.
    counts : (p,) int64 array
        Number of rows in each piece; the remaining entries are zero.
    columns : (p, c, length) array
        Components of the rows.
    """

    starts: IntArray
    counts: IntArray
    columns: Array

    @classmethod
    def cut(cls, offsets: IntArray, columns: list[Array]) -> "Pieces":
        """Cut columns (k,) into pieces; segment k is rows ``offsets[k]:offsets[k + 1]``."""
        count = np.diff(offsets)
        # The first, shorter length wins ties.
        length = min(_LENGTHS, key=lambda size: int((-(-count // size)).sum()) * (size + _ROWS_PER_PIECE))
        number = -(-count // length)
        starts = np.concatenate([[0], np.cumsum(number)]).astype(np.int64)
        rank = np.arange(starts[-1]) - np.repeat(starts[:-1], number)
        counts = np.minimum(np.repeat(count, number) - rank * length, length)
        filled = np.arange(length) < counts[:, None]
        padded = np.zeros((len(counts), len(columns), length))
        for place, column in enumerate(columns):
            padded[:, place][filled] = column
        return cls(starts, counts, padded)

    @property
    def num_segments(self) -> int:
        return len(self.starts) - 1

    @cached_property
    def segments(self) -> IntArray:
        """Segment of each piece: (p,)."""
        return segment_of_rows(self.starts)

    @cached_property
    def offsets(self) -> IntArray:
        """Offsets (m + 1,) of the segments' rows."""
        return np.concatenate([[0], np.cumsum(self.counts)])[self.starts].astype(np.int64)

    def of(self, segments: IntArray) -> "Pieces":
        """Pieces of the given segments, in the given order."""
        if len(segments) == self.num_segments:
            return self
        pieces, starts = rows_of_segments(self.starts, segments)
        return Pieces(starts, self.counts[pieces], self.columns[pieces])

    def blocks(self, num_rows: int | None = None) -> Iterator["Block"]:
        """Iterate over runs of whole segments with about `num_rows` rows each."""
        per_block = max((num_rows or ROWS_PER_BLOCK) // self.columns.shape[2], 1)
        first, last = 0, self.num_segments
        while first < last:
            stop = int(np.searchsorted(self.starts, self.starts[first] + per_block, side="right")) - 1
            stop = min(max(stop, first + 1), last)
            pieces = slice(int(self.starts[first]), int(self.starts[stop]))
            yield Block(slice(first, stop), pieces, self.starts[first : stop + 1] - self.starts[first])
            first = stop

    def rows(self, values: Array, block: "Block | None" = None) -> Array:
        """Rows (..., k) in their original order from values (..., p, length) of all pieces, or of those of a block."""
        counts = self.counts if block is None else self.counts[block.pieces]
        return values[..., np.arange(values.shape[-1]) < counts[:, None]]


def rescaled_rays(rays: Array, focal_ratios: Array) -> Array:
    """Unit rays (p, 3, length) after their focal lengths are divided by `focal_ratios` (p,); zero padding stays zero.

    The first two coordinates are multiplied by the ratio of the old to the new focal length.
    """
    ratios = focal_ratios[:, None]
    result = rays * np.stack([ratios, ratios, np.ones_like(ratios)], axis=1)
    squared = np.einsum("pak,pak->pk", result, result)
    result /= np.sqrt(np.maximum(squared, np.finfo(np.float64).tiny))[:, None]
    return result


@dataclass(frozen=True, eq=False)
class Block:
    """A run of whole segments.

    Attributes
    ----------
    segments, pieces : slice
        Segments of the run, and their pieces.
    starts : (s + 1,) int64 array
        Pieces of each segment, counted from the first piece of the run.
    """

    segments: slice
    pieces: slice
    starts: IntArray

    def totals(self, values: Array) -> Array:
        """Sums over each segment of values per piece (p, ...); zero for empty segments: (s, ...)."""
        filled = np.flatnonzero(np.diff(self.starts) > 0)
        totals = np.zeros((len(self.starts) - 1, *values.shape[1:]))
        if len(filled):
            totals[filled] = np.add.reduceat(values, self.starts[:-1][filled], axis=0)
        return totals
