"""Parallel rigidity: images whose positions are determined by edge directions, up to translation and scale.

Generic positions are determined by the directions of a graph's edges if the only motions that preserve all directions
are translation and scaling of the whole (Ozyesil & Singer, CVPR 2015). A motion x preserves the direction of edge
(i, j) if ``x_j - x_i = s_ij (p_j - p_i)``. Two edges belong to one rigid component if they have the same stretch ``s``
in every motion; testing random positions and one random motion is correct with probability one (Kennedy et al., IROS
2012).

A known ratio of the lengths of two edges adds the equation ``s_e = s_f``. Edges connected by ratios, directly or
through others, have the same stretch and, if they connect images, form a rigid body; rigidity between such bodies
remains to be tested. The ranks of the full system of both are the same generically (see the tests).
"""

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from colmap_vg.linear.assembly import BlockPattern
from colmap_vg.linear.solvers import factorize
from colmap_vg.scene.components import components_by_size

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

SAME_STRETCH = 1e-6
"""Largest difference of equal stretches, dimensionless; a random motion separates components by about 1."""


def largest_rigid_component(
    num_images: int, edges: IntArray, seed: int = 0, ratios: IntArray | None = None
) -> tuple[BoolArray, BoolArray]:
    """Images and edges of the largest parallel-rigid component.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    seed : int
        Random seed of the positions at which rigidity is tested.
    ratios : (q, 2) int array, optional
        Rows of two edges whose length ratio is known.

    Returns
    -------
    images : (num_images,) bool array
        All False if there are no edges.
    edges : (m,) bool array
        Edges of that component.
    """
    labels = rigid_components(num_images, edges, seed, ratios)
    inside = labels == 0
    images = np.zeros(num_images, dtype=bool)
    images[edges[inside].ravel()] = True
    return images, inside


def rigid_components(num_images: int, edges: IntArray, seed: int = 0, ratios: IntArray | None = None) -> IntArray:
    """Rigid component of each edge, 0 for the one with most images. An image may be in several components.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        Parallel edges count once.
    seed : int
        Random seed of the positions at which rigidity is tested.
    ratios : (q, 2) int array, optional
        Rows of two edges whose length ratio is known.

    Returns
    -------
    (m,) int64 array
    """
    if len(edges) == 0:
        return np.zeros(0, dtype=np.int64)
    body, sparse_edges = _grow_rigid_body(num_images, edges)
    inside = body[edges].all(axis=1)
    labels = np.full(len(edges), -1, dtype=np.int64)
    rest = np.flatnonzero(~inside)
    if len(rest):
        tested = np.concatenate([sparse_edges, edges[rest]])
        # All edges of the body have the stretch of its first edge.
        row = np.zeros(len(edges), dtype=np.int64)
        row[rest] = len(sparse_edges) + np.arange(len(rest))
        equal = np.zeros((0, 2), dtype=np.int64) if ratios is None else row[ratios]
        found = _labels_by_stretch(num_images, tested, seed, equal[equal[:, 0] != equal[:, 1]])
        labels[rest] = found[len(sparse_edges) :]
        labels[inside] = found[0]
    else:
        labels[:] = 0
    return _numbered_by_images(num_images, edges, labels)


def _grow_rigid_body(num_images: int, edges: IntArray) -> tuple[BoolArray, IntArray]:
    """Grow a rigid set of images by two edges per added image; return its mask and the edges used (at least one)."""
    pairs = np.unique(np.sort(edges, axis=1), axis=0)
    weights = np.ones(len(pairs))
    A = sp.coo_array((weights, (pairs[:, 0], pairs[:, 1])), shape=(num_images, num_images)).tocsr()
    A = sp.csr_array(A + A.T)
    degree = np.diff(A.indptr)
    # Start at the edge whose ends have the highest degrees, which is likely to be in a rigid core.
    start = pairs[np.argmax(np.minimum(degree[pairs[:, 0]], degree[pairs[:, 1]]))]
    level = np.full(num_images, np.iinfo(np.int64).max)
    level[start] = 0
    body = level == 0
    step = 0
    while True:
        step += 1
        new = (A @ body.astype(float) >= 2) & ~body
        if not new.any():
            break
        level[new] = step
        body |= new
    grown = np.flatnonzero(body & (level > 0))
    earlier = A[grown].tocoo()
    keep = level[earlier.col] < level[grown[earlier.row]]
    rows, cols = grown[earlier.row[keep]], earlier.col[keep]
    order = np.lexsort((cols, rows))
    rows, cols = rows[order], cols[order]
    first = np.concatenate([[True], rows[1:] != rows[:-1]]) if len(rows) else np.zeros(0, dtype=bool)
    second = np.concatenate([[False], first[:-1]]) if len(rows) else first
    used = first | second
    return body, np.concatenate([start[None], np.stack([rows[used], cols[used]], axis=1)]).astype(np.int64)


def _labels_by_stretch(num_images: int, edges: IntArray, seed: int, equal: IntArray) -> IntArray:
    """Label edges by their stretch in a random motion that preserves directions, and ratios of edges `equal` (q, 2)."""
    rng = np.random.default_rng(seed)
    p = rng.standard_normal((num_images, 3))
    d = p[edges[:, 1]] - p[edges[:, 0]]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    P = np.eye(3) - d[:, :, None] * d[:, None, :]
    damping = 1e-9
    pattern = BlockPattern(num_images, edges, 3)
    matrix = pattern.assemble(P, P, -P, np.tile(damping * np.eye(3), (num_images, 1, 1)))
    if len(equal):
        difference = _stretches(num_images, edges, p)
        difference = difference[equal[:, 0]] - difference[equal[:, 1]]
        matrix = sp.csc_array(matrix + difference.T @ difference)
    factor = factorize(matrix)
    x = rng.standard_normal(3 * num_images)
    # Inverse iteration: components outside the null space decrease by damping / eigenvalue each time.
    for _ in range(4):
        x = damping * factor.solve(x)
        x /= np.linalg.norm(x) / np.sqrt(num_images)
    motion = x.reshape(num_images, 3)
    stretch = _stretches(num_images, edges, p) @ motion.ravel()
    order = np.argsort(stretch, kind="stable")
    groups = np.cumsum(np.concatenate([[0], np.diff(stretch[order]) > SAME_STRETCH]))
    labels = np.empty(len(edges), dtype=np.int64)
    labels[order] = groups
    return _split_disconnected(num_images, edges, labels)


def _stretches(num_images: int, edges: IntArray, p: NDArray[np.float64]) -> sp.csr_array:
    """Matrix (m, 3n) that maps motions to stretches ``(p_j - p_i) . (x_j - x_i) / |p_j - p_i|^2``."""
    d = p[edges[:, 1]] - p[edges[:, 0]]
    d /= np.sum(d**2, axis=1, keepdims=True)
    columns = 3 * edges[:, :, None] + np.arange(3)
    values = np.stack([-d, d], axis=1)
    offsets = np.arange(0, 6 * len(edges) + 1, 6)
    return sp.csr_array((values.ravel(), columns.ravel(), offsets), shape=(len(edges), 3 * num_images))


def _split_disconnected(num_images: int, edges: IntArray, labels: IntArray) -> IntArray:
    """Split groups of edges with equal stretch into connected components."""
    count = int(labels.max()) + 1
    nodes = labels[:, None] * num_images + edges
    unique, rows = np.unique(nodes, return_inverse=True)
    if count == 1 and len(unique) <= num_images:
        component = components_by_size(num_images, edges)
        return component[edges[:, 0]]
    component = components_by_size(len(unique), rows.reshape(-1, 2).astype(np.int64))
    return np.asarray(component[rows.reshape(-1, 2)[:, 0]])


def _numbered_by_images(num_images: int, edges: IntArray, labels: IntArray) -> IntArray:
    """Relabel components by decreasing number of images; ties by the first edge."""
    used = np.unique(np.concatenate([labels * num_images + edges[:, 0], labels * num_images + edges[:, 1]]))
    names, first, compact = np.unique(labels, return_index=True, return_inverse=True)
    sizes = np.bincount(np.searchsorted(names, used // num_images), minlength=len(names))
    order = np.lexsort((first, -sizes))
    rank = np.empty(len(names), dtype=np.int64)
    rank[order] = np.arange(len(names))
    return np.asarray(rank[compact])
