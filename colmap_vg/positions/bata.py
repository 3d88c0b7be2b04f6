"""BATA: ``min sum w rho(||s (p_j - p_i) - gamma||^2)`` over positions and ``s >= 0``, angle-based and robust.

Zhuang, Cheong & Lee, "Baseline Desensitizing in Translation Averaging", CVPR 2018, in their bilinear form: s, one for
each edge, stands for the inverse of its length, so that long baselines weigh no more than short ones. With the best
``s = max(gamma . d, 0) / ||d||²``, ``d = p_j - p_i``, the residual is the sine of the angle up to 90 degrees and 1
beyond. As published: a few reweightings of the unsquared distance across the directions (their revised LUD, the
objective of ShapeFit) give the start; then outer iterations set the weights of rho at the last positions, and inner
ones alternate between s and positions, both in closed form. The gauge is ``sum p = 0`` and
``sum gamma . (p_j - p_i) = m``.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.anderson import fixed_point
from colmap_vg.linear.robust_losses import cauchy_loss, cauchy_weight
from colmap_vg.positions.fixed_point import LaplacianSystem
from colmap_vg.positions.result import PositionResult, centered, check_connected, spread, unit_weights
from colmap_vg.positions.shapefit import solve_shapefit
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

ROBUST_SCALE = 0.1
"""Of the Cauchy loss, a sine: 5.7 degrees; the paper's threshold."""
START_ITERATIONS = 10
NUM_INNER = 10
MIN_RELATIVE_LENGTH = 1e-8
"""Edges shorter than this share of the spread count as this long: s stays finite."""


def solve_bata(
    num_images: int,
    edges: IntArray,
    directions_world: Array,
    weights: Array | None = None,
    *,
    initial_centers: Array | None = None,
    max_num_iterations: int = 500,
    tolerance: float = 1e-8,
) -> PositionResult:
    """Positions of least robust angular residuals.

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
        In place of the published start.
    max_num_iterations : int
        Outer iterations. The paper stops after 10.
    tolerance : float
        On the relative change of positions that an outer iteration makes.

    Returns
    -------
    PositionResult
        `lambdas` are the lengths ``1 / s``, infinite for edges that point backwards.

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    check_connected(num_images, edges)
    w, gamma = unit_weights(weights, len(edges)), directions_world
    if initial_centers is None:
        initial_centers = solve_shapefit(
            num_images, edges, gamma, w, max_num_iterations=START_ITERATIONS
        ).projection_centers
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
        accelerate=True,
        max_num_iterations=max_num_iterations,
        tolerance=tolerance,
        on_iteration=note,
    )
    scales = problem.scales(p)
    lambdas = np.where(scales > 0, 1.0 / np.where(scales > 0, scales, 1.0), np.inf)
    return PositionResult(p, lambdas, log[-1].cost, count, converged, tuple(log))


class _Bata:
    """The two closed-form steps."""

    def __init__(self, num_images: int, edges: IntArray, directions: Array) -> None:
        self._i, self._j, self._gamma = edges[:, 0], edges[:, 1], directions
        self._system = LaplacianSystem(num_images, edges)

    def gauged(self, p: Array) -> Array:
        """Centroid 0 and mean length along the directions 1; where they contradict, RMS length 1."""
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
        """Least squares at fixed s. Positions and s are free in scale together, so the gauge is set afterwards."""
        factor = self._system.factor(weights * scales**2)
        return self.gauged(factor.solve(self._system.right_side(weights * scales, self._gamma)))
