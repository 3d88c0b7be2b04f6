"""1DSfM: outlier directions by their inconsistency with one-dimensional orders of the cameras.

Wilson & Snavely, "Robust Global Translations with 1DSfM" (ECCV 2014). Projected on a line, edge (i, j) determines the
order of its two cameras, with weight |projection|. The order of all cameras that violates the least weight is a minimum
feedback arc set, found greedily: the next camera is one that no remaining camera must precede (a source) or, if there
is none, that of largest ratio (outgoing weight + 1) / (incoming weight + 1). An edge that is violated on many lines is
an outlier.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_vg.errors import GraphError
from colmap_vg.geometry.directions import normalized

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Number = TypeVar("Number", np.float64, np.int64)


def one_dsfm_broken_weights(
    num_images: int,
    edges: ArrayLike,
    directions_world: ArrayLike,
    num_directions: int = 48,
    seed: int = 0,
    weights: ArrayLike | None = None,
) -> Array:
    """Mean weight by which greedy one-dimensional orders violate each edge, over random lines.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    directions_world : (m, 3) array
        Unit vectors in the world from the first to the second image of each edge, ``R_i^T gamma^l_ij`` for
        cam_from_world rotations R.
    num_directions : int
        Number of lines; default 48, as published.
    seed : int
        Random seed of the lines.
    weights : (m,) array, optional
        Weight of each edge in the orders and in the density of lines. Default: all one, as published.

    Returns
    -------
    (m,) array
        Sum of the absolute projections over the lines whose order violates the edge, divided by the number of lines; 0
        to 1. The paper drops edges above 0.1.

    Raises
    ------
    GraphError
        Shapes differ, rows are out of range, directions or weights are not finite, or `num_directions` is below 1.
    """
    edges, directions, w = _checked(num_images, edges, directions_world, weights)
    if num_directions < 1:
        raise GraphError(f"1DSfM needs at least one projection direction, found {num_directions}")
    if len(edges) == 0:
        return np.zeros(0)
    lines = projection_directions(directions, num_directions, np.random.default_rng(seed), w)
    position = order_positions(num_images, edges, directions, lines, w)
    broken = np.zeros(len(edges))
    for k, line in enumerate(lines):  # one line at a time keeps the memory at m, not m times 48
        projection = directions @ line
        forward = position[k, edges[:, 0]] < position[k, edges[:, 1]]
        broken += np.where(forward, np.maximum(-projection, 0.0), np.maximum(projection, 0.0))
    return broken / num_directions


def projection_directions(
    directions: Array, num_directions: int, rng: np.random.Generator, weights: Array | None = None
) -> Array:
    """Sample lines from a kernel density of the edge directions.

    A sample from a Gaussian kernel density is the direction of a random edge plus noise of the kernel. The kernel has
    the covariance of the directions times the square of Scott's factor m^(-1/7) (three dimensions).

    Parameters
    ----------
    directions : (m, 3) array
        Unit vectors, m >= 1.
    num_directions : int
    rng : numpy.random.Generator
    weights : (m,) array, optional

    Returns
    -------
    (num_directions, 3) array
        Unit vectors.
    """
    m = len(directions)
    share = np.full(m, 1.0 / m) if weights is None or weights.sum() == 0 else weights / weights.sum()
    # Lines have no sign, so that an edge and its reverse are equivalent: the kernel is centred.
    covariance = (share[:, None] * directions).T @ directions
    values, vectors = np.linalg.eigh(covariance)
    spread = m ** (-1.0 / 7.0) * np.sqrt(np.maximum(values, 0.0))
    chosen = directions[rng.choice(m, size=num_directions, p=share)]
    noise = (spread * rng.standard_normal((num_directions, 3))) @ vectors.T
    return normalized(chosen + noise)


def order_positions(
    num_images: int, edges: IntArray, directions: Array, lines: Array, weights: Array | None = None
) -> IntArray:
    """Position of each image in the greedy order along each line.

    All lines are processed together, one image each per step. Ties go to the lowest row. The cost is
    O(lines * (m + n^2)) array operations in n Python steps.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    directions : (m, 3) array
    lines : (d, 3) array
    weights : (m,) array, optional
        Multipliers of the absolute projections.

    Returns
    -------
    (d, num_images) int array
    """
    weighted = directions if weights is None else weights[:, None] * directions
    graph = _Arcs(num_images, edges, weighted)
    num_lines = len(lines)
    num_incoming, incoming, outgoing = _initial_degrees(num_images, edges, weighted, lines)
    score = _score(num_incoming, incoming, outgoing)
    position = np.full((num_lines, num_images), -1, dtype=np.int64)
    each_line = np.arange(num_lines)
    num_incoming, positions = num_incoming.reshape(-1), position.reshape(-1)
    incoming, outgoing, scores = incoming.reshape(-1), outgoing.reshape(-1), score.reshape(-1)
    for place in range(num_images):
        chosen = np.argmax(score, axis=1)
        taken = each_line * num_images + chosen
        positions[taken] = place
        scores[taken] = -1.0
        line, neighbor, vector = graph.arcs_of(chosen)
        node = line * num_images + neighbor
        remaining = positions[node] < 0
        node, line, vector = node[remaining], line[remaining], vector[remaining]
        projection = np.einsum("ka,ka->k", vector, lines[line])
        _subtract(num_incoming, node, (projection > 0).astype(np.int64), graph.has_parallel)
        _subtract(incoming, node, np.maximum(projection, 0.0), graph.has_parallel)
        _subtract(outgoing, node, np.maximum(-projection, 0.0), graph.has_parallel)
        scores[node] = _score(num_incoming[node], incoming[node], outgoing[node])
    return position


class _Arcs:
    """Adjacency lists: for each image its neighbours and the vectors to them."""

    def __init__(self, num_images: int, edges: IntArray, vectors: Array) -> None:
        tail = np.concatenate([edges[:, 0], edges[:, 1]])
        head = np.concatenate([edges[:, 1], edges[:, 0]])
        order = np.lexsort((head, tail))
        self._head = head[order]
        self._vectors = np.concatenate([vectors, -vectors])[order]
        self._counts = np.bincount(tail, minlength=num_images)
        self._starts = np.concatenate([[0], np.cumsum(self._counts)[:-1]])
        tail = tail[order]
        self.has_parallel = bool(((tail[1:] == tail[:-1]) & (self._head[1:] == self._head[:-1])).any())

    def arcs_of(self, images: IntArray) -> tuple[IntArray, IntArray, Array]:
        """Outgoing arcs of the given images: row in `images` (k,), neighbour (k,), vector (k, 3)."""
        counts = self._counts[images]
        which = np.repeat(np.arange(len(images)), counts)
        first = np.cumsum(counts) - counts
        rows = np.arange(len(which)) + np.repeat(self._starts[images] - first, counts)
        return which, self._head[rows], self._vectors[rows]


def _initial_degrees(num_images: int, edges: IntArray, vectors: Array, lines: Array) -> tuple[IntArray, Array, Array]:
    """Number of incoming arcs, incoming and outgoing weight of each image on each line, (d, n) each."""
    tail, head = edges[:, 0], edges[:, 1]
    number = np.empty((len(lines), num_images), dtype=np.int64)
    incoming, outgoing = np.empty((2, len(lines), num_images))
    for k, line in enumerate(lines):
        projection = vectors @ line
        ahead, behind = np.maximum(projection, 0.0), np.maximum(-projection, 0.0)
        number[k] = np.bincount(head[ahead > 0], minlength=num_images)
        number[k] += np.bincount(tail[behind > 0], minlength=num_images)
        incoming[k] = np.bincount(head, ahead, num_images) + np.bincount(tail, behind, num_images)
        outgoing[k] = np.bincount(tail, ahead, num_images) + np.bincount(head, behind, num_images)
    return number, incoming, outgoing


def _score(num_incoming: IntArray, incoming: Array, outgoing: Array) -> Array:
    """Greedy score, infinite for sources: nodes with no incoming arcs by count, since weights do not cancel exactly."""
    return np.where(num_incoming == 0, np.inf, (outgoing + 1.0) / (incoming + 1.0))


def _subtract(values: NDArray[Number], rows: IntArray, amounts: NDArray[Number], repeated: bool) -> None:
    """``values[rows] -= amounts``, in place; with repeated rows (parallel edges) the amounts are summed first."""
    if repeated:
        rows, slot = np.unique(rows, return_inverse=True)
        amounts = np.bincount(slot, weights=amounts, minlength=len(rows)).astype(values.dtype)
    values[rows] = values[rows] - amounts


def _checked(
    num_images: int, edges: ArrayLike, directions: ArrayLike, weights: ArrayLike | None
) -> tuple[IntArray, Array, Array | None]:
    edges = np.asarray(edges, dtype=np.int64).reshape(-1, 2)
    directions = np.asarray(directions, dtype=np.float64).reshape(-1, 3)
    w = None if weights is None else np.asarray(weights, dtype=np.float64)
    if len(directions) != len(edges) or (w is not None and w.shape != (len(edges),)):
        raise GraphError(
            f"1DSfM: {len(edges)} edges, but {len(directions)} directions"
            + ("" if w is None else f" and weights of shape {w.shape}")
        )
    if len(edges) and (edges.min() < 0 or edges.max() >= num_images):
        raise GraphError(f"1DSfM: edges have rows {edges.min()} to {edges.max()} of {num_images} images")
    if not np.isfinite(directions).all():
        raise GraphError("1DSfM: directions have NaN or infinite values")
    if w is not None and (not np.isfinite(w).all() or (w < 0).any()):
        raise GraphError("1DSfM: weights must be finite and not negative")
    return edges, directions, w
