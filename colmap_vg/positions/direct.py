"""Direct minimisation of eq. CLE1: ``min sum w d^2(gamma, d̂)`` over positions, d̂ the unit vector of ``p_j - p_i``.

Nasiri et al. approach it by fixed-point iterations (Alg. 1O, and the appendix for the orthogonal metric); the fixed
point of 1O is not exactly its minimum. Here the cost itself is minimised by sparse Levenberg-Marquardt steps, and by
Newton steps near convergence. With ``c = gamma . d̂``, ``q = gamma - c d̂`` and the length l, derivatives by d are:

* chordal, ``||gamma - d̂||² = 2 - 2 c``: gradient ``-2 q / l``, Gauss-Newton Hessian ``2 (I - d̂ d̂ᵀ) / l²``;
* orthogonal, ``||gamma x d̂||² = 1 - c²``: gradient ``-2 c q / l``, Hessian ``2 (I - d̂ d̂ᵀ - q qᵀ) / l²``.

Both are invariant to translation and scale: the centroid is set to 0 and the spread to its initial value. The lowest
cost is not always the best solution: with short, noisy pairs among long ones, collapsing whole groups of cameras can
cost less than the true positions (seen on 606 simulated cameras with 20 degrees of noise on the shortest pairs). Alg. 1
stays closer to CLS.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.assembly import BlockPattern, sum_at_nodes
from colmap_vg.linear.solvers import SingularMatrixError, factorize
from colmap_vg.positions.cls import solve_cls
from colmap_vg.positions.fixed_point import solve_fixed_point
from colmap_vg.positions.result import PositionResult, centered, check_connected, spread, unit_weights
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Metric = Literal["chordal", "orthogonal"]

MIN_DAMPING, INITIAL_DAMPING, MAX_DAMPING = 1e-10, 1.0, 1e8
"""Damping as shares of each camera's mean curvature. A large initial value keeps the iteration in the basin of the
initial positions."""
NEWTON_BELOW = 1e-2
"""Size of the gradient, dimensionless, below which the exact Hessian is tried."""
COST_ROUNDING = 1e-13
"""Cost differences below this share of the total weight are due to rounding; then the gradient decides."""
STALL_STEPS, STALL_SHARE = 10, 1e-8
"""The cost has converged if this number of steps lowers it by at most this share. Outliers can make two cameras
coincide, where the cost has an infimum that it never attains and a gradient that does not vanish."""
START_ITERATIONS, START_TOLERANCE = 100, 1e-3
"""Limits of Alg. 1C, which corrects the reversed and shortened edges of CLS before the minimisation."""


def solve_cle1(
    num_images: int,
    edges: IntArray,
    directions_world: Array,
    weights: Array | None = None,
    *,
    max_num_iterations: int = 200,
    tolerance: float = 1e-9,
) -> PositionResult:
    """Solve for positions that minimise the chordal distance of directions, initialised by CLS and Alg. 1C.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        The graph must be connected.
    directions_world : (m, 3) array
        Unit ``gamma_ij``, world frame.
    weights : (m,) array, optional
        Multipliers of the squared residuals, default 1.
    max_num_iterations, tolerance
        See :func:`minimize_directions`.

    Returns
    -------
    PositionResult

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    start = solve_cls(num_images, edges, directions_world, weights)
    near = solve_fixed_point(
        num_images,
        edges,
        directions_world,
        start.projection_centers,
        "C",
        weights,
        max_num_iterations=START_ITERATIONS,
        tolerance=START_TOLERANCE,
    )
    return minimize_directions(
        num_images,
        edges,
        directions_world,
        near.projection_centers,
        weights,
        max_num_iterations=max_num_iterations,
        tolerance=tolerance,
    )


def minimize_directions(
    num_images: int,
    edges: IntArray,
    directions_world: Array,
    initial_centers: Array,
    weights: Array | None = None,
    *,
    metric: Metric = "chordal",
    max_num_iterations: int = 200,
    tolerance: float = 1e-9,
) -> PositionResult:
    """Find a local minimum of eq. CLE1 from given positions.

    Parameters
    ----------
    num_images : int
        n.
    edges : (m, 2) int array
        The graph must be connected.
    directions_world : (m, 3) array
        Unit ``gamma_ij``, world frame.
    initial_centers : (n, 3) array
        No edge may have length zero; the spread is kept.
    weights : (m,) array, optional
        Multipliers of the squared residuals, default 1.
    metric : "chordal" or "orthogonal"
    max_num_iterations : int
        Maximum number of accepted steps.
    tolerance : float
        Size of the gradient g at convergence, ``sqrt(g^T D^-1 g / sum w)`` with the curvature D of each camera.

    Returns
    -------
    PositionResult
        `lambdas` are the lengths ``||p_j - p_i||``; `change` in the log is the size of the gradient.

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    check_connected(num_images, edges)
    problem = _Directions(num_images, edges, directions_world, unit_weights(weights, len(edges)), metric)
    p = centered(initial_centers)
    size = spread(p)
    cost, damping = problem.cost(p), INITIAL_DAMPING
    at = problem.linearize(p)
    log, stalled = [LogEntry("cle1", 0, cost, at.size)], False
    while at.size > tolerance and len(log) <= max_num_iterations:
        accepted = False
        newton = at.size < NEWTON_BELOW
        while damping <= MAX_DAMPING:
            step = problem.step(at, 0.0 if newton else damping, exact=newton)
            new = p if step is None else centered(p + step)
            new = np.asarray(new * (size / spread(new)))
            new_cost, new_at = problem.cost(new), problem.linearize(new)
            rounding = COST_ROUNDING * problem.total_weight
            accepted = new_cost < cost - rounding or (new_cost <= cost + rounding and new_at.size < 0.5 * at.size)
            if accepted:
                break
            damping, newton = damping if newton else 10.0 * damping, False
        if not accepted:
            break
        damping = max(damping / 10.0, MIN_DAMPING)
        p, cost, at = new, new_cost, new_at
        log.append(LogEntry("cle1", len(log), cost, at.size))
        stalled = len(log) > STALL_STEPS and log[-1 - STALL_STEPS].cost - cost <= STALL_SHARE * cost
        if stalled:
            break
    lengths = np.linalg.norm(p[edges[:, 1]] - p[edges[:, 0]], axis=1)
    return PositionResult(p, lengths, cost, len(log) - 1, stalled or at.size <= 1e2 * tolerance, tuple(log))


@dataclass(frozen=True, eq=False)
class _Linearization:
    """Gradient (n, 3), its size, blocks (m, 3, 3) of the Gauss-Newton and exact Hessian, and mean curvatures (n,)."""

    gradient: Array
    gauss_newton: Array
    exact: Array
    curvature: Array
    size: float


class _Directions:
    """Eq. CLE1 and its derivatives."""

    def __init__(self, num_images: int, edges: IntArray, directions: Array, weights: Array, metric: Metric) -> None:
        self._n, self._i, self._j = num_images, edges[:, 0], edges[:, 1]
        self._gamma, self._w, self._chordal = directions, weights, metric == "chordal"
        self._pattern = BlockPattern(num_images, edges, 3)
        self.total_weight = float(weights.sum())

    def cost(self, p: Array) -> float:
        u, _ = self._unit(p)
        if self._chordal:
            return float(np.sum(self._w * np.sum((self._gamma - u) ** 2, axis=1)))
        return float(np.sum(self._w * np.sum(np.cross(self._gamma, u) ** 2, axis=1)))

    def linearize(self, p: Array) -> _Linearization:
        u, length = self._unit(p)
        c = np.einsum("ka,ka->k", self._gamma, u)[:, None]
        q = self._gamma - c * u
        scale = 2.0 * self._w / length**2
        pull = scale[:, None] * length[:, None] * (-q if self._chordal else -c * q)
        gradient = sum_at_nodes(self._n, self._j, pull) - sum_at_nodes(self._n, self._i, pull)
        gauss_newton, exact = (scale[:, None, None] * block for block in self._blocks(u, c, q))
        trace = np.trace(gauss_newton, axis1=1, axis2=2) / 3.0
        curvature = np.bincount(self._i, trace, self._n) + np.bincount(self._j, trace, self._n)
        curvature = np.maximum(curvature, 1e-12 * curvature.mean() + np.finfo(float).tiny)
        size = np.sqrt(np.sum(np.sum(gradient**2, axis=1) / curvature) / self.total_weight)
        return _Linearization(gradient, gauss_newton, exact, curvature, float(size))

    def step(self, at: _Linearization, damping: float, *, exact: bool) -> Array | None:
        """Newton step if `exact`, else Levenberg-Marquardt step; None if it is not a descent direction."""
        level = (damping + MIN_DAMPING) * at.curvature[:, None, None] * np.eye(3)
        H = at.exact if exact else at.gauss_newton
        try:
            step = -factorize(self._pattern.assemble(H, H, -H, level)).solve(at.gradient.ravel()).reshape(-1, 3)
        except SingularMatrixError:
            return None
        return step if np.vdot(step, at.gradient) < 0.0 else None

    def _unit(self, p: Array) -> tuple[Array, Array]:
        d = p[self._j] - p[self._i]
        length = np.maximum(np.linalg.norm(d, axis=1), np.finfo(float).tiny ** 0.25)
        return d / length[:, None], length

    def _blocks(self, u: Array, c: Array, q: Array) -> tuple[Array, Array]:
        """Half the Gauss-Newton and exact Hessians of each edge's cost by d, times its squared length."""
        across = np.eye(3) - u[:, :, None] * u[:, None, :]
        mixed = q[:, :, None] * u[:, None, :]
        mixed = mixed + np.swapaxes(mixed, 1, 2)
        C = c[:, :, None]
        if self._chordal:
            # -c has gradient -q / l and Hessian (c (I - u u^T) + q u^T + u q^T) / l^2.
            return across, C * across + mixed
        # -c^2 / 2 has gradient -c q / l; its Hessian has the outer product of the gradient of c in addition.
        outer = q[:, :, None] * q[:, None, :]
        # gamma x u changes by gamma x (I - u u^T) dd / l; the square is across - (across gamma) (across gamma)^T.
        return across - outer, C * C * across + C * mixed - outer
