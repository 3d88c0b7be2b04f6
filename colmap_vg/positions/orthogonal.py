"""Block coordinate descent for the orthogonal metric: ``min sum w ||gamma - lambda (p_j - p_i)||^2`` over p and lambda.

The appendix of Nasiri et al. (eq. Crs3). With ``d = p_j - p_i`` and the optimal ``lambda = gamma . d / ||d||^2``, the
cost of an edge is ``||gamma x d̂||^2``, so the minimum is that of eq. CLE1 with the orthogonal metric, and no constraint
is needed. Two closed-form updates alternate: positions at fixed lambda (a scalar Laplacian with weights
``w lambda^2``), and lambda at fixed positions. The cost never increases. A negative lambda means that the edge points
backwards, which this metric allows.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.anderson import fixed_point
from colmap_vg.linear.laplacian import LaplacianSystem
from colmap_vg.positions.cls import solve_cls
from colmap_vg.positions.cross import sine_cost
from colmap_vg.positions.result import PositionResult, centered, check_connected, spread, unit_weights
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

MIN_RELATIVE_LENGTH = 1e-8
"""Lower limit of edge lengths as a share of the root mean square distance from the centroid: lambda stays finite."""
COST_ROUNDING = 1e-11
"""Relative differences of costs below this are due to rounding."""


def solve_orthogonal(
    num_images: int,
    edges: IntArray,
    directions_world: Array,
    weights: Array | None = None,
    *,
    initial_centers: Array | None = None,
    accelerate: bool = True,
    max_num_iterations: int = 2000,
    tolerance: float = 1e-8,
) -> PositionResult:
    """Solve for positions that minimise the orthogonal distance of directions, by coordinate descent.

    Parameters
    ----------
    num_images : int
        n.
    edges : (m, 2) int array
        The graph must be connected.
    directions_world : (m, 3) array
        Unit ``gamma_ij``, world frame.
    weights : (m,) array, optional
        Multipliers of the squared residuals, default 1.
    initial_centers : (n, 3) array, optional
        Default: those of CLS; the paper does not specify them.
    accelerate : bool
        Whether to use Anderson acceleration; its points are accepted only if they do not increase the cost.
    max_num_iterations : int
    tolerance : float
        Relative change of positions in one plain iteration below which the iteration ends.

    Returns
    -------
    PositionResult
        `lambdas` are those of eq. Crs3, about ``1 / ||p_j - p_i||``; `cost` is eq. CLE1 with the orthogonal metric. The
        spread is that of the initial positions: the cost does not depend on it.

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    check_connected(num_images, edges)
    w, gamma = unit_weights(weights, len(edges)), directions_world
    if initial_centers is None:
        initial_centers = solve_cls(num_images, edges, gamma, w).projection_centers
    start = centered(initial_centers)
    size = spread(start)
    system = LaplacianSystem(num_images, edges)
    log: list[LogEntry] = []
    last: list[Array] = [start]

    def descend(p: Array) -> Array:
        # If the accelerated point increases the cost, return to the last point of the descent.
        if sine_cost(p, edges, gamma, w) > (1.0 + COST_ROUNDING) * sine_cost(last[0], edges, gamma, w):
            p = last[0]
        scales = best_scales(p, edges, gamma, size)
        new = centered(system.factor(w * scales**2).solve(system.right_side(w * scales, gamma)))
        last[0] = np.asarray(new * (size / spread(new)))
        return last[0]

    def note(iteration: int, p: Array, change: float) -> None:
        log.append(LogEntry("orthogonal", iteration, sine_cost(p, edges, gamma, w), change))

    p, count, converged = fixed_point(
        descend,
        start,
        accelerate=accelerate,
        max_num_iterations=max_num_iterations,
        tolerance=tolerance,
        on_iteration=note,
    )
    return PositionResult(p, best_scales(p, edges, gamma, size), log[-1].cost, count, converged, tuple(log))


def best_scales(p: Array, edges: IntArray, directions: Array, size: float) -> Array:
    """Optimal ``lambda = gamma . d / ||d||^2``, for which ``lambda d`` is closest to gamma: (m,)."""
    d = p[edges[:, 1]] - p[edges[:, 0]]
    shortest = MIN_RELATIVE_LENGTH * size / np.sqrt(len(p))
    return np.asarray(np.einsum("ka,ka->k", directions, d) / np.maximum(np.einsum("ka,ka->k", d, d), shortest**2))
