"""BATA, robust angle-based translation averaging: ``min sum w rho(||s (p_j - p_i) - gamma||^2)``, ``s >= 0``.

Zhuang, Cheong & Lee, "Baseline Desensitizing in Translation Averaging", CVPR 2018, in their bilinear form. The scale s
of each edge is its inverse length, so that long baselines have no more weight than short ones. With the optimal
``s = max(gamma . d, 0) / ||d||²``, ``d = p_j - p_i``, the residual is the sine of the angle up to 90 degrees and 1
beyond. Rounds update the weights of rho, and inner iterations alternate between s and positions, both in closed form.
The gauge is ``sum p = 0`` and ``sum gamma . (p_j - p_i) = m``.

As published, the iteration ends after ten rounds. It should: angles do not tell how far away a camera is whose edges
contradict each other, and on graphs of photo collections the minimum has some at infinity, towards which a hundred
rounds move them. Initial positions are those of LUD; the published ones, from the objective of ShapeFit, collapse on
such graphs.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.anderson import fixed_point
from colmap_vg.linear.laplacian import LaplacianSystem
from colmap_vg.linear.robust_losses import cauchy_loss, cauchy_weight
from colmap_vg.positions.lud import solve_lud
from colmap_vg.positions.result import PositionResult, centered, check_connected, spread, unit_weights
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

ROBUST_SCALE = 0.1
"""Scale of the Cauchy loss, a sine: 5.7 degrees; the paper's threshold."""
NUM_ROUNDS, NUM_INNER = 10, 10
"""Rounds as published, and inner iterations of each."""
MIN_RELATIVE_LENGTH = 1e-8
"""Lower limit of edge lengths as a share of the root mean square distance from the centroid: s stays finite."""


def solve_bata(
    num_images: int,
    edges: IntArray,
    directions_world: Array,
    weights: Array | None = None,
    *,
    initial_centers: Array | None = None,
    max_num_iterations: int = NUM_ROUNDS,
    tolerance: float = 1e-8,
) -> PositionResult:
    """Solve for positions that minimise robust angular residuals.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        The graph must be connected.
    directions_world : (m, 3) array
        Unit ``gamma_ij``, world frame.
    weights : (m,) array, optional
        Multipliers of the robust losses, default 1.
    initial_centers : (n, 3) array, optional
        Initial positions, default those of LUD.
    max_num_iterations : int
        Maximum number of rounds, default the paper's.
    tolerance : float
        Relative change of positions in a round below which the iteration ends.

    Returns
    -------
    PositionResult
        `lambdas` are the lengths ``1 / s``, infinite for edges that point backwards. It counts as converged after the
        paper's number of rounds.

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    check_connected(num_images, edges)
    w, gamma = unit_weights(weights, len(edges)), directions_world
    if initial_centers is None:
        initial_centers = solve_lud(num_images, edges, gamma, w).projection_centers
    problem = _Bata(num_images, edges, gamma)
    log: list[LogEntry] = []

    def outer(p: Array) -> Array:
        robust = w * cauchy_weight((problem.residuals(p, problem.scales(p)) / ROBUST_SCALE) ** 2)
        for _ in range(NUM_INNER):
            p = problem.positions(robust, problem.scales(p))
        return p

    def note(iteration: int, p: Array, change: float) -> None:
        squared = (problem.residuals(p, problem.scales(p)) / ROBUST_SCALE) ** 2
        log.append(LogEntry("bata", iteration, ROBUST_SCALE**2 * float(np.sum(w * cauchy_loss(squared))), change))

    p, count, converged = fixed_point(
        outer,
        problem.gauged(initial_centers),
        accelerate=False,
        max_num_iterations=max_num_iterations,
        tolerance=tolerance,
        on_iteration=note,
    )
    scales = problem.scales(p)
    lambdas = np.where(scales > 0, 1.0 / np.where(scales > 0, scales, 1.0), np.inf)
    return PositionResult(p, lambdas, log[-1].cost, count, converged or count >= NUM_ROUNDS, tuple(log))


class _Bata:
    """Closed-form updates of scales and positions."""

    def __init__(self, num_images: int, edges: IntArray, directions: Array) -> None:
        self._i, self._j, self._gamma = edges[:, 0], edges[:, 1], directions
        self._system = LaplacianSystem(num_images, edges)

    def gauged(self, p: Array) -> Array:
        """Positions with centroid 0 and mean length 1 along the directions, or RMS length 1 if it is not positive."""
        p = centered(p)
        d = p[self._j] - p[self._i]
        along = float(np.einsum("ka,ka->", self._gamma, d))
        if along <= 0.0:
            along = float(np.sqrt(len(d) * np.sum(d * d)))
        return np.asarray(p * (len(d) / along))

    def scales(self, p: Array) -> Array:
        d = p[self._j] - p[self._i]
        shortest = MIN_RELATIVE_LENGTH * spread(p) / np.sqrt(len(p))
        along = np.maximum(np.einsum("ka,ka->k", self._gamma, d), 0.0)
        return np.asarray(along / np.maximum(np.einsum("ka,ka->k", d, d), shortest**2))

    def residuals(self, p: Array, scales: Array) -> Array:
        return np.asarray(np.linalg.norm(scales[:, None] * (p[self._j] - p[self._i]) - self._gamma, axis=1))

    def positions(self, weights: Array, scales: Array) -> Array:
        """Least-squares positions at fixed s, in the gauge: positions and s have a common free scale."""
        factor = self._system.factor(weights * scales**2)
        return self.gauged(factor.solve(self._system.right_side(weights * scales, self._gamma)))
