"""Cross: ``min sum w ||gamma x (p_j - p_i)||^2 / ||p_j - p_i||^2``, by iteratively reweighted least squares.

Govindu, CVPR 2001. Each direction asks for ``gamma x (p_j - p_i) = 0``, linear in the positions, so that least squares
with ``sum ||p||^2 = 1`` is an eigenvector. Its residuals grow with the length of an edge; the weights
``1 / ||p_j - p_i||^2`` of the last positions turn them into sines of angles. Nothing guarantees that this converges,
and a sine does not tell a direction from its opposite (the fault of the orthogonal metric, Fig. 4 of Nasiri et al.).
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.anderson import fixed_point
from colmap_vg.linear.assembly import BlockPattern
from colmap_vg.linear.solvers import factorize
from colmap_vg.positions.result import PositionResult, check_connected, unit_weights
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

DAMPING = 1e-10
"""Share of the mean diagonal added before factoring: the matrix is singular along translations."""
MIN_RELATIVE_LENGTH = 1e-3
"""Edges shorter than this share of the median count as this long, so that no weight swamps the rest."""
NUM_VECTORS = 4
"""Vectors iterated together: the error shrinks by the ratio of the first eigenvalue to the fifth."""
MAX_SOLVES = 50
EIGENVECTOR_TOLERANCE = 1e-11
ROUNDING_BELOW = 1e-7
"""Changes below this that no longer halve are rounding: very unequal weights leave no more digits."""


def solve_cross(
    num_images: int,
    edges: IntArray,
    directions_world: Array,
    weights: Array | None = None,
    *,
    max_num_iterations: int = 100,
    tolerance: float = 1e-8,
) -> PositionResult:
    """Positions whose differences are as parallel to the directions as possible.

    Parameters
    ----------
    num_images : int
        n.
    edges : (m, 2) int array
        The graph must be connected.
    directions_world : (m, 3) array
        Unit ``gamma_ij`` from image i towards image j, world frame.
    weights : (m,) array, optional
        Multipliers of the squared residuals, default 1.
    max_num_iterations : int
        Reweightings.
    tolerance : float
        On the relative change of positions.

    Returns
    -------
    PositionResult
        ``sum ||p||^2 = 1``; the sign is that by which most of the weight of edges points forward. `lambdas` are the
        lengths ``||p_j - p_i||``. Where the reweighting does not converge, the positions of least cost on its way.

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    check_connected(num_images, edges)
    w, gamma = unit_weights(weights, len(edges)), directions_world
    i, j = edges[:, 0], edges[:, 1]
    smallest = _SmallestVector(num_images, edges)
    normal = w[:, None, None] * (np.eye(3) - gamma[:, :, None] * gamma[:, None, :])
    log: list[LogEntry] = []

    def least_squares(edge_weights: Array) -> Array:
        p = smallest.find(edge_weights[:, None, None] * normal)
        ahead = float(np.sum(w * np.sign(np.einsum("ka,ka->k", gamma, p[j] - p[i]))))
        return -p if ahead < 0 else p

    def reweight(p: Array) -> Array:
        length = np.linalg.norm(p[j] - p[i], axis=1)
        return least_squares(1.0 / np.maximum(length, MIN_RELATIVE_LENGTH * np.median(length)) ** 2)

    start = least_squares(np.ones(len(edges)))
    best = [(sine_cost(start, edges, gamma, w), start)]

    def note(iteration: int, p: Array, change: float) -> None:
        log.append(LogEntry("cross", iteration, sine_cost(p, edges, gamma, w), change))
        if log[-1].cost < best[0][0]:
            best[0] = (log[-1].cost, p)

    p, count, converged = fixed_point(
        reweight,
        start,
        accelerate=False,
        max_num_iterations=max_num_iterations,
        tolerance=tolerance,
        on_iteration=note,
    )
    cost = log[-1].cost
    if not converged:
        cost, p = best[0]
    return PositionResult(p, np.linalg.norm(p[j] - p[i], axis=1), cost, count, converged, tuple(log))


def sine_cost(p: Array, edges: IntArray, directions: Array, w: Array) -> float:
    """``sum w ||gamma x d̂||^2``, eq. CLE1 with the orthogonal metric; an edge of no length costs all of its weight."""
    d = p[edges[:, 1]] - p[edges[:, 0]]
    squared = np.einsum("ka,ka->k", d, d)
    crossed = np.sum(np.cross(directions, d) ** 2, axis=1)
    return float(np.sum(w * np.where(squared > 0, crossed / np.where(squared > 0, squared, 1.0), 1.0)))


class _SmallestVector:
    """Centred unit vectors (n, 3) of least ``sum (p_j - p_i)^T H (p_j - p_i)``, each search begun from the last.

    Inverse iteration on a few vectors at once, with Rayleigh-Ritz: between reweightings the vectors change little, so
    that a few solves do. The matrix and its inverse keep centred vectors centred, so translations never enter.
    """

    def __init__(self, num_images: int, edges: IntArray) -> None:
        self._n, self._pattern = num_images, BlockPattern(num_images, edges, 3)
        self._vectors = self._centered(np.random.default_rng(0).standard_normal((3 * num_images, NUM_VECTORS)))

    def find(self, H: Array) -> Array:
        matrix = self._pattern.assemble(H, H, -H)
        damping = DAMPING * float(matrix.diagonal().mean()) * np.tile(np.eye(3), (self._n, 1, 1))
        factor = factorize(self._pattern.assemble(H, H, -H, damping))
        V = np.linalg.qr(self._vectors)[0]
        best, change = V[:, 0], np.inf
        for _ in range(MAX_SOLVES):
            V = np.linalg.qr(self._centered(factor.solve(V)))[0]
            _, turn = np.linalg.eigh(V.T @ (matrix @ V))
            V = self._centered(V @ turn)
            last, best = best, V[:, 0]
            last_change, change = change, float(min(np.linalg.norm(best - last), np.linalg.norm(best + last)))
            if change <= EIGENVECTOR_TOLERANCE or ROUNDING_BELOW > change > 0.5 * last_change:
                break
        self._vectors = V
        return np.asarray(best.reshape(self._n, 3) / np.linalg.norm(best))

    def _centered(self, vectors: Array) -> Array:
        shaped = vectors.reshape(self._n, 3, -1)
        return np.asarray((shaped - shaped.mean(axis=0)).reshape(3 * self._n, -1))
