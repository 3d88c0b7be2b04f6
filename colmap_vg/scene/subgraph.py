"""Part of a viewing graph, with its images renumbered."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Subgraph:
    """Some images and edges of a graph.

    Attributes
    ----------
    images : (k,) int64 array
        Rows of the graph's images, rising.
    edge_rows : (e,) int64 array
        Rows of the graph's edges, rising.
    edges : (e, 2) int64 array
        Rows into `images`.
    """

    images: IntArray
    edge_rows: IntArray
    edges: IntArray

    @classmethod
    def of(cls, edges: IntArray, images: BoolArray, kept: BoolArray) -> "Subgraph":
        """The images marked (n,) and, of the edges marked (m,), those between them; `edges` is the graph's (m, 2)."""
        rows = np.flatnonzero(images)
        local = np.full(len(images), -1, dtype=np.int64)
        local[rows] = np.arange(len(rows))
        inside = np.flatnonzero(kept & images[edges].all(axis=1))
        return cls(rows, inside, local[edges[inside]])

    def with_edges(self, kept: BoolArray) -> "Subgraph":
        """The same images, and those of its edges that are marked (e,)."""
        return Subgraph(self.images, self.edge_rows[kept], self.edges[kept])

    @property
    def num_images(self) -> int:
        """Number of images k."""
        return len(self.images)

    def rows_of(self, images: IntArray) -> IntArray:
        """Rows in this part of some of its images, given by their rows in the graph."""
        return np.searchsorted(self.images, images)
