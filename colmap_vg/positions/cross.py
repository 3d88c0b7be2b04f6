"""Cross: ``min sum w ||gamma x (p_j - p_i)||^2 / ||p_j - p_i||^2``, by iteratively reweighted least squares.

Govindu, CVPR 2001. Each direction gives an equation ``gamma x (p_j - p_i) = 0``, linear in the positions, so that the
least-squares solution with ``sum ||p||^2 = 1`` is an eigenvector. Residuals are proportional to the edge lengths;
weights ``1 / ||p_j - p_i||^2`` from the previous positions turn them into sines of angles. Convergence is not
guaranteed, and a sine does not distinguish opposite directions (the fault of the orthogonal metric, Fig. 4 of Nasiri et
al.).
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.assembly import BlockPattern
from colmap_vg.linear.solvers import factorize
from colmap_vg.positions.result import PositionResult, check_connected, unit_weights
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

PATIENCE = 10
"""Number of reweighting iterations without a lower cost or a smaller change after which the iteration ends."""
DAMPING = 1e-10
"""Share of the mean diagonal added before factorisation, since the matrix is singular along translations."""
MIN_RELATIVE_LENGTH = 1e-3
"""Lower limit of edge lengths in the weights, as a share of the median, so that no weight dominates the others."""
NUM_VECTORS = 4
"""Number of vectors iterated together: the error decreases by the ratio of the first eigenvalue to the fifth."""
MAX_SOLVES = 50
"""Maximum number of inverse iterations."""
EIGENVECTOR_TOLERANCE = 1e-11
"""Change of the unit eigenvector below which the iteration ends."""
ROUNDING_BELOW = 1e-7
"""Changes below this that no longer halve are due to rounding, which very unequal weights amplify."""


def solve_cross(
    num_images: int,
    edges: IntArray,
    directions_world: Array,
    weights: Array | None = None,
    *,
    max_num_iterations: int = 100,
    tolerance: float = 1e-8,
) -> PositionResult:
    """Solve for positions that minimise the squared sines of the angles to the directions.

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
        Maximum number of reweighting iterations.
    tolerance : float
        Relative change of positions below which the iteration ends.

    Returns
    -------
    PositionResult
        ``sum ||p||^2 = 1``; the sign is chosen so that most edge weight points forward. `lambdas` are the lengths
        ``||p_j - p_i||``. Without convergence these are the iterate of least cost.

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    check_connected(num_images, edges)
    w, gamma = unit_weights(weights, len(edges)), directions_world
    i, j = edges[:, 0], edges[:, 1]
    vectors = _SmallestVector(num_images, edges)
    normal = w[:, None, None] * (np.eye(3) - gamma[:, :, None] * gamma[:, None, :])
    log: list[LogEntry] = []

    def least_squares(edge_weights: Array) -> Array:
        p = vectors.find(edge_weights[:, None, None] * normal)
        ahead = float(np.sum(w * np.sign(np.einsum("ka,ka->k", gamma, p[j] - p[i]))))
        return -p if ahead < 0 else p

    def reweight(p: Array) -> Array:
        length = np.linalg.norm(p[j] - p[i], axis=1)
        return least_squares(1.0 / np.maximum(length, MIN_RELATIVE_LENGTH * np.median(length)) ** 2)

    best = p = least_squares(np.ones(len(edges)))
    least, smallest_change, progress_at, converged = sine_cost(p, edges, gamma, w), np.inf, 0, False
    for iteration in range(1, max_num_iterations + 1):
        last, p = p, reweight(p)
        change, cost = float(np.linalg.norm(p - last)), sine_cost(p, edges, gamma, w)
        log.append(LogEntry("cross", iteration, cost, change))
        converged = change <= tolerance
        if cost < least or change < smallest_change:
            smallest_change, progress_at = min(change, smallest_change), iteration
        if cost < least or converged:
            best, least = p, cost
        if converged or iteration >= progress_at + PATIENCE:
            break
    return PositionResult(best, np.linalg.norm(best[j] - best[i], axis=1), least, len(log), converged, tuple(log))


def sine_cost(p: Array, edges: IntArray, directions: Array, w: Array) -> float:
    """``sum w ||gamma x d̂||^2``, eq. CLE1 with the orthogonal metric; an edge of length zero costs its whole weight."""
    d = p[edges[:, 1]] - p[edges[:, 0]]
    squared = np.einsum("ka,ka->k", d, d)
    crossed = np.sum(np.cross(directions, d) ** 2, axis=1)
    return float(np.sum(w * np.where(squared > 0, crossed / np.where(squared > 0, squared, 1.0), 1.0)))


class _SmallestVector:
    """Centred unit vector (n, 3) that minimises ``sum (p_j - p_i)^T H (p_j - p_i)``, warm-started from the last one.

    Inverse iteration on a few vectors at once, with Rayleigh-Ritz: the vectors change little between reweightings, so
    that a few solves suffice. The matrix and its inverse map centred vectors to centred ones, which excludes
    translations.
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
