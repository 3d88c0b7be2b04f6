"""Parts of a viewing graph with renumbered images."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Subgraph:
    """Subset of the images and edges of a graph.

    Attributes
    ----------
    images : (k,) int64 array
        Rows of the graph's images, in increasing order.
    edge_rows : (e,) int64 array
        Rows of the graph's edges, in increasing order.
    edges : (e, 2) int64 array
        Rows into `images`.
    """

    images: IntArray
    edge_rows: IntArray
    edges: IntArray

    @classmethod
    def of(cls, edges: IntArray, images: BoolArray, kept: BoolArray) -> "Subgraph":
        """Subgraph of the images of a mask (n,) and those edges (m, 2) of a mask `kept` (m,) that are between them."""
        rows = np.flatnonzero(images)
        local = np.full(len(images), -1, dtype=np.int64)
        local[rows] = np.arange(len(rows))
        inside = np.flatnonzero(kept & images[edges].all(axis=1))
        return cls(rows, inside, local[edges[inside]])

    def with_edges(self, kept: BoolArray) -> "Subgraph":
        """Subgraph with the same images and the edges of a mask (e,)."""
        return Subgraph(self.images, self.edge_rows[kept], self.edges[kept])

    @property
    def num_images(self) -> int:
        """Number of images k."""
        return len(self.images)

    def rows_of(self, images: IntArray) -> IntArray:
        """Rows in this part of images given by their rows in the graph."""
        return np.searchsorted(self.images, images)
