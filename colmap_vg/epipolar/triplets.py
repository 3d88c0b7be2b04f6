"""Selection of image triplets (a, b, c) with tracks through b, by their information on the ratio of two baselines.

A half-edge is an edge together with one of its images. Two half-edges of an image b that match the same keypoints form
a triplet, whether or not a and c are matched. Its score is ``sum sin(theta_a) sin(theta_c)`` over the shared keypoints,
with the angles theta between the rays of a point: the information on the ratio increases with both.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import minimum_spanning_tree

from colmap_vg.events import report_progress
from colmap_vg.geometry.directions import norm_of_cross
from colmap_vg.two_view.pieces import Pieces
from colmap_vg.two_view.segments import (
    evenly_thinned,
    products_of_segments,
    rows_of_segments,
    segment_of_rows,
    segment_subset,
    segment_sums,
)

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

HALF_EDGES_PER_IMAGE = 24
"""Maximum number of half-edges per image that are paired, those of highest score: the number of pairs is quadratic."""
TRIPLETS_PER_IMAGE = 6
"""Maximum number of triplets with the same middle image, apart from those of the spanning forest."""
MIN_TRACKS = 10
"""Minimum number of shared keypoints of a triplet."""


@dataclass(frozen=True, eq=False)
class Triplets:
    """Image triplets with their tracks.

    Attributes
    ----------
    images : (q, 3) int64 array
        Images a, b, c; b is shared by both edges.
    edges : (q, 2) int64 array
        Rows of the edge between a and b, and of that between b and c.
    offsets : (q + 1,) int64 array
        Tracks of triplet k are rows ``offsets[k]:offsets[k + 1]``.
    bearings : (3, 3, k) array
        Unit rays in a, b and c; the second axis holds the components.
    keypoints : (3, k) int64 array
        Keypoint indices in a, b and c.
    """

    images: IntArray
    edges: IntArray
    offsets: IntArray
    bearings: Array
    keypoints: IntArray

    @cached_property
    def pieces(self) -> Pieces:
        """Pieces of the nine components of the rays."""
        return Pieces.cut(self.offsets, list(self.bearings.reshape(9, -1)))

    def without(self, dropped: BoolArray) -> "Triplets":
        """Remove the triplets that use a dropped edge, given a mask (m,), and renumber the remaining edges."""
        kept = np.flatnonzero(~dropped[self.edges].any(axis=1))
        rows, offsets = rows_of_segments(self.offsets, kept)
        number = np.cumsum(~dropped) - 1
        return replace(
            self,
            images=self.images[kept],
            edges=number[self.edges[kept]],
            offsets=offsets,
            bearings=self.bearings[:, :, rows],
            keypoints=self.keypoints[:, rows],
        )


def find_triplets(
    edges: IntArray,
    offsets: IntArray,
    keypoints1: NDArray[np.int32],
    keypoints2: NDArray[np.int32],
    bearings1: Array,
    bearings2: Array,
    relative_rotations: Array,
    max_num_tracks: int,
) -> Triplets:
    """Select triplets by the score of their shared tracks.

    Parameters
    ----------
    edges : (m, 2) int64 array
    offsets : (m + 1,) int64 array
        Matches of edge k are rows ``offsets[k]:offsets[k + 1]``.
    keypoints1, keypoints2 : (k,) int array
        Keypoint indices of the matches in image 1 and image 2.
    bearings1, bearings2 : (k, 3) array
        Unit rays of the matches.
    relative_rotations : (m, 3, 3) array
        cam2_from_cam1 rotations, used for the angles between rays.
    max_num_tracks : int
        Maximum number of tracks per triplet; 0: all.

    Returns
    -------
    Triplets
        About `TRIPLETS_PER_IMAGE` per middle image.
    """
    m, k = len(edges), len(bearings1)
    turned = products_of_segments(relative_rotations, offsets, bearings1)
    sine = norm_of_cross(turned, bearings2)
    # Half-edges at the first images, then those at the second ones; rows of matches in the same order.
    report_progress("tracks")
    middle, other = edges.T.ravel(), edges[:, ::-1].T.ravel()
    half_offsets = np.concatenate([offsets, offsets[1:] + k])
    keypoints = np.concatenate([keypoints1, keypoints2]).astype(np.int64)
    chosen = _best_of_each(middle, segment_sums(half_offsets, np.tile(np.square(sine), 2)), HALF_EDGES_PER_IMAGE)
    report_progress("tracks")
    pairs = _select_pairs(middle[chosen], other[chosen], half_offsets, keypoints, np.tile(sine, 2), chosen, m)
    report_progress("tracks")
    first, second = _join(pairs, half_offsets, keypoints)
    shared = np.concatenate([[0], np.cumsum(np.bincount(first[0], minlength=len(pairs)))]).astype(np.int64)
    report_progress("tracks")
    kept = evenly_thinned(shared, max_num_tracks)
    report_progress("tracks")
    rows_a, rows_c = first[1][kept], second[kept]
    # The row of a match in the lists of both directions, and that of its other end.
    ends = [(rows_a + k) % (2 * k), rows_a, (rows_c + k) % (2 * k)]
    return Triplets(
        np.stack([other[pairs[:, 0]], middle[pairs[:, 0]], other[pairs[:, 1]]], axis=1),
        pairs % m,
        segment_subset(shared, kept),
        np.stack([np.where(rows < k, bearings1[rows % k].T, bearings2[rows % k].T) for rows in ends]),
        np.stack([keypoints[rows] for rows in ends]),
    )


def _select_pairs(
    middle: IntArray,
    other: IntArray,
    half_offsets: IntArray,
    keypoints: IntArray,
    sine: Array,
    chosen: IntArray,
    num_edges: int,
) -> IntArray:
    """Pairs (q, 2) of half-edges that share keypoints, those of highest score of each image, in increasing order."""
    rows, offsets = rows_of_segments(half_offsets, chosen)
    image = middle[segment_of_rows(offsets)]
    # One column per keypoint of each image.
    highest = np.zeros(int(middle.max(initial=0)) + 1, dtype=np.int64)
    np.maximum.at(highest, image, keypoints[rows] + 1)
    column = (np.cumsum(highest) - highest)[image] + keypoints[rows]
    size = (len(chosen), int(highest.sum()))
    seen = sp.csr_array((sine[rows], column, offsets), shape=size)
    across = sp.csr_array(seen.T)
    ones = sp.csr_array((np.ones(len(rows)), seen.indices, seen.indptr), shape=size)
    back = sp.csr_array((np.ones(len(rows)), across.indices, across.indptr), shape=size[::-1])
    count = sp.coo_array(sp.triu(ones @ back, k=1))
    a, c = count.coords
    enough = (count.data >= MIN_TRACKS) & (other[a] != other[c])
    a, c = a[enough].astype(np.int64), c[enough].astype(np.int64)
    if len(a) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    products = sp.csr_array(seen @ across)
    score = np.asarray(products[a, c]).ravel()
    edge_a, edge_c = chosen[a] % num_edges, chosen[c] % num_edges
    tree = _maximum_spanning_forest(edge_a, edge_c, score, num_edges)
    best = np.union1d(_best_of_each(middle[a], score, TRIPLETS_PER_IMAGE), tree)
    return np.stack([chosen[a[best]], chosen[c[best]]], axis=1)


def _maximum_spanning_forest(first: IntArray, second: IntArray, score: Array, num_nodes: int) -> IntArray:
    """Rows, in increasing order, of the links in the spanning forest of largest total score."""
    order = np.argsort(score, kind="stable")
    links = sp.csr_array(
        (1.0 + np.arange(len(order))[::-1], (first[order], second[order])), shape=(num_nodes, num_nodes)
    )
    tree = sp.coo_array(minimum_spanning_tree(links))
    return np.sort(order[len(order) - tree.data.astype(np.int64)])


def _join(pairs: IntArray, half_offsets: IntArray, keypoints: IntArray) -> tuple[tuple[IntArray, IntArray], IntArray]:
    """Matches that two half-edges share: (pair, row in the first half-edge), row in the second half-edge."""
    width = int(keypoints.max(initial=0)) + 1
    used = np.unique(pairs)
    rows, offsets = rows_of_segments(half_offsets, used)
    key = segment_of_rows(offsets) * width + keypoints[rows]
    order = np.argsort(key, kind="stable")
    key, sorted_rows = key[order], rows[order]
    mine, mine_offsets = rows_of_segments(half_offsets, pairs[:, 0])
    pair = segment_of_rows(mine_offsets)
    wanted = np.searchsorted(used, pairs[:, 1])[pair] * width + keypoints[mine]
    place = np.minimum(np.searchsorted(key, wanted), max(len(key) - 1, 0))
    hit = key[place] == wanted if len(key) else np.zeros(0, dtype=bool)
    return (pair[hit], mine[hit]), sorted_rows[place[hit]]


def _best_of_each(group: IntArray, score: Array, limit: int) -> IntArray:
    """At most `limit` members of highest score in each group, in increasing order."""
    order = np.lexsort((-score, group))
    starts = np.searchsorted(group[order], group[order], side="left")
    return np.sort(order[np.arange(len(order)) - starts < limit])
