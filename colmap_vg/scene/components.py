"""Connected components of a graph, numbered by size."""

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components


def components_by_size(num_nodes: int, edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Connected component of each node, 0 for the largest; ties go to the one with the lowest node.

    Parameters
    ----------
    num_nodes : int
    edges : (m, 2) int array

    Returns
    -------
    (num_nodes,) int64 array
    """
    adjacency = sp.coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(num_nodes, num_nodes))
    count, labels = connected_components(adjacency, directed=False)
    sizes = np.bincount(labels, minlength=count)
    first = np.full(count, num_nodes)
    first[labels[::-1]] = np.arange(num_nodes)[::-1]
    order = np.lexsort((first, -sizes))
    rank = np.empty(count, dtype=np.int64)
    rank[order] = np.arange(count)
    return np.asarray(rank[labels])
