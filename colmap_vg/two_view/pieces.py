"""Rows of segments cut into pieces of one length, so that what belongs to a segment is broadcast and never gathered.

Matches of edges, and tracks of triplets, come as one long array with offsets. Cut into pieces of one length and padded
with zeros they are arrays (pieces, length): what an edge gives all its matches is a column beside them, and sums of
products over its matches are small matrix products. That is five times faster than repeating edges over their matches.
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
_ROWS_PER_PIECE = 24  # rows that are computed in the time that a piece costs beside its rows
ROWS_PER_BLOCK = 8192
"""A column of 64 kB; the thirty of one block share the second-level cache."""


@dataclass(frozen=True, eq=False)
class Pieces:
    """Rows of segments in pieces of one length.

    Attributes
    ----------
    starts : (m + 1,) int64 array
        Pieces of segment k are ``starts[k]:starts[k + 1]``.
    counts : (p,) int64 array
        Rows in each piece; the rest of it is zero.
    columns : (p, c, length) array
        Components of the rows.
    """

    starts: IntArray
    counts: IntArray
    columns: Array

    @classmethod
    def cut(cls, offsets: IntArray, columns: list[Array]) -> "Pieces":
        """Cut rows ``offsets[k]:offsets[k + 1]`` of columns (k,) into pieces."""
        count = np.diff(offsets)
        # Ties go to the first, shorter length.
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
        """Those of some segments, in their order."""
        if len(segments) == self.num_segments:
            return self
        pieces, starts = rows_of_segments(self.starts, segments)
        return Pieces(starts, self.counts[pieces], self.columns[pieces])

    def blocks(self, num_rows: int | None = None) -> Iterator["Block"]:
        """Runs of whole segments of about so many rows."""
        per_block = max((num_rows or ROWS_PER_BLOCK) // self.columns.shape[2], 1)
        first, last = 0, self.num_segments
        while first < last:
            stop = int(np.searchsorted(self.starts, self.starts[first] + per_block, side="right")) - 1
            stop = min(max(stop, first + 1), last)
            pieces = slice(int(self.starts[first]), int(self.starts[stop]))
            yield Block(slice(first, stop), pieces, self.starts[first : stop + 1] - self.starts[first])
            first = stop

    def rows(self, values: Array, block: "Block | None" = None) -> Array:
        """Values (..., p, length) of all pieces, or of a block's, as rows (..., k) in their order."""
        counts = self.counts if block is None else self.counts[block.pieces]
        return values[..., np.arange(values.shape[-1]) < counts[:, None]]


def shrunk(rays: Array, factors: Array) -> Array:
    """Rays (p, 3, length) with the first two coordinates multiplied by factors (p,), normalised; zeros stay zero."""
    factors = factors[:, None]
    result = rays * np.stack([factors, factors, np.ones_like(factors)], axis=1)
    squared = np.einsum("pak,pak->pk", result, result)
    result /= np.sqrt(np.maximum(squared, np.finfo(np.float64).tiny))[:, None]
    return result


@dataclass(frozen=True, eq=False)
class Block:
    """A run of whole segments: which, their pieces, and offsets of these from the first piece."""

    segments: slice
    pieces: slice
    starts: IntArray

    def totals(self, values: Array) -> Array:
        """Sums of pieces (p, ...) over their segments; zero for empty ones: (m, ...)."""
        filled = np.flatnonzero(np.diff(self.starts) > 0)
        totals = np.zeros((len(self.starts) - 1, *values.shape[1:]))
        if len(filled):
            totals[filled] = np.add.reduceat(values, self.starts[:-1][filled], axis=0)
        return totals
