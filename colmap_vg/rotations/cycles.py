"""Cycle consistency of edges over triangles: evidence on an edge that needs no absolute rotations.

The first step of cycle-edge message passing (Lerman & Shi, 2022) is the share of an edge's triangles whose rotations
compose to the identity, weighted by the weaker of their other two edges. False edges that are consistent among
themselves close triangles, too, so this share is only one of several criteria.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import quaternions

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

CLOSING_DEG = 8.0
"""Largest angle of the composition of a triangle's three rotations at which it counts as closed, degrees."""


def closing_shares(num_images: int, edges: IntArray, cam2_from_cam1_rotations: Array, weights: Array) -> Array:
    """Weighted share of each edge's triangles whose rotations compose to the identity.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
    weights : (m,) array

    Returns
    -------
    (m,) array
        Between 0 and 1; 0.5 for edges without triangles.
    """
    triangles = find_triangles(num_images, edges)
    closes = _close(triangles, edges, cam2_from_cam1_rotations)
    uv, vw, uw = triangles.T
    m = len(edges)
    closed, total = np.zeros(m), np.zeros(m)
    for own, one, other in ((uv, vw, uw), (vw, uv, uw), (uw, uv, vw)):
        weight = np.minimum(weights[one], weights[other])
        total += np.bincount(own, weight, minlength=m)
        closed += np.bincount(own, weight * closes, minlength=m)
    return np.where(total > 0, closed / np.maximum(total, np.finfo(float).tiny), 0.5)


def rival_share(
    num_images: int, edges: IntArray, cam2_from_cam1_rotations: Array, weights: Array, agree: BoolArray
) -> float:
    """Consistency among the edges that disagree with a solution.

    Suppose another solution rotates some of the images. Edges between these and the rest agree only with the other
    solution, edges within each group with both: a triangle of two edges of the first kind and one of the second closes.
    Edges with independent errors close no triangles.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
    weights : (m,) array
    agree : (m,) bool array
        Edges that agree with the solution.

    Returns
    -------
    float
        Share of the triangles with exactly one agreeing edge that close, weighted by the least weight of their edges. 0
        if all edges agree; 1 if less than half of the disagreeing edges are in such a triangle, which is inconclusive.
    """
    triangles = find_triangles(num_images, edges)
    triangles = triangles[agree[triangles].sum(axis=1) == 1]
    in_triangle = np.zeros(len(edges), dtype=bool)
    in_triangle[triangles] = True
    if (in_triangle & ~agree).sum() < 0.5 * (~agree).sum():
        return 1.0
    weight = weights[triangles].min(axis=1, initial=np.inf)
    closed = weight @ _close(triangles, edges, cam2_from_cam1_rotations)
    return float(closed) / max(float(weight.sum()), np.finfo(float).tiny)


def _close(triangles: IntArray, edges: IntArray, cam2_from_cam1_rotations: Array) -> BoolArray:
    """Whether the rotations around each triangle (t, 3) compose to the identity: (t,)."""
    # Orient all edges from the lower to the higher row, so that R_uw = R_vw R_uv.
    q = quaternions.from_matrices(cam2_from_cam1_rotations)
    q[:3] *= np.where(edges[:, 0] < edges[:, 1], 1.0, -1.0)
    uv, vw, uw = triangles.T
    path = quaternions.multiply(q[:, vw], q[:, uv])
    return np.asarray(np.abs(np.einsum("ct,ct->t", path, q[:, uw])) > np.cos(np.radians(0.5 * CLOSING_DEG)))


def find_triangles(num_images: int, edges: IntArray) -> IntArray:
    """Find all triangles of images u < v < w.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        Only one of several parallel edges is used.

    Returns
    -------
    (t, 3) int64 array
        Rows of the edges u-v, v-w and u-w of each triangle.
    """
    low, high = edges.min(axis=1), edges.max(axis=1)
    keys, rows = np.unique(low * num_images + high, return_index=True)
    low, high = low[rows], high[rows]
    starts = np.searchsorted(low, np.arange(num_images + 1))
    # Combine each edge u-v with each edge v-w, v < w.
    count = np.diff(starts)[high]
    first = np.repeat(np.arange(len(keys)), count)
    second = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count) + starts[high[first]]
    wanted = low[first] * num_images + high[second]
    third = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
    found = keys[third] == wanted if len(keys) else np.zeros(0, dtype=bool)
    return np.asarray(rows[np.stack([first, second, third], axis=1)[found]])
