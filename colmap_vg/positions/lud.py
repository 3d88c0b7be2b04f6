"""Least unsquared deviations (LUD): ``min sum w ||lambda gamma - (p_j - p_i)||`` with ``lambda >= 1``.

Ozyesil & Singer, CVPR 2015. The problem is convex, so a minority of outliers cannot fold the solution. It is solved by
iteratively reweighted CLS with warm starts.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.positions.cls import solve_cls
from colmap_vg.positions.result import PositionResult, spread, unit_weights
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

RESIDUAL_FLOOR = 1e-3
"""Lower limit of residuals in the weights, in the unit of the least lambda, 1."""
ROUGH_TOLERANCE, FINAL_TOLERANCE = 1e-6, 1e-12
"""Tolerance of CLS while the weights change, and in the last reweighting iterations, where exact data are solved to
rounding."""


def solve_lud(
    num_images: int,
    edges: IntArray,
    directions_world: Array,
    weights: Array | None = None,
    *,
    max_num_iterations: int = 100,
    max_inner_iterations: int = 100,
    tolerance: float = 1e-6,
) -> PositionResult:
    """Solve for positions that minimise the unsquared displacement error.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        The graph must be connected.
    directions_world : (m, 3) array
        Unit ``gamma_ij``, world frame.
    weights : (m,) array, optional
        Multipliers of the (unsquared) residuals, default 1.
    max_num_iterations : int
        Maximum number of reweighting iterations.
    max_inner_iterations : int
        Maximum number of Newton steps of each CLS problem.
    tolerance : float
        Relative change of positions below which the iteration ends.

    Returns
    -------
    PositionResult

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    w = unit_weights(weights, len(edges))
    i, j = edges[:, 0], edges[:, 1]
    log: list[LogEntry] = []
    p: Array | None = None
    reweighted, converged, inner_tolerance = w, False, ROUGH_TOLERANCE
    for iteration in range(max_num_iterations):
        result = solve_cls(
            num_images,
            edges,
            directions_world,
            reweighted,
            initial_centers=p,
            max_num_iterations=max_inner_iterations,
            tolerance=inner_tolerance,
        )
        new = result.projection_centers
        change = np.inf if p is None else float(np.linalg.norm(new - p)) / spread(new)
        p = new
        residual = np.linalg.norm(p[j] - p[i] - result.lambdas[:, None] * directions_world, axis=1)
        log.append(LogEntry("lud", iteration, float(np.sum(w * residual)), change))
        if change <= tolerance and inner_tolerance == FINAL_TOLERANCE:
            converged = True
            break
        if change <= tolerance:
            inner_tolerance = FINAL_TOLERANCE
        reweighted = w / np.maximum(residual, RESIDUAL_FLOOR)
    return PositionResult(result.projection_centers, result.lambdas, log[-1].cost, len(log), converged, tuple(log))
