"""How well edges agree with the triangles that they are in: evidence on an edge that needs no absolute rotations.

The first step of cycle-edge message passing (Lerman & Shi, 2022): of the triangles of an edge, weighed by the weaker of
their other two edges, the share that closes. False edges that agree among themselves close triangles, too, so this is
one opinion among others.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import quaternions

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

CLOSING_DEG = 8.0
"""Angle left after a triangle's three rotations at which it counts as closed."""


def closing_shares(num_images: int, edges: IntArray, cam2_from_cam1_rotations: Array, weights: Array) -> Array:
    """Weighted share of each edge's triangles that close.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
    weights : (m,) array

    Returns
    -------
    (m,) array
        0 to 1; 0.5 for edges that are in no triangle.
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
    """How far the edges that disagree with a solution agree among themselves.

    Where another solution turns some of the images, the edges from these to the rest are its own, those among these
    are of both: a triangle of two edges of the first kind and one of the second closes. Edges that are wrong each in
    its own way close none.

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
        Share that closes of the triangles with one edge that agrees, each weighed by the lightest of its edges; 0 where
        all edges agree, 1 where less than half of those that disagree are in such a triangle: that tells nothing.
    """
    triangles = find_triangles(num_images, edges)
    triangles = triangles[agree[triangles].sum(axis=1) == 1]
    asked = np.zeros(len(edges), dtype=bool)
    asked[triangles] = True
    if (asked & ~agree).sum() < 0.5 * (~agree).sum():
        return 1.0
    weight = weights[triangles].min(axis=1, initial=np.inf)
    closed = weight @ _close(triangles, edges, cam2_from_cam1_rotations)
    return float(closed) / max(float(weight.sum()), np.finfo(float).tiny)


def _close(triangles: IntArray, edges: IntArray, cam2_from_cam1_rotations: Array) -> BoolArray:
    """Whether the rotations around each triangle (t, 3) come back to where they started."""
    # All edges from the lower to the higher row, so that R_uw = R_vw R_uv.
    q = quaternions.from_matrices(cam2_from_cam1_rotations)
    q[:3] *= np.where(edges[:, 0] < edges[:, 1], 1.0, -1.0)
    uv, vw, uw = triangles.T
    path = quaternions.multiply(q[:, vw], q[:, uv])
    return np.asarray(np.abs(np.einsum("ct,ct->t", path, q[:, uw])) > np.cos(np.radians(0.5 * CLOSING_DEG)))


def find_triangles(num_images: int, edges: IntArray) -> IntArray:
    """All triangles of images u < v < w.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        Of parallel edges one counts.

    Returns
    -------
    (t, 3) int64 array
        Their edges u-v, v-w and u-w.
    """
    low, high = edges.min(axis=1), edges.max(axis=1)
    keys, rows = np.unique(low * num_images + high, return_index=True)
    low, high = low[rows], high[rows]
    starts = np.searchsorted(low, np.arange(num_images + 1))
    # Each edge u-v with each edge that goes up from v.
    count = np.diff(starts)[high]
    first = np.repeat(np.arange(len(keys)), count)
    second = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count) + starts[high[first]]
    wanted = low[first] * num_images + high[second]
    third = np.minimum(np.searchsorted(keys, wanted), max(len(keys) - 1, 0))
    found = keys[third] == wanted if len(keys) else np.zeros(0, dtype=bool)
    return np.asarray(rows[np.stack([first, second, third], axis=1)[found]])
