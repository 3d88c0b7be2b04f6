"""Shortlists of images that may overlap, by vectors that sum up the features of each.

In large folders even first matches of all pairs take too long. Each image is described by a vector of locally
aggregated descriptors (VLAD; Jegou, Douze, Schmid and Perez, CVPR 2010): the sums of the differences between its
descriptors and the nearest of a few words, normalised word by word (Arandjelovic and Zisserman, All about VLAD, CVPR
2013). Images with similar vectors are first matched; the order of a sequence and GPS positions add neighbours.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.assembly import sum_at_nodes
from colmap_vg.linear.threads import single_threaded_blas

MAX_ALL_IMAGES = 150
"""Images, up to which first matches of all pairs take no longer than the matching that follows."""
SIMILAR_IMAGES = 100
"""Images of the shortlist by similarity, for each image."""
SEQUENCE_NEIGHBORS = 4
"""Images of the shortlist before and after each image, by name."""
GPS_NEIGHBORS = 30
"""Images of the shortlist by distance, for each image with a position."""
NUM_WORDS = 64
_TRAINING_DESCRIPTORS = 30_000
"""Descriptors from which the words are learned, evenly from all images."""
_ROUNDS = 12
"""Of k-means; more change no shortlist."""
_DESCRIPTORS_PER_IMAGE = 300
"""The strongest; 150 MB for 1,000 images."""
_DESCRIPTOR_NORM = 512.0

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def shortlisted(descriptors: NDArray[np.uint8], positions: NDArray[np.float64], seed: int) -> BoolArray:
    """Pairs of images that may overlap.

    Parameters
    ----------
    descriptors : (n, h, d) uint8 array
        Of the strongest features of each image, in the natural order of their names; rows of zeros do not count.
    positions : (n, 3) array
        Metres; NaN where unknown.
    seed : int
        Of the words.

    Returns
    -------
    (n, n) bool array
        Symmetric, False on the diagonal; all pairs in folders of up to 150 images.
    """
    n = len(descriptors)
    if n <= MAX_ALL_IMAGES:
        return ~np.eye(n, dtype=bool)
    near = np.zeros((n, n), dtype=bool)
    vectors = aggregated(descriptors, seed)
    similarity = vectors @ vectors.T
    np.fill_diagonal(similarity, -np.inf)
    _mark(near, np.argsort(-similarity, axis=1, kind="stable")[:, :SIMILAR_IMAGES])
    for step in range(1, SEQUENCE_NEIGHBORS + 1):
        near[np.arange(n - step), np.arange(step, n)] = True
    known = np.flatnonzero(np.isfinite(positions).all(axis=1))
    if len(known) > 1:
        neighbors = min(GPS_NEIGHBORS + 1, len(known))
        from scipy.spatial import cKDTree  # takes 0.1 s to import, in vain in small folders

        found = cKDTree(positions[known]).query(positions[known], neighbors)[1]
        near[np.repeat(known, neighbors), known[found].ravel()] = True
    near |= near.T
    np.fill_diagonal(near, False)
    return near


def partners_of_partners(scores: Array, tried: BoolArray, most: int) -> BoolArray:
    """Pairs that were not tried, and that share partners: the `most` best of each image.

    Parameters
    ----------
    scores : (n, n) array
        Of pairs that were tried; symmetric.
    tried : (n, n) bool array
    most : int

    Returns
    -------
    (n, n) bool array
        Symmetric.
    """
    shared = np.where(tried, 0.0, np.round(shared_partners(scores), 9))
    best = np.argsort(-shared, axis=1, kind="stable")[:, :most]
    chosen = np.zeros_like(tried)
    _mark(chosen, best)
    chosen &= shared > 0.0
    return np.asarray(chosen | chosen.T)


def shared_partners(scores: Array) -> Array:
    """Sums (n, n) over third images of the products of both pairs' scores, normalised by the images' total scores."""
    degree = scores.sum(axis=0) + 1.0
    linked = scores / np.sqrt(np.outer(degree, degree))
    shared = linked @ linked
    np.fill_diagonal(shared, 0.0)
    return np.asarray(shared)


@single_threaded_blas
def aggregated(descriptors: NDArray[np.uint8], seed: int) -> NDArray[np.float32]:
    """Vectors (n, words * d) of norm 1 that sum up the descriptors of images; of norm 0 without any."""
    descriptors = descriptors[:, :_DESCRIPTORS_PER_IMAGE]
    present = descriptors.any(axis=2)
    every = descriptors[present].astype(np.float32) / _DESCRIPTOR_NORM
    n, width = len(descriptors), descriptors.shape[2]
    if not len(every):
        return np.zeros((n, NUM_WORDS * width), np.float32)
    sample = every[np.linspace(0, len(every) - 1, min(len(every), _TRAINING_DESCRIPTORS)).astype(np.int64)]
    from scipy.cluster.vq import kmeans2  # as above

    words, _ = kmeans2(sample, min(NUM_WORDS, len(sample)), iter=_ROUNDS, minit="++", rng=np.random.default_rng(seed))
    nearest = np.argmin(np.square(words).sum(axis=1) - 2.0 * every @ words.T, axis=1)
    image = np.repeat(np.arange(n), present.sum(axis=1))
    sums = sum_at_nodes(n * NUM_WORDS, image * NUM_WORDS + nearest, every - words[nearest])
    return _normalized(_normalized(sums).reshape(n, -1)).astype(np.float32)


def _normalized(rows: Array) -> Array:
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), np.finfo(float).tiny))


def _mark(matrix: BoolArray, columns: NDArray[np.int64]) -> None:
    matrix[np.repeat(np.arange(len(matrix)), columns.shape[1]), columns.ravel()] = True
