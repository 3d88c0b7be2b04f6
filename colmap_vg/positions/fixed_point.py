"""Algorithm 1 of Nasiri et al.: positions by iterated least squares with scale factors from the previous positions.

* **1C**, displacement error: ``lambda = ||p_j - p_i||``, then LS1, ``min_p sum w ||lambda gamma - (p_j - p_i)||^2``.
  Its matrix is one scalar Laplacian, factored once for all iterations and axes.
* **1O**, direction error: ``lambda = 1 / ||p_j - p_i||``, then LS2, ``min_p sum w ||gamma - lambda (p_j - p_i)||^2``
  (eq. Crs3), a Laplacian with weights ``w lambda^2``, factored in each iteration. The weights are bounded, so that
  cameras do not collapse.

After each iteration the centroid is set to 0 and ``sum ||p||^2`` to its initial value; nothing else keeps 1C from
shrinking. Cameras are kept within a distance from the centroid (:func:`farthest_allowed`): one with few, nearly
parallel directions, such as a leaf of a noisy graph, would diverge, and the gauge would collapse the others. If no
camera reaches that distance, the fixed point of 1O satisfies ``sum_j (c d̂ - gamma) / ||d|| = 0``, that of 1C
``sum_j (c d - ||d|| gamma) = 0``, with ``d = p_j - p_i`` and the multiplier c of the gauge. Anderson acceleration
reaches the same fixed point in fewer iterations.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.anderson import fixed_point
from colmap_vg.linear.laplacian import LaplacianSystem
from colmap_vg.positions.result import PositionResult, centered, check_connected, spread, unit_weights
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

MIN_RELATIVE_LENGTH = 1e-8
"""Lower limit of edge lengths as a share of the root mean square distance from the centroid: weights stay finite."""
MIN_WEIGHTED_LENGTH = 0.1
"""Lower limit of edge lengths in the weights of 1O and 2O, as a share of the initial median edge length. Unbounded
weights, one over the squared length, would collapse cameras with inconsistent edges at an increasing rate."""
REACH_QUANTILE, MIN_REACH = 0.95, 1.5
"""Largest distance of cameras from the centroid: this quantile of the initial distances, and at least this multiple of
their root mean square. Cameras that are initially farther away may keep their distance."""


def solve_fixed_point(
    num_images: int,
    edges: IntArray,
    directions_world: Array,
    initial_centers: Array,
    approach: Literal["C", "O"],
    weights: Array | None = None,
    *,
    accelerate: bool = True,
    max_num_iterations: int = 1000,
    tolerance: float = 1e-10,
) -> PositionResult:
    """Solve for positions by Alg. 1C or 1O from initial positions, usually those of CLS.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    directions_world : (m, 3) array
        Unit ``gamma_ij``, world frame.
    initial_centers : (n, 3) array
        Their spread ``sum ||p||^2`` about the centroid is kept.
    approach : "C" or "O"
        Displacement or direction error.
    weights : (m,) array, optional
        Multipliers of the squared residuals, default 1 (the paper).
    accelerate : bool
        Whether to use Anderson acceleration.
    max_num_iterations : int
    tolerance : float
        Relative change of positions in one plain iteration below which the iteration ends.

    Returns
    -------
    PositionResult
        `lambdas` are the final lengths ``||p_j - p_i||``; `cost` is eq. CLET for C, eq. CLE1 for O.

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    check_connected(num_images, edges)
    w = unit_weights(weights, len(edges))
    start = centered(initial_centers)
    size = spread(start)
    shortest, reach = shortest_weighted_length(start, edges), farthest_allowed(start)
    system = LaplacianSystem(num_images, edges)
    fixed_factor = system.factor(w) if approach == "C" else None
    log: list[LogEntry] = []

    def iterate(p: Array) -> Array:
        length = edge_lengths(p, edges, size)
        if fixed_factor is not None:
            new = fixed_factor.solve(system.right_side(w * length, directions_world))
        else:
            weights = w / np.maximum(length, shortest) ** 2
            new = system.factor(weights).solve(system.right_side(weights * length, directions_world))
        return regauged(new, size, reach)

    def note(iteration: int, p: Array, change: float) -> None:
        log.append(LogEntry("1" + approach, iteration, _cost(p, edges, directions_world, w, approach), change))

    p, count, converged = fixed_point(
        iterate,
        start,
        accelerate=accelerate,
        max_num_iterations=max_num_iterations,
        tolerance=tolerance,
        on_iteration=note,
    )
    lengths = np.linalg.norm(p[edges[:, 1]] - p[edges[:, 0]], axis=1)
    return PositionResult(p, lengths, log[-1].cost, count, converged, tuple(log))


def shortest_weighted_length(start: Array, edges: IntArray) -> float:
    """Edge length below which weights no longer increase, from initial positions whose scale the gauge preserves."""
    return MIN_WEIGHTED_LENGTH * float(np.median(np.linalg.norm(start[edges[:, 1]] - start[edges[:, 0]], axis=1)))


def farthest_allowed(start: Array) -> Array:
    """Largest allowed distance of each camera from the centroid, (n,), from initial positions with centroid 0."""
    distance = np.linalg.norm(start, axis=1)
    rms = float(np.sqrt(np.mean(distance**2)))
    return np.asarray(np.maximum(distance, max(float(np.quantile(distance, REACH_QUANTILE)), MIN_REACH * rms)))


def regauged(p: Array, size: float, reach: Array) -> Array:
    """Positions with centroid 0 and spread `size`, after limiting their distances from the centroid to `reach`."""
    p = centered(p)
    p = p * (size / spread(p))
    distance = np.linalg.norm(p, axis=1)
    if (distance <= reach).all():
        return np.asarray(p)
    p = centered(p * np.minimum(1.0, reach / np.maximum(distance, np.finfo(float).tiny))[:, None])
    return np.asarray(p * (size / spread(p)))


def edge_lengths(p: Array, edges: IntArray, size: float) -> Array:
    """Edge lengths (m,), bounded below by a small share of the root mean square distance from the centroid."""
    shortest = MIN_RELATIVE_LENGTH * size / np.sqrt(len(p))
    return np.asarray(np.maximum(np.linalg.norm(p[edges[:, 1]] - p[edges[:, 0]], axis=1), shortest))


def _cost(p: Array, edges: IntArray, directions: Array, w: Array, approach: str) -> float:
    d = p[edges[:, 1]] - p[edges[:, 0]]
    length = np.linalg.norm(d, axis=1)
    residual = length[:, None] * directions - d
    squared = np.sum(residual**2, axis=1)
    if approach == "O":
        squared = squared / np.maximum(length, np.finfo(float).tiny) ** 2
    return float(np.sum(w * squared))
