"""Connected components of the images, numbered by size."""

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components


def components_by_size(num_images: int, edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Component of each image, 0 for the largest; ties go to the one with the lowest image row.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array

    Returns
    -------
    (num_images,) int64 array
    """
    adjacency = sp.coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(num_images, num_images))
    count, labels = connected_components(adjacency, directed=False)
    sizes = np.bincount(labels, minlength=count)
    first = np.full(count, num_images)
    first[labels[::-1]] = np.arange(num_images)[::-1]
    order = np.lexsort((first, -sizes))
    rank = np.empty(count, dtype=np.int64)
    rank[order] = np.arange(count)
    return np.asarray(rank[labels])
