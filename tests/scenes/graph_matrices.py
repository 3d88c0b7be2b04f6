"""Matrices of small graphs, from scipy's own sums of duplicate entries."""

import numpy as np
import scipy.sparse as sp


def laplacian(num_nodes: int, edges: np.ndarray, weights: np.ndarray) -> sp.csc_array:
    """Weighted graph Laplacian (n, n): degrees on the diagonal, minus the weights of edges beside it."""
    i, j = edges.T
    rows, columns = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
    values = np.concatenate([weights, weights, -weights, -weights])
    return sp.csc_array((values, (rows, columns)), shape=(num_nodes, num_nodes))
