"""ShapeFit: ``min sum w ||P (p_j - p_i)||``, P perpendicular to gamma; ``sum gamma . (p_j - p_i) = 1``, ``sum p = 0``.

Hand, Lee & Voroninski 2015; Goldstein et al., ECCV 2016. A convex second-order cone program without local minima,
solved by primal-dual Newton steps (:mod:`colmap_vg.positions.unsquared_distances`). Its dual is ``max mu`` subject to
``B^T w v = mu B^T gamma``, ``||v|| <= 1``, v perpendicular to gamma (B is the incidence matrix).

Where the directions of a camera, or of a group that few edges link to the others, are nearly parallel, its distance
costs next to nothing: the minimum then moves it far away, which alone satisfies the scale constraint, and all other
cameras collapse into one point. Graphs of photo collections often have such cameras.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.solvers import Factor
from colmap_vg.positions.result import PositionResult, centered, check_connected, unit_weights
from colmap_vg.positions.unsquared_distances import UnsquaredDistances

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

REFINEMENTS = 2
"""Number of iterations of each linear solve, to reduce rounding errors."""


def solve_shapefit(
    num_images: int,
    edges: IntArray,
    directions_world: Array,
    weights: Array | None = None,
    *,
    max_num_iterations: int = 200,
    tolerance: float = 1e-6,
) -> PositionResult:
    """Solve for positions that minimise the unsquared distance perpendicular to the directions.

    Parameters
    ----------
    num_images : int
        n.
    edges : (m, 2) int array
        The graph must be connected.
    directions_world : (m, 3) array
        Unit ``gamma_ij``, world frame.
    weights : (m,) array, optional
        Multipliers of the (unsquared) residuals, default 1; the constraint stays unweighted.
    max_num_iterations : int
        Maximum number of Newton steps.
    tolerance : float
        Duality gap at convergence, relative to the cost.

    Returns
    -------
    PositionResult
        ``sum gamma . (p_j - p_i) = 1``; `lambdas` are the terms of this sum; `change` in the log is the relative gap.

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    check_connected(num_images, edges)
    problem = _ShapeFit(num_images, edges, directions_world, unit_weights(weights, len(edges)))
    p, converged, log = problem.minimize(problem.least_squares(), "shapefit", max_num_iterations, tolerance)
    return PositionResult(p, problem.along(p), problem.cost(p), len(log), converged, log)


class _ShapeFit(UnsquaredDistances):
    """Distances to the lines along the directions, at a fixed sum of the lengths along them."""

    def __init__(self, num_images: int, edges: IntArray, directions: Array, w: Array) -> None:
        super().__init__(num_images, edges, directions, w)
        self._constraint = self.at_nodes(directions)
        self._least_squares_factor = self.factor(w[:, None, None] * self.across)

    def least_squares(self) -> Array:
        """Positions that minimise the squared residuals under the constraints."""
        H, factor = self.w[:, None, None] * self.across, self._least_squares_factor
        p = self.restored(self.solve(factor, self._constraint))
        gradient = self.at_nodes(self.w[:, None] * self.residual(p))
        return self.restored(p + self._constrained_step(H, factor, gradient))

    def residual(self, p: Array) -> Array:
        return np.asarray(np.einsum("kab,kb->ka", self.across, p[self.j] - p[self.i]))

    def derivative(self, p: Array) -> Array:  # noqa: ARG002 - the residuals are linear
        return self.across

    def gap(self, p: Array, v: Array) -> float:
        """Cost minus a dual bound, from v made feasible by the least change and scaled back into the unit balls."""
        sums = self.at_nodes(self.w[:, None] * v)
        mu = float(np.vdot(sums, p))
        missing = self.solve(self._least_squares_factor, sums - mu * self._constraint)
        feasible = v - self.residual(missing)
        bound = mu / max(1.0, float(np.linalg.norm(feasible, axis=1).max()))
        return self.cost(p) - bound

    def step(self, H: Array, gradient: Array) -> Array:
        return self._constrained_step(H, self.factor(H), gradient)

    def restored(self, p: Array) -> Array:
        """Positions scaled to satisfy the constraint up to rounding."""
        return centered(p) / float(np.vdot(self._constraint, p))

    def _constrained_step(self, H: Array, factor: Factor, gradient: Array) -> Array:
        """Step ``-H⁻¹ (gradient - mu g)``, with mu such that it is perpendicular to g, the constraint's gradient."""
        normal = self.solve(factor, self._constraint)
        step, left = np.zeros_like(gradient), -gradient
        # Both parts are long along p, where H is nearly singular, and cancel: a second iteration reduces rounding.
        for _ in range(REFINEMENTS):
            down = self.solve(factor, left)
            mu = np.vdot(self._constraint, step + down) / np.vdot(self._constraint, normal)
            step = step + down - mu * normal
            curved = self.at_nodes(np.einsum("kab,kb->ka", H, step[self.j] - step[self.i]))
            left = -gradient - curved
            left = left - self._constraint * (
                np.vdot(left, self._constraint) / np.vdot(self._constraint, self._constraint)
            )
        return np.asarray(step)
