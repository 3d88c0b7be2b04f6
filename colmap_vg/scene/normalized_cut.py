"""Normalized cut of a graph (Shi & Malik, PAMI 2000), by sweeping the Fiedler vector."""

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

DENSE_BELOW = 400
"""Number of nodes below which computing all eigenvectors is faster than computing a few of them."""


def normalized_cut(num_nodes: int, edges: IntArray, weights: Array, min_nodes: int = 1) -> tuple[BoolArray, float]:
    """Split a connected graph in two at the cut of least conductance.

    Parameters
    ----------
    num_nodes : int
        n, at least ``2 min_nodes``.
    edges : (m, 2) int array
    weights : (m,) array
        Positive.
    min_nodes : int
        Minimum number of nodes of either side.

    Returns
    -------
    side : (n,) bool array
        Mask of the smaller side.
    conductance : float
        Total weight of the cut edges over the smaller sum of degrees of the two sides.

    Examples
    --------
    >>> edges = np.array([(0, 1), (1, 2), (0, 2), (2, 3), (3, 4), (4, 5), (3, 5)])
    >>> side, conductance = normalized_cut(6, edges, np.ones(7))
    >>> side.sum(), round(conductance, 3)
    (3, 0.143)
    """
    i, j = edges.T
    degree = np.asarray(np.bincount(i, weights, num_nodes) + np.bincount(j, weights, num_nodes), dtype=np.float64)
    order = np.argsort(_fiedler_vector(num_nodes, edges, weights, degree), kind="stable")
    place = np.empty(num_nodes, dtype=np.int64)
    place[order] = np.arange(num_nodes)
    # The sweep cuts an edge from after its first end to before its second.
    low, high = np.minimum(place[i], place[j]), np.maximum(place[i], place[j])
    starts = np.bincount(low + 1, weights, num_nodes + 1)
    cut = np.cumsum(starts - np.bincount(high + 1, weights, num_nodes + 1))[1:num_nodes]
    volume = np.cumsum(degree[order])[:-1]
    conductance = cut / np.minimum(volume, degree.sum() - volume)
    size = np.arange(1, num_nodes)
    conductance[(size < min_nodes) | (num_nodes - size < min_nodes)] = np.inf
    best = int(np.argmin(conductance))
    first = place <= best
    return (first if 2 * first.sum() <= num_nodes else ~first), float(conductance[best])


def _fiedler_vector(num_nodes: int, edges: IntArray, weights: Array, degree: Array) -> Array:
    """Eigenvector of the second smallest eigenvalue of the normalized Laplacian, over the square roots of degrees."""
    i, j = edges.T
    root = np.sqrt(degree)
    between = weights / (root[i] * root[j])
    A = sp.csr_array(
        (np.concatenate([between, between]), (np.concatenate([i, j]), np.concatenate([j, i]))),
        shape=(num_nodes, num_nodes),
    )
    if num_nodes < DENSE_BELOW:
        return np.asarray(np.linalg.eigh(A.toarray())[1][:, -2] / root)
    # The largest eigenvalue is 1, with the roots as eigenvector. A fixed start makes results reproducible.
    start = np.random.default_rng(0).standard_normal(num_nodes)
    values, vectors = spla.eigsh(A, k=2, which="LA", v0=start, tol=1e-6)
    return np.asarray(vectors[:, int(np.argmin(values))] / root)
