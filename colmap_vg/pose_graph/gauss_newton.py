"""PS: pose-graph optimisation on SE(3), rotations and positions in one least-squares problem (eq. PGO).

The objectives are in :mod:`colmap_vg.pose_graph.costs`. Steps ``Q <- exp(w) Q, p <- p + x`` are Levenberg-Marquardt
steps on sparse 6 x 6 blocks, and Newton steps near convergence, with the first camera fixed; steps that increase the
cost are rejected. If cost differences are below rounding, the gradient decides, so that the minimum is accurate to
rounding and not to its square root. Newton systems are solved by conjugate gradients, preconditioned by the last
factorisation as long as that converges fast. Alg. 2 solves hundreds of similar problems: near the minimum of the last
one, steps with an old factorisation need gradients alone (:meth:`PoseGraphSolver.solve_nearby`).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.linear.assembly import BlockPattern, sum_at_nodes
from colmap_vg.linear.laplacian import conjugate_gradients
from colmap_vg.linear.solvers import Factor, SingularMatrixError, factorize
from colmap_vg.pose_graph.costs import ChordalCost, EdgeTerms, InformationCost, PoseGraphCost
from colmap_vg.positions.result import check_connected, unit_weights
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

MIN_DAMPING, MAX_DAMPING = 1e-12, 1e6
"""Least and largest damping, as shares of the Hessian's diagonal."""
NEWTON_BELOW = 1e-2
"""Size of the gradient, dimensionless, below which the exact Hessian is tried: Gauss-Newton took 50 to 100 steps to
converge."""
CG_TOLERANCE, MAX_CG_ITERATIONS = 1e-4, 12
"""Relative residual of Newton systems solved with an old factorisation, and number of iterations after which the matrix
is factored again."""
MAX_CHORD_STEPS, MAX_CHORD_RATIO = 20, 0.3
"""Maximum number of steps with an old factorisation, and ratio of successive steps above which it is too old."""
COST_ROUNDING = 1e-12
"""Relative cost differences below this are due to rounding in sums over up to a million edges."""


@dataclass(frozen=True, eq=False)
class PoseGraphResult:
    """Poses that minimise a pose-graph cost, with convergence information.

    Attributes
    ----------
    cam_from_world_rotations : (n, 3, 3) array
    projection_centers : (n, 3) array
        World frame, in the unit of the translations.
    cost : float
    gradient : float
        Largest entry of the cost's gradient over the largest diagonal entry of its Hessian: radians for rotations,
        shares of the positions' RMS distance from the centroid for positions.
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


@dataclass(frozen=True, eq=False)
class _Linearization:
    """Gradient (n, 6) by the poses and its size, derivatives of each edge, and diagonal (n, 6) of the Hessian."""

    gradient: Array
    terms: EdgeTerms
    diagonal: Array
    size: float


class PoseGraphSolver:
    """Solver of pose-graph problems on one graph, whose sparsity pattern is analysed once.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array

    Raises
    ------
    GraphError
        The graph is not connected.
    """

    def __init__(self, num_images: int, edges: IntArray) -> None:
        check_connected(num_images, edges)
        self.num_images, self.edges = num_images, edges
        self._pattern = BlockPattern(num_images, edges, 6)
        self._stale: Factor | None = None

    def gradient(self, cost: PoseGraphCost, Q: Array, p: Array) -> Array:
        """Gradient (n, 6) by w (first three) and x (last three) in ``Q <- exp(w) Q, p <- p + x``."""
        return self._linearize(cost, Q, p).gradient

    def solve(
        self, cost: PoseGraphCost, Q: Array, p: Array, *, max_num_iterations: int = 100, tolerance: float = 1e-12
    ) -> tuple[Array, Array, PoseGraphResult]:
        """Minimise a cost from initial camera-to-world rotations Q (n, 3, 3) and centres p (n, 3).

        Returns
        -------
        Q : (n, 3, 3) array
            Camera to world.
        p : (n, 3) array
        result : PoseGraphResult
        """
        value, at = cost.value(Q, p), self._linearize(cost, Q, p)
        damping, log = MIN_DAMPING, [LogEntry("pose_graph", 0, value, at.size)]
        while at.size > tolerance and len(log) <= max_num_iterations:
            accepted = False
            for trial_damping, step in self._trial_steps(at, damping):
                new_Q, new_p = so3.exp(step[:, :3]) @ Q, p + step[:, 3:]
                new_value = cost.value(new_Q, new_p)
                if not new_value <= value + COST_ROUNDING * value:
                    continue
                new_at = self._linearize(cost, new_Q, new_p)
                accepted = new_value < value - COST_ROUNDING * value or new_at.size < at.size
                damping = max(trial_damping / 100.0, MIN_DAMPING)
                break  # at the level of rounding shorter steps would not help either
            if not accepted:
                break
            Q, p, value, at = new_Q, new_p, new_value, new_at
            log.append(LogEntry("pose_graph", len(log), value, at.size))
        converged = at.size <= max(tolerance, 1e-9)
        Q = so3.project(Q)
        result = PoseGraphResult(np.swapaxes(Q, 1, 2), p, value, at.size, len(log) - 1, converged, tuple(log))
        return Q, p, result

    def solve_nearby(
        self, cost: PoseGraphCost, Q: Array, p: Array, unit: float, tolerance: float
    ) -> tuple[Array, Array] | None:
        """Minimise a cost from poses near the minimum by steps with an old factorisation (chord method).

        Alg. 2 solves hundreds of similar problems. Steps take a tenth of the time of Newton's; the Hessian is factored
        again if they do not converge fast.

        Parameters
        ----------
        cost : PoseGraphCost
        Q : (n, 3, 3) array
            Camera to world.
        p : (n, 3) array
        unit : float
            Length to measure changes of positions by.
        tolerance : float
            Root mean square step of the cameras, radians and units, below which the iteration ends.

        Returns
        -------
        (Q, p) or None
            None if the steps do not converge with a new factorisation either.
        """
        previous, fresh = np.inf, self._stale is None
        scale = np.array([1.0, 1.0, 1.0, unit, unit, unit])
        for _ in range(MAX_CHORD_STEPS):
            factor = self._stale or self._refactored(cost, Q, p)
            if factor is None:
                return None
            step = -factor.solve(self._sum(*cost.gradients(Q, p)).ravel()).reshape(-1, 6)
            size = float(np.sqrt(np.mean(np.sum((step / scale) ** 2, axis=1))))
            if size > MAX_CHORD_RATIO * previous:
                if fresh:
                    return None
                self._stale, fresh, previous = None, True, np.inf
                continue
            Q, p, previous = so3.exp(step[:, :3]) @ Q, p + step[:, 3:], size
            if size <= tolerance:
                return Q, p
        return None

    def _refactored(self, cost: PoseGraphCost, Q: Array, p: Array) -> Factor | None:
        """Factor the exact Hessian at given poses, Gauss-Newton's if the cost has no other; None if not definite."""
        at, self._stale = self._linearize(cost, Q, p), None
        if at.terms.curvature_ii is not None:
            self._newton_step(at)
            return self._stale
        try:
            self._stale = factorize(self._matrix(at, at.terms.ii, at.terms.jj, at.terms.ij, MIN_DAMPING))
        except SingularMatrixError:
            return None
        return self._stale

    def _sum(self, gradient_i: Array, gradient_j: Array) -> Array:
        """Gradient (n, 6) by the poses from those of the edges."""
        n, i, j = self.num_images, self.edges[:, 0], self.edges[:, 1]
        return np.asarray(sum_at_nodes(n, i, gradient_i) + sum_at_nodes(n, j, gradient_j))

    def _linearize(self, cost: PoseGraphCost, Q: Array, p: Array) -> _Linearization:
        terms = cost.derivatives(Q, p)
        n, i, j = self.num_images, self.edges[:, 0], self.edges[:, 1]
        gradient = self._sum(terms.gradient_i, terms.gradient_j)
        diagonal = sum_at_nodes(n, i, np.einsum("kaa->ka", terms.ii)) + sum_at_nodes(
            n, j, np.einsum("kaa->ka", terms.jj)
        )
        rms = float(np.linalg.norm(p - p.mean(axis=0)) / np.sqrt(n))
        tiny = np.finfo(float).tiny
        turn = np.abs(gradient[:, :3]).max() / max(diagonal[:, :3].max(), tiny)
        shift = np.abs(gradient[:, 3:]).max() / max(diagonal[:, 3:].max() * rms, tiny)
        return _Linearization(gradient, terms, diagonal, float(max(turn, shift)))

    def _trial_steps(self, at: _Linearization, damping: float) -> Iterator[tuple[float, Array]]:
        """Yield trial steps (n, 6): a Newton step near convergence, then Levenberg steps with increasing damping."""
        terms = at.terms
        if at.size < NEWTON_BELOW and terms.curvature_ii is not None:
            step = self._newton_step(at)
            if step is not None and np.vdot(step, at.gradient) < 0.0:
                yield damping, step
            self._stale = None  # rejected: the factored matrix may have been indefinite
        while damping <= MAX_DAMPING:
            step = self._damped_step(at, damping)
            if step is not None:
                yield damping, step
            damping *= 100.0

    def _newton_step(self, at: _Linearization) -> Array | None:
        """Newton step with the exact Hessian; None if it is not positive definite."""
        terms = at.terms
        if terms.curvature_ii is None or terms.curvature_jj is None or terms.curvature_ij is None:
            return None
        ii, jj, ij = terms.ii.copy(), terms.jj.copy(), terms.ij.copy()
        ii[:, :3, :3] += terms.curvature_ii
        jj[:, :3, :3] += terms.curvature_jj
        ij[:, :3, :3] += terms.curvature_ij
        matrix = self._matrix(at, ii, jj, ij, MIN_DAMPING)
        right = -at.gradient.ravel()
        step = None
        if self._stale is not None:
            step = conjugate_gradients(matrix, right, self._stale, CG_TOLERANCE, MAX_CG_ITERATIONS)
        if step is None:
            self._stale = None  # frees the old factorisation before the new one is computed
            try:
                self._stale = factorize(matrix)
            except SingularMatrixError:
                return None
            step = self._stale.solve(right)
        return step.reshape(-1, 6)

    def _damped_step(self, at: _Linearization, damping: float) -> Array | None:
        try:
            factor = factorize(self._matrix(at, at.terms.ii, at.terms.jj, at.terms.ij, damping))
        except SingularMatrixError:
            return None
        return -factor.solve(at.gradient.ravel()).reshape(-1, 6)

    def _matrix(self, at: _Linearization, ii: Array, jj: Array, ij: Array, damping: float) -> sp.csc_array:
        level = damping * at.diagonal + MIN_DAMPING * at.diagonal.max(axis=0)
        # The gauge leaves six degrees of freedom; extra stiffness at one camera fixes them without affecting the shape.
        level[0] += at.diagonal[0] + at.diagonal.mean(axis=0)
        return self._pattern.assemble(ii, jj, ij, level[:, :, None] * np.eye(6))


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
    information: Array | None = None,
    max_num_iterations: int = 100,
    tolerance: float = 1e-12,
) -> PoseGraphResult:
    """Minimise a pose-graph cost from given poses.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        The graph must be connected.
    cam2_from_cam1_rotations : (m, 3, 3) array
    cam2_in_cam1_translations : (m, 3) array
        Camera 2's centre in camera 1's frame, of known length.
    initial_rotations : (n, 3, 3) array
        cam_from_world rotations.
    initial_centers : (n, 3) array
        Projection centres, world frame.
    rotation_weights, translation_weights : (m,) array, optional
        kappa and tau of :class:`~colmap_vg.pose_graph.costs.ChordalCost`, default 1.
    information : (m, 6, 6) array, optional
        Information matrix of rotation vector (camera 2's frame) and translation (camera 1's frame), in this order. The
        cost is then :class:`~colmap_vg.pose_graph.costs.InformationCost`, and the two weights multiply its two blocks.
    max_num_iterations : int
    tolerance : float
        Value of :attr:`PoseGraphResult.gradient` at which the iteration ends.

    Returns
    -------
    PoseGraphResult
        The first camera keeps its pose, up to the effect of damping.

    Raises
    ------
    GraphError
        The graph is not connected, or `information` has another shape.
    """
    solver = PoseGraphSolver(num_images, edges)
    m, R, t = len(edges), cam2_from_cam1_rotations, cam2_in_cam1_translations
    kappa, tau = unit_weights(rotation_weights, m), unit_weights(translation_weights, m)
    cost: PoseGraphCost = ChordalCost(edges, R, t, kappa, tau)
    if information is not None:
        if information.shape != (m, 6, 6):
            raise GraphError(f"pose graph: information must have shape ({m}, 6, 6), found {information.shape}")
        root = np.sqrt(np.repeat(np.stack([kappa, tau], axis=1), 3, axis=1))
        cost = InformationCost(edges, R, t, root[:, :, None] * information * root[:, None, :])
    Q = np.swapaxes(initial_rotations, 1, 2)
    *_, result = solver.solve(cost, Q, initial_centers, max_num_iterations=max_num_iterations, tolerance=tolerance)
    return result
