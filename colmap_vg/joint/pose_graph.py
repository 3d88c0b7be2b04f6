"""PS: pose-graph optimisation on SE(3), rotations and positions in one least-squares problem (eq. PGO).

With ``Q_i`` camera to world (``cam_from_world`` transposed) and ``t_ij`` the measured translation from camera i to
camera j in camera i's frame::

    min  sum kappa_ij ||R_ij - Q_j^T Q_i||_F^2 + tau_ij ||Q_i t_ij - (p_j - p_i)||^2

Levenberg-damped Newton steps ``Q <- exp(w) Q, p <- p + x`` with the exact Hessian of the chordal term (while it is
definite) and the Gauss-Newton one of the translations; steps that raise the cost are refused.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.linear.assembly import BlockPattern, sum_at_nodes
from colmap_vg.linear.solvers import factorize
from colmap_vg.positions.result import check_connected, unit_weights
from colmap_vg.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

MIN_TRACE = 1.5
"""Below this trace (about 75 degrees) the chordal Hessian loses definiteness and the Gauss-Newton one stands in."""


@dataclass(frozen=True, eq=False)
class PoseGraphResult:
    """Poses of a pose graph.

    Attributes
    ----------
    cam_from_world_rotations : (n, 3, 3) array
    projection_centers : (n, 3) array
    cost : float
    gradient : float
        Largest entry of the cost's gradient, relative to the largest diagonal entry of its Hessian.
    num_iterations : int
    converged : bool
    log : tuple of LogEntry
    """

    cam_from_world_rotations: Array
    projection_centers: Array
    cost: float
    gradient: float
    num_iterations: int
    converged: bool
    log: tuple[LogEntry, ...]


class PoseGraphProblem:
    """A pose graph with its sparsity pattern, to be solved for changing translations and weights.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array

    Raises
    ------
    GraphError
        The graph is not connected.
    """

    def __init__(self, num_images: int, edges: IntArray, cam2_from_cam1_rotations: Array) -> None:
        check_connected(num_images, edges)
        self.num_images, self.edges, self.relative = num_images, edges, cam2_from_cam1_rotations
        self._pattern = BlockPattern(num_images, edges, 6)

    def cost(self, Q: Array, p: Array, t: Array, kappa: Array, tau: Array) -> float:
        """The objective at camera-to-world rotations Q (n, 3, 3) and centres p (n, 3)."""
        i, j = self.edges[:, 0], self.edges[:, 1]
        chordal = self.relative - np.swapaxes(Q[j], 1, 2) @ Q[i]
        residual = np.einsum("kab,kb->ka", Q[i], t) - (p[j] - p[i])
        return float(np.sum(kappa * np.sum(chordal**2, axis=(1, 2))) + np.sum(tau * np.sum(residual**2, axis=1)))

    def gradient(self, Q: Array, p: Array, t: Array, kappa: Array, tau: Array) -> Array:
        """Gradient (n, 6) for ``Q <- exp(w) Q`` (first three) and p (last three)."""
        _, s, residual, turn = self._terms(Q, p, t)
        return self._gradient(s, residual, turn, kappa, tau)

    def solve(
        self,
        Q: Array,
        p: Array,
        t: Array,
        kappa: Array,
        tau: Array,
        *,
        max_num_iterations: int = 100,
        tolerance: float = 1e-12,
    ) -> tuple[Array, Array, PoseGraphResult]:
        """Minimise from (Q, p); returns camera-to-world rotations, centres, and the result."""
        cost = self.cost(Q, p, t, kappa, tau)
        damping, log, converged, size = 1e-10, [], False, np.inf
        for iteration in range(max_num_iterations):
            M, s, residual, turn = self._terms(Q, p, t)
            gradient = self._gradient(s, residual, turn, kappa, tau)
            ii, jj, ij = self._hessian(M, s, kappa, tau)
            diagonal = sum_at_nodes(self.num_images, self.edges[:, 0], np.einsum("kaa->ka", ii)) + sum_at_nodes(
                self.num_images, self.edges[:, 1], np.einsum("kaa->ka", jj)
            )
            size = float(np.abs(gradient / diagonal.max(axis=0)).max() / _scale(p))
            log.append(LogEntry("pose_graph", iteration, cost, size))
            if size <= tolerance:
                converged = True
                break
            accepted = False
            while damping < 1e6:
                damped = np.einsum("na,ab->nab", damping * diagonal + 1e-13 * diagonal.max(), np.eye(6))
                step = -factorize(self._pattern.assemble(ii, jj, ij, damped)).solve(gradient.ravel()).reshape(-1, 6)
                Q_new, p_new = so3.exp(step[:, :3]) @ Q, p + step[:, 3:]
                new_cost = self.cost(Q_new, p_new, t, kappa, tau)
                if new_cost < cost:
                    accepted = True
                    break
                damping *= 100.0
            if not accepted:  # rounding: no step lowers the cost any more
                converged = size <= max(1e4 * tolerance, 1e-7)
                break
            Q, p, cost = Q_new, p_new, new_cost
            damping = max(damping / 100.0, 1e-10)
        Q = so3.project(Q)
        result = PoseGraphResult(np.swapaxes(Q, 1, 2), p, cost, size, len(log), converged, tuple(log))
        return Q, p, result

    def _terms(self, Q: Array, p: Array, t: Array) -> tuple[Array, Array, Array, Array]:
        i, j = self.edges[:, 0], self.edges[:, 1]
        M = Q[j] @ self.relative @ np.swapaxes(Q[i], 1, 2)
        s = np.einsum("kab,kb->ka", Q[i], t)
        return M, s, s - (p[j] - p[i]), so3.vee(M)

    def _gradient(self, s: Array, residual: Array, turn: Array, kappa: Array, tau: Array) -> Array:
        # ||M - exp(u)||^2 with u = w_i - w_j has gradient -4 vee(M); delta (Q_i t) = w_i x s.
        rotation, pull = -4.0 * kappa[:, None] * turn, 2.0 * tau[:, None] * residual
        at_i = np.concatenate([rotation + np.cross(s, pull), pull], axis=1)
        at_j = np.concatenate([-rotation, -pull], axis=1)
        return sum_at_nodes(self.num_images, self.edges[:, 0], at_i) + sum_at_nodes(
            self.num_images, self.edges[:, 1], at_j
        )

    def _hessian(self, M: Array, s: Array, kappa: Array, tau: Array) -> tuple[Array, Array, Array]:
        trace = np.trace(M, axis1=1, axis2=2)
        exact = trace[:, None, None] * np.eye(3) - 0.5 * (M + np.swapaxes(M, 1, 2))
        C = 2.0 * kappa[:, None, None] * np.where(trace[:, None, None] > MIN_TRACE, exact, 2.0 * np.eye(3))
        S, weight = so3.hat(s), 2.0 * tau[:, None, None]
        ii = np.zeros((len(s), 6, 6))
        jj, ij = np.zeros_like(ii), np.zeros_like(ii)
        ii[:, :3, :3] = C + weight * (np.swapaxes(S, 1, 2) @ S)
        ii[:, :3, 3:] = weight * S  # -S^T I = S
        ii[:, 3:, :3] = np.swapaxes(ii[:, :3, 3:], 1, 2)
        ii[:, 3:, 3:] = jj[:, 3:, 3:] = weight * np.eye(3)
        jj[:, :3, :3] = C
        ij[:, :3, :3] = -C
        ij[:, :3, 3:] = -weight * S
        ij[:, 3:, 3:] = -weight * np.eye(3)
        return ii, jj, ij


def _scale(p: Array) -> float:
    """Root mean square distance from the centroid, at least 1 for a collapsed set."""
    spread = float(np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1))))
    return max(spread, 1.0)


def solve_pose_graph(
    num_images: int,
    edges: IntArray,
    cam2_from_cam1_rotations: Array,
    cam2_in_cam1_translations: Array,
    initial_rotations: Array,
    initial_centers: Array,
    rotation_weights: Array | None = None,
    translation_weights: Array | None = None,
    *,
    max_num_iterations: int = 100,
    tolerance: float = 1e-12,
) -> PoseGraphResult:
    """Minimise the pose-graph cost from given poses.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        The graph must be connected.
    cam2_from_cam1_rotations : (m, 3, 3) array
    cam2_in_cam1_translations : (m, 3) array
        Camera 2's centre in camera 1's frame, metric.
    initial_rotations : (n, 3, 3) array
        cam_from_world.
    initial_centers : (n, 3) array
    rotation_weights, translation_weights : (m,) array, optional
        kappa and tau, default 1.
    max_num_iterations : int
    tolerance : float
        On the largest gradient entry relative to the Hessian's largest diagonal entry and the spread of positions.

    Returns
    -------
    PoseGraphResult
        The gauge is the start's, up to rounding.

    Raises
    ------
    GraphError
        The graph is not connected.
    """
    problem = PoseGraphProblem(num_images, edges, cam2_from_cam1_rotations)
    kappa, tau = unit_weights(rotation_weights, len(edges)), unit_weights(translation_weights, len(edges))
    *_, result = problem.solve(
        np.swapaxes(initial_rotations, 1, 2),
        initial_centers,
        cam2_in_cam1_translations,
        kappa,
        tau,
        max_num_iterations=max_num_iterations,
        tolerance=tolerance,
    )
    return result
