"""Constrained least squares (CLS): ``min sum w ||lambda gamma - (p_j - p_i)||^2`` with ``lambda >= 1``.

Tron & Vidal's formulation; eq. CLE2 of Nasiri et al. With ``a = gamma . (p_j - p_i)`` the optimal ``lambda`` is
``max(a, 1)``. After substitution the cost is convex, continuously differentiable and piecewise quadratic in the
positions: its Hessian block is ``I - gamma gamma^T`` where ``a >= 1`` and ``I`` where ``a < 1``. A semismooth Newton
method with an exact piecewise line search converges in a few sparse solves; no QP solver is needed.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.assembly import BlockPattern, sum_at_nodes
from colmap_vg.linear.solvers import factorize
from colmap_vg.positions.result import PositionResult, centered, check_connected, unit_weights
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

DAMPING = 1e-9
"""Share of the mean diagonal added to the Hessian; it fixes the translation and non-rigid motions."""


def solve_cls(
    num_images: int,
    edges: IntArray,
    directions_world: Array,
    weights: Array | None = None,
    *,
    initial_centers: Array | None = None,
    max_num_iterations: int = 100,
    tolerance: float = 1e-12,
) -> PositionResult:
    """Solve for positions at the exact minimum of the CLS cost.

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
    initial_centers : (n, 3) array, optional
        Default: the positions of least cost with all ``lambda = 1``.
    max_num_iterations : int
    tolerance : float
        Largest gradient entry at convergence, relative to the largest weighted degree.

    Returns
    -------
    PositionResult
        `lambdas` are ``max(gamma . (p_j - p_i), 1)``: some of them are exactly 1.

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    check_connected(num_images, edges)
    w, gamma = unit_weights(weights, len(edges)), directions_world
    i, j = edges[:, 0], edges[:, 1]
    pattern = BlockPattern(num_images, edges, 3)
    eye, outer = np.eye(3), gamma[:, :, None] * gamma[:, None, :]
    degree = np.bincount(edges.ravel(), weights=np.repeat(w, 2), minlength=num_images)
    damping = DAMPING * degree.mean() * np.tile(eye, (num_images, 1, 1))

    p = _unit_length_start(num_images, edges, gamma, w) if initial_centers is None else centered(initial_centers)
    log: list[LogEntry] = []
    converged = False
    for iteration in range(max_num_iterations):
        d = p[j] - p[i]
        a = np.einsum("ka,ka->k", gamma, d)
        lambdas = np.maximum(a, 1.0)
        residual = d - lambdas[:, None] * gamma
        cost = float(np.sum(w * np.sum(residual**2, axis=1)))
        weighted = w[:, None] * residual
        gradient = sum_at_nodes(num_images, j, weighted) - sum_at_nodes(num_images, i, weighted)
        size = float(np.abs(gradient).max() / degree.max())
        log.append(LogEntry("cls", iteration, cost, size))
        if size <= tolerance:
            converged = True
            break
        H = w[:, None, None] * (eye - np.where(a >= 1.0, 1.0, 0.0)[:, None, None] * outer)
        step = -factorize(pattern.assemble(H, H, -H, damping)).solve(gradient.ravel()).reshape(-1, 3)
        alpha = _exact_step(w, gamma, d, step[j] - step[i])
        if alpha == 0.0:
            converged = size <= 1e3 * tolerance
            break
        p = centered(p + alpha * step)
    return PositionResult(p, lambdas, cost, len(log), converged, tuple(log))


def _unit_length_start(num_images: int, edges: IntArray, gamma: Array, w: Array) -> Array:
    """Least-squares positions with all ``lambda = 1``: one scalar Laplacian for the three axes."""
    pattern = BlockPattern(num_images, edges, 1)
    block = w[:, None, None]
    damping = np.full((num_images, 1, 1), DAMPING * w.sum() / num_images)
    right = sum_at_nodes(num_images, edges[:, 1], w[:, None] * gamma) - sum_at_nodes(
        num_images, edges[:, 0], w[:, None] * gamma
    )
    return centered(factorize(pattern.assemble(block, block, -block, damping)).solve(right))


def _exact_step(w: Array, gamma: Array, d: Array, s: Array) -> float:
    """Step length that exactly minimises the piecewise quadratic cost along a line.

    Along ``d + alpha s`` the slope is ``2 sum w (s . (d + alpha s) - lambda(alpha) gamma . s)``, piecewise linear and
    increasing. Its zero is found by cumulative sums over the breakpoints where ``gamma . (d + alpha s) = 1``.
    """
    a, b = np.einsum("ka,ka->k", gamma, d), np.einsum("ka,ka->k", gamma, s)
    offset, slope = float(np.sum(w * np.einsum("ka,ka->k", d, s))), float(np.sum(w * np.einsum("ka,ka->k", s, s)))
    # lambda gamma . s is (a + alpha b) b where a + alpha b >= 1, and b elsewhere. First at alpha = 0.
    above = (a > 1.0) | ((a == 1.0) & (b >= 0.0))
    offset -= float(np.sum(w * np.where(above, a, 1.0) * b))
    slope -= float(np.sum(w * np.where(above, b, 0.0) * b))
    if offset >= 0.0:
        return 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        at = (1.0 - a) / b
    crosses = np.flatnonzero(np.isfinite(at) & (at > 0.0))
    order = crosses[np.argsort(at[crosses], kind="stable")]
    # On crossing upwards an edge changes from b to (a + alpha b) b, downwards the other way.
    sign = np.where(b[order] > 0, 1.0, -1.0)
    offsets = offset + np.concatenate([[0.0], np.cumsum(-sign * w[order] * (a[order] - 1.0) * b[order])])
    slopes = slope + np.concatenate([[0.0], np.cumsum(-sign * w[order] * b[order] ** 2)])
    ends = np.concatenate([at[order], [np.inf]])
    with np.errstate(divide="ignore", invalid="ignore"):
        reached = np.where(slopes > 0, offsets + ends * slopes, -np.inf)
    piece = int(np.argmax(reached >= 0.0)) if (reached >= 0.0).any() else len(ends) - 1
    return float(-offsets[piece] / slopes[piece]) if slopes[piece] > 0 else 0.0
