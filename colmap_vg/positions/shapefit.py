"""ShapeFit: ``min sum w ||P (p_j - p_i)||``, P perpendicular to gamma; ``sum gamma . (p_j - p_i) = 1``, ``sum p = 0``.

Hand, Lee & Voroninski 2015; Goldstein et al., ECCV 2016. A convex second-order cone program without local minima. It is
solved together with its dual, ``max mu`` subject to ``B^T w v = mu B^T gamma``, ``||v|| <= 1``, v perpendicular to
gamma (B is the incidence matrix). Norms are smoothed, ``s = sqrt(||r||^2 + e^2)``, and Newton's method solves
``s v = r`` in positions and multipliers jointly (Chan, Golub & Mulet, SISC 1999), which converges fast while e
decreases with the duality gap. The relative duality gap is the convergence criterion.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.assembly import BlockPattern, sum_at_nodes
from colmap_vg.linear.solvers import Factor, SingularMatrixError, factorize
from colmap_vg.positions.result import PositionResult, centered, check_connected, unit_weights
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

DAMPING = 1e-12
"""Share of each camera's stiffness added to it: it fixes translations, and the scale if residuals vanish."""
SMOOTHING_SHARE = 0.1
"""Smoothing e of the next step: this share of the duality gap, divided by the weight of edges with zero residual."""
MAX_DECREASE = 0.1
"""Smallest ratio of the smoothing to that of the previous step."""
PATIENCE = 10
"""Number of steps without a smaller gap after which the iteration ends."""
MIN_STEP = 2.0**-10
"""Smallest step length of the line search."""
REFINEMENTS = 2
"""Number of iterations of each linear solve, to reduce rounding errors."""
ROUNDING = 1e-13
"""Costs below this share of the sum of weighted lengths are zero: the directions are consistent."""


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
    p = problem.least_squares()
    v, smoothing = np.zeros_like(directions_world), problem.mean_residual(p)
    log: list[LogEntry] = []
    best, best_cost, best_gap, best_iteration = p, np.inf, np.inf, 0
    for iteration in range(max_num_iterations):
        cost, gap = problem.cost(p), 0.0 if problem.vanishes(p) else problem.gap(p, v)
        log.append(LogEntry("shapefit", iteration, cost, gap / max(cost, np.finfo(float).tiny)))
        if cost < best_cost:
            best, best_cost = p, cost
        if gap < best_gap:
            best_gap, best_iteration = gap, iteration
        # A gap that no longer decreases has reached rounding.
        if best_gap <= tolerance * best_cost or iteration >= best_iteration + PATIENCE:
            break
        wanted = SMOOTHING_SHARE * gap / problem.weight_of_kinks
        smoothing = float(np.clip(wanted, MAX_DECREASE * smoothing, smoothing))
        p, v = problem.improve(p, v, smoothing)
    converged = best_gap <= tolerance * best_cost
    return PositionResult(best, problem.along(best), best_cost, len(log), converged, tuple(log))


class _ShapeFit:
    """Objective, constrained Newton steps on its smoothed form, and dual bound."""

    def __init__(self, num_images: int, edges: IntArray, directions: Array, w: Array) -> None:
        self._n, self._i, self._j = num_images, edges[:, 0], edges[:, 1]
        self._gamma, self._w = directions, w
        self._across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
        self._pattern = BlockPattern(num_images, edges, 3)
        self._constraint = self._at_nodes(directions)
        self._least_squares_factor = self._factor(w[:, None, None] * self._across)
        # At most as many edges as unknowns have zero residual; only these are affected by the smoothing.
        self.weight_of_kinks = float(w.mean()) * min(len(w), 3 * num_images)

    def least_squares(self) -> Array:
        """Positions that minimise the squared residuals under the constraints."""
        H, factor = self._w[:, None, None] * self._across, self._least_squares_factor
        p = self._scaled(self._solve(factor, self._constraint))
        gradient = self._at_nodes(self._w[:, None] * self._residual(p))
        return self._scaled(p + self._constrained_step(H, factor, gradient))

    def cost(self, p: Array) -> float:
        return float(np.sum(self._w * np.linalg.norm(self._residual(p), axis=1)))

    def along(self, p: Array) -> Array:
        return np.asarray(np.einsum("ka,ka->k", self._gamma, p[self._j] - p[self._i]))

    def mean_residual(self, p: Array) -> float:
        return float(np.linalg.norm(self._residual(p), axis=1).mean())

    def vanishes(self, p: Array) -> bool:
        return self.cost(p) <= ROUNDING * float(np.sum(self._w * np.linalg.norm(p[self._j] - p[self._i], axis=1)))

    def gap(self, p: Array, v: Array) -> float:
        """Cost minus a dual bound, from v made feasible by the least change and scaled back into the unit balls."""
        sums = self._at_nodes(self._w[:, None] * v)
        mu = float(np.vdot(sums, p))
        missing = self._solve(self._least_squares_factor, sums - mu * self._constraint)
        feasible = v - self._residual(missing)
        bound = mu / max(1.0, float(np.linalg.norm(feasible, axis=1).max()))
        return self.cost(p) - bound

    def improve(self, p: Array, v: Array, smoothing: float) -> tuple[Array, Array]:
        """Take a Newton step on ``s v = r`` in positions and multipliers."""
        r = self._residual(p)
        s = np.hypot(np.linalg.norm(r, axis=1), smoothing)[:, None]
        gradient = self._at_nodes(self._w[:, None] * r / s)
        mixed = v[:, :, None] * (r / s)[:, None, :]
        H = (self._w[:, None] / s)[:, :, None] * (self._across - 0.5 * (mixed + np.swapaxes(mixed, 1, 2)))
        step = self._constrained_step(H, self._factor(H), gradient)
        moved = self._residual(step)
        turned = (r + moved - 0.5 * (v * self._dot(r, moved) + r * self._dot(v, moved)) / s) / s
        # Rounding errors along gamma, divided by s, would invalidate the bound.
        turned = np.einsum("kab,kb->ka", self._across, turned)
        slope, start = float(np.vdot(step, gradient)), self._smooth_cost(p, smoothing)
        length = 1.0
        while length > MIN_STEP and self._smooth_cost(p + length * step, smoothing) > start + 1e-4 * length * slope:
            length *= 0.5
        return self._scaled(p + length * step), v + _share_inside(v, turned - v) * (turned - v)

    def _smooth_cost(self, p: Array, smoothing: float) -> float:
        return float(np.sum(self._w * np.hypot(np.linalg.norm(self._residual(p), axis=1), smoothing)))

    def _residual(self, p: Array) -> Array:
        return np.asarray(np.einsum("kab,kb->ka", self._across, p[self._j] - p[self._i]))

    @staticmethod
    def _dot(a: Array, b: Array) -> Array:
        return np.asarray(np.einsum("ka,ka->k", a, b)[:, None])

    def _at_nodes(self, flow: Array) -> Array:
        return sum_at_nodes(self._n, self._j, flow) - sum_at_nodes(self._n, self._i, flow)

    def _factor(self, H: Array) -> Factor:
        trace = np.trace(H, axis1=1, axis2=2) / 3.0
        stiffness = np.bincount(self._i, trace, self._n) + np.bincount(self._j, trace, self._n)
        level = DAMPING * stiffness[:, None, None] * np.eye(3)
        while True:
            try:
                return factorize(self._pattern.assemble(H, H, -H, level))
            except SingularMatrixError:  # weights differ by many orders of magnitude: the damping is lost to rounding
                level = 10.0 * level

    @staticmethod
    def _solve(factor: Factor, b: Array) -> Array:
        return centered(factor.solve(b.ravel()).reshape(-1, 3))

    def _constrained_step(self, H: Array, factor: Factor, gradient: Array) -> Array:
        """Step ``-H⁻¹ (gradient - mu g)``, with mu such that it is perpendicular to g, the constraint's gradient."""
        normal = self._solve(factor, self._constraint)
        step, left = np.zeros_like(gradient), -gradient
        # Both parts are long along p, where H is nearly singular, and cancel: a second iteration reduces rounding.
        for _ in range(REFINEMENTS):
            down = self._solve(factor, left)
            mu = np.vdot(self._constraint, step + down) / np.vdot(self._constraint, normal)
            step = step + down - mu * normal
            curved = self._at_nodes(np.einsum("kab,kb->ka", H, step[self._j] - step[self._i]))
            left = -gradient - curved
            left = left - self._constraint * (
                np.vdot(left, self._constraint) / np.vdot(self._constraint, self._constraint)
            )
        return np.asarray(step)

    def _scaled(self, p: Array) -> Array:
        """Positions scaled to satisfy the constraint up to rounding."""
        return centered(p) / float(np.vdot(self._constraint, p))


def _share_inside(v: Array, step: Array) -> float:
    """Largest share of the step, at most 1, that keeps every ``||v|| <= 1``."""
    a, b = np.einsum("ka,ka->k", step, step), np.einsum("ka,ka->k", v, step)
    c = np.minimum(np.einsum("ka,ka->k", v, v) - 1.0, 0.0)
    root = np.sqrt(b * b - a * c)
    # The positive root of a t^2 + 2 b t + c = 0, in the form without cancellation.
    far = np.where(b > 0, -c, root - b)
    below = np.where(b > 0, b + root, a)
    share = float(np.min(np.where(far >= below, 1.0, far / np.where(below > 0, below, 1.0)), initial=1.0))
    return share if share == 1.0 else 0.99 * share  # on the sphere itself the next step would have length zero
