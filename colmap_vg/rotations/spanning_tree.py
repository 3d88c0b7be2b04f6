"""Absolute rotations chained along a maximum-weight spanning tree."""

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from colmap_vg.geometry import so3
from colmap_vg.rotations.problem import checked_problem

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


def rotations_from_spanning_tree(
    num_images: int,
    edges: ArrayLike,
    cam2_from_cam1_rotations: ArrayLike,
    weights: ArrayLike | None = None,
) -> Array:
    """Chain relative rotations along the maximum-weight spanning tree.

    The root is the image with most edges; its rotation is the identity. Among equal weights, edges between images with
    many edges are preferred, which keeps the tree shallow.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
    weights : (m,) array, optional
        Default: all one. Edges of weight zero are ignored.

    Returns
    -------
    (n, 3, 3) array
        cam_from_world rotations that agree exactly with the tree's edges.

    Raises
    ------
    GraphError
        The graph is malformed or disconnected.
    """
    edges, relative, w = checked_problem(num_images, edges, cam2_from_cam1_rotations, weights)
    parents, parent_edges, root = spanning_tree(num_images, edges, w)
    rows = np.flatnonzero(parent_edges >= 0)
    e = parent_edges[rows]
    forward = edges[e, 1] == rows  # the edge leads from the parent to this image
    chained = np.tile(np.eye(3), (num_images, 1, 1))
    chained[rows] = np.where(forward[:, None, None], relative[e], np.swapaxes(relative[e], 1, 2))
    # R_i = T_i R_parent(i). Pointer jumping doubles the length of the chains each time: log2(depth) rounds.
    while (parents != root).any():
        chained = chained @ chained[parents]
        parents = parents[parents]
    return so3.project(chained)


def spanning_tree(num_images: int, edges: IntArray, weights: Array) -> tuple[IntArray, IntArray, int]:
    """Maximum-weight spanning tree of a connected graph.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int64 array
    weights : (m,) array
        Edges of weight zero are ignored.

    Returns
    -------
    parents : (n,) int64 array
        Parent of each image; the root is its own parent.
    parent_edges : (n,) int64 array
        Edge to the parent; -1 at the root.
    root : int
        The image with most edges.
    """
    degree = np.bincount(edges.ravel(), minlength=num_images)
    usable = np.flatnonzero(weights > 0)
    ends = np.sort(edges[usable], axis=1)
    # Use ranks instead of weights: csgraph treats zeros as absent edges, and ties need a defined order.
    order = np.lexsort((usable, -degree[ends].min(axis=1), -weights[usable]))
    rank = np.empty(len(usable))
    rank[order] = np.arange(1.0, len(usable) + 1.0)
    # Keep only the best of parallel edges, since sparse matrices would sum them.
    keys = ends[:, 0] * num_images + ends[:, 1]
    by_key = order[np.argsort(keys[order], kind="stable")]
    unique_keys, first = np.unique(keys[by_key], return_index=True)
    best = by_key[first]
    graph = sp.csr_array((rank[best], (ends[best, 0], ends[best, 1])), shape=(num_images, num_images))
    root = int(np.argmax(degree))
    _, found = breadth_first_order(minimum_spanning_tree(graph), root, directed=False)
    parents = np.where(found < 0, root, found).astype(np.int64)
    rows = np.arange(num_images)
    parent_edges = np.full(num_images, -1, dtype=np.int64)
    child = rows != root
    child_keys = np.minimum(rows, parents)[child] * num_images + np.maximum(rows, parents)[child]
    parent_edges[child] = usable[best[np.searchsorted(unique_keys, child_keys)]]
    return parents, parent_edges, root
