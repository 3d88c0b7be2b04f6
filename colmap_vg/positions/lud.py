"""LUD: ``min sum w ||p_j - p_i - lambda gamma||`` over positions and scale factors ``lambda >= 1``.

Least unsquared deviations, Özyeşil & Singer, CVPR 2015. The convex problem is solved to its minimum by primal-dual
Newton steps, in place of the reweighting of the paper, which takes hundreds of iterations on graphs with outliers. With
the best scale factors, ``lambda = max(gamma . (p_j - p_i), 1)``, each term is the distance of ``p_j - p_i`` to a ray.
A lower bound comes from the dual problem, ``max -sum w h(v)`` subject to ``B^T w v = 0``, ``||v|| <= 1``, where
``h(v) = max gamma . v lambda`` over the scale factors.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.solvers import Factor
from colmap_vg.positions.cls import solve_cls
from colmap_vg.positions.result import PositionResult, centered, unit_weights
from colmap_vg.positions.unsquared_distances import UnsquaredDistances

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

START_ITERATIONS = 2
"""Newton steps of CLS for the initial positions."""
FARTHEST = 2.0
"""Largest scale factor that the lower bound allows for, as a multiple of the largest at hand. The problem is convex, so
that a minimum among these, with none at the limit, is the minimum."""


def solve_lud(
    num_images: int,
    edges: IntArray,
    directions_world: Array,
    weights: Array | None = None,
    *,
    max_num_iterations: int = 200,
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
        Maximum number of Newton steps.
    tolerance : float
        Duality gap at convergence, relative to the cost.

    Returns
    -------
    PositionResult
        `change` in the log is the relative duality gap.

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    w = unit_weights(weights, len(edges))
    start = solve_cls(num_images, edges, directions_world, w, max_num_iterations=START_ITERATIONS).projection_centers
    problem = _Lud(num_images, edges, directions_world, w)
    p, converged, log = problem.minimize(start, "lud", max_num_iterations, tolerance)
    return PositionResult(p, problem.scale_factors(p), problem.cost(p), len(log), converged, log)


class _Lud(UnsquaredDistances):
    """Distances to the rays ``lambda gamma``, ``lambda >= 1``."""

    _last: tuple[Array, Factor] | None = None
    """Blocks and factor of the last step's matrix."""

    def scale_factors(self, p: Array) -> Array:
        return np.maximum(self.along(p), 1.0)

    def residual(self, p: Array) -> Array:
        return np.asarray(p[self.j] - p[self.i] - self.scale_factors(p)[:, None] * self.gamma)

    def derivative(self, p: Array) -> Array:
        return np.where((self.along(p) >= 1.0)[:, None, None], self.across, np.eye(3))

    def step(self, H: Array, gradient: Array) -> Array:
        self._last = H, self.factor(H)
        return -self.solve(self._last[1], gradient)

    def restored(self, p: Array) -> Array:
        return centered(p)

    def gap(self, p: Array, v: Array) -> float:
        """Cost minus a dual bound, from v made feasible by the least change and scaled back into the unit balls."""
        if self._last is None:
            return self.cost(p)
        H, factor = self._last
        missing = self.solve(factor, self.at_nodes(self.w[:, None] * v))
        v = (
            v
            - np.einsum("kab,kb->ka", H, missing[self.j] - missing[self.i])
            / np.where(self.w > 0.0, self.w, 1.0)[:, None]
        )
        along = np.einsum("ka,ka->k", self.gamma, v)
        # Rounding along gamma is no force on the scale factor.
        h = along * np.where(along > 0.0, FARTHEST * self.scale_factors(p).max(), 1.0)
        bound = -float(np.sum(self.w * h)) / max(1.0, float(np.linalg.norm(v, axis=1).max()))
        return self.cost(p) - bound
