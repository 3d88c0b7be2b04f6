"""Epipolar adjustment: all rotations, positions and free focal lengths by the epipolar errors of all matches.

No point is triangulated. The Cauchy cost of the Sampson errors (see :mod:`colmap_vg.epipolar.sampson`) of all edges is
minimised over the cameras, ``R <- exp(w) R`` (w in the camera), ``p <- p + x``, by Levenberg's method on sparse blocks:
each edge's normal equations by its five or seven parameters are carried to its cameras by the chain rule

    w_ij = Q^T (R_ij^T w_j - w_i),   tau_ij = B^T (w_i x d) + B^T R_i (x_j - x_i) / |p_j - p_i|,   Q = [B, d].

The robust scale shrinks in steps. A step is taken only where it lowers the true cost.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from colmap_vg.epipolar.problem import EpipolarProblem
from colmap_vg.epipolar.sampson import cauchy_costs, frames, normal_equations
from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.linear.assembly import BlockPattern, sum_at_nodes
from colmap_vg.linear.solvers import SingularMatrixError, factorize
from colmap_vg.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_MIN_DAMPING, _MAX_DAMPING = 1e-9, 1e6  # shares of the Hessian's diagonal
_SHORTEST_BASELINE = 1e-6  # of the RMS distance of cameras; keeps the direction of coinciding cameras finite
_MAX_LOG_FOCAL_STEP = 0.3


@dataclass(frozen=True, eq=False)
class AdjustmentResult:
    """Cameras after an epipolar adjustment.

    Attributes
    ----------
    cam_from_world_rotations : (n, 3, 3) array
    projection_centers : (n, 3) array
        Centroid 0, root mean square distance 1.
    focal_scales : (c,) array
        Factors on the focal lengths that the bearings were taken with; 1 for cameras that were not free.
    reversed_edges : (m,) bool array
        Edges whose given direction turned out to point away from the solved one; dropped on the way.
    cost : float
        At the last scale, squared pixels.
    converged : bool
    log : tuple of LogEntry
    """

    cam_from_world_rotations: Array
    projection_centers: Array
    focal_scales: Array
    reversed_edges: BoolArray
    cost: float
    converged: bool
    log: tuple[LogEntry, ...]


@dataclass(frozen=True, eq=False)
class Cameras:
    """cam_from_world rotations (n, 3, 3), centres (n, 3) and log focal factors (c,)."""

    rotations: Array
    centers: Array
    log_scales: Array

    def moved(self, step: Array, free: IntArray) -> "Cameras":
        """After a step (6 n + f,): w and x of each image, then the free focals' logarithms; gauge put back."""
        n = len(self.centers)
        poses = step[: 6 * n].reshape(n, 6)
        log_scales = self.log_scales.copy()
        log_scales[free] += np.clip(step[6 * n :], -_MAX_LOG_FOCAL_STEP, _MAX_LOG_FOCAL_STEP)
        return Cameras(so3.exp(poses[:, :3]) @ self.rotations, gauged(self.centers + poses[:, 3:]), log_scales)

    def relative(self, edges: IntArray) -> tuple[Array, Array, Array]:
        """Relative rotations (m, 3, 3), directions (m, 3) and baselines (m,) of edges."""
        i, j = edges.T
        relative = self.rotations[j] @ np.swapaxes(self.rotations[i], 1, 2)
        baseline = np.einsum("kab,kb->ka", self.rotations[i], self.centers[j] - self.centers[i])
        length = np.linalg.norm(baseline, axis=1)
        short = length < _SHORTEST_BASELINE
        directions = np.where(short[:, None], [0.0, 0.0, 1.0], normalized(baseline))
        return relative, directions, np.where(short, _SHORTEST_BASELINE, length)


def adjust_epipolar(
    problem: EpipolarProblem,
    initial_rotations: Array,
    initial_centers: Array,
    directions: Array,
    *,
    scales_px: tuple[float, ...] = (8.0, 2.0, 1.0),
    max_num_iterations: int = 50,
    tolerance: float = 1e-5,
) -> AdjustmentResult:
    """Minimise the epipolar errors of all matches from given cameras.

    Parameters
    ----------
    problem : EpipolarProblem
    initial_rotations : (n, 3, 3) array
        cam_from_world.
    initial_centers : (n, 3) array
    directions : (m, 3) array
        Camera 2's centre in camera 1's frame by the edge's own matches: the cost does not tell it from its opposite, so
        after each scale edges that the cameras contradict by more than a right angle are dropped.
    scales_px : tuple of float
        Cauchy scales in turn, pixels.
    max_num_iterations : int
        Steps at each scale.
    tolerance : float
        Relative change of the cost at which the last scale ends; earlier ones end at a hundred times that.

    Returns
    -------
    AdjustmentResult

    Raises
    ------
    GraphError
        There are no matches, or cameras at one place.
    """
    if len(problem.bearings1) == 0:
        raise GraphError("epipolar adjustment: the edges have no matches")
    cameras = Cameras(initial_rotations, gauged(initial_centers), np.zeros(len(problem.focal_lengths)))
    reversed_edges, rows = np.zeros(len(problem.edges), dtype=bool), np.arange(len(problem.edges))
    log: list[LogEntry] = []
    cost, converged = np.inf, False
    for count, scale in enumerate(scales_px, start=1):
        end = tolerance if count == len(scales_px) else 100.0 * tolerance
        cameras, cost, converged = _minimized(problem, cameras, scale, max_num_iterations, end, log)
        away = np.einsum("ka,ka->k", cameras.relative(problem.edges)[1], directions[rows]) < 0.0
        if away.any() and not away.all():
            reversed_edges[rows[away]] = True
            problem, rows = problem.without(away), rows[~away]
            if count == len(scales_px):
                cameras, cost, converged = _minimized(problem, cameras, scale, max_num_iterations, end, log)
    return AdjustmentResult(
        so3.project(cameras.rotations),
        cameras.centers,
        np.exp(cameras.log_scales),
        reversed_edges,
        cost,
        converged,
        tuple(log),
    )


def gauged(centers: Array) -> Array:
    """Positions with centroid 0 and root mean square distance 1.

    Raises
    ------
    GraphError
        They are all the same.
    """
    centered = centers - centers.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum(centered**2, axis=1)))
    if not spread > 0:
        raise GraphError("epipolar adjustment: all cameras are at one place")
    return np.asarray(centered / spread)


def cost_and_gradient(problem: EpipolarProblem, cameras: Cameras, scale_px: float) -> tuple[float, Array]:
    """Half the Cauchy cost, and its gradient (6 n + f,) as `Cameras.moved` takes steps."""
    at = _linearized(problem, cameras, scale_px)
    return at.cost / 2.0, at.gradient


@dataclass(frozen=True, eq=False)
class _Linearized:
    """Cost, gradient (6 n + f,), and the Hessian's blocks of edges: at poses, between poses and focals, at focals."""

    cost: float
    gradient: Array
    pose_blocks: Array
    cross_blocks: Array
    focal_blocks: Array


def _linearized(problem: EpipolarProblem, cameras: Cameras, scale: float) -> _Linearized:
    n, edges, free = problem.num_images, problem.edges, np.flatnonzero(problem.free_focals)
    R, d, length = cameras.relative(edges)
    at = normal_equations(
        problem.matches(cameras.log_scales), R, d, np.full(len(edges), scale), with_focals=len(free) > 0
    )
    chain = _chain(cameras.rotations[edges[:, 0]], R, d, length)
    by_pose = at.gradients[:, None, :5] @ chain
    gradient = sum_at_nodes(n, edges.ravel(), by_pose.reshape(-1, 6)).ravel()
    turned = np.swapaxes(chain, 1, 2)
    pose_blocks = turned @ at.hessians[:, :5, :5] @ chain
    if len(free):
        place = np.full(len(problem.focal_lengths), -1)
        place[free] = np.arange(len(free))
        slot = place[problem.camera_idx[edges]].ravel()
        by_focal = sum_at_nodes(len(free), slot[slot >= 0], at.gradients[:, 5:].reshape(-1, 1)[slot >= 0])
        gradient = np.concatenate([gradient, by_focal.ravel()])
    return _Linearized(
        float(at.costs.sum()), gradient, pose_blocks, turned @ at.hessians[:, :5, 5:], at.hessians[:, 5:, 5:]
    )


def _chain(R_i: Array, R: Array, d: Array, length: Array) -> Array:
    """Derivatives (m, 5, 12) of an edge's five parameters by its cameras' ``(w_i, x_i, w_j, x_j)``."""
    Q1, Q2 = frames(R, d)
    B = np.swapaxes(Q1[:, :, :2], 1, 2)
    along = B @ R_i / length[:, None, None]
    chain = np.zeros((len(R), 5, 12))
    chain[:, :3, :3], chain[:, :3, 6:9] = -np.swapaxes(Q1, 1, 2), np.swapaxes(Q2, 1, 2)
    chain[:, 3, :3], chain[:, 4, :3] = B[:, 1], -B[:, 0]
    chain[:, 3:, 3:6], chain[:, 3:, 9:] = -along, along
    # Where cameras coincide the direction means nothing: their distance must not be torn apart by it.
    chain[length <= _SHORTEST_BASELINE, 3:] = 0.0
    return chain


def _minimized(
    problem: EpipolarProblem, cameras: Cameras, scale: float, max_num_iterations: int, end: float, log: list[LogEntry]
) -> tuple[Cameras, float, bool]:
    """Cameras at the minimum for one scale, the cost, and whether the cost stood still."""
    system = _System(problem)
    scales = np.full(len(problem.edges), scale)
    at, damping = _linearized(problem, cameras, scale), 1e-4
    for iteration in range(max_num_iterations):
        while True:
            trial = None
            step = system.step(at, damping)
            if step is not None:
                trial = cameras.moved(step, system.free)
                R, d, _ = trial.relative(problem.edges)
                cost = float(cauchy_costs(problem.matches(trial.log_scales), R, d, scales).sum())
                if cost < at.cost:
                    break
            damping *= 10.0
            if damping > _MAX_DAMPING:
                return cameras, at.cost, True
        change = (at.cost - cost) / at.cost
        cameras, damping = trial, max(damping / 10.0, _MIN_DAMPING)
        at = _linearized(problem, cameras, scale)
        log.append(LogEntry("epipolar", iteration + 1, at.cost, change))
        if change < end:
            return cameras, at.cost, True
    return cameras, at.cost, False


class _System:
    """Sparse normal equations on the pattern of a problem."""

    def __init__(self, problem: EpipolarProblem) -> None:
        self.free = np.flatnonzero(problem.free_focals)
        self._pattern = BlockPattern(problem.num_images, problem.edges, 6)
        self._problem = problem
        place = np.full(len(problem.focal_lengths), -1)
        place[self.free] = np.arange(len(self.free))
        self._slot = place[problem.camera_idx[problem.edges]]

    def step(self, at: _Linearized, damping: float) -> Array | None:
        """Levenberg's step, with each diagonal entry raised by its share; None where that does not suffice."""
        ii, jj, ij = at.pose_blocks[:, :6, :6], at.pose_blocks[:, 6:, 6:], at.pose_blocks[:, :6, 6:]
        n, edges = self._problem.num_images, self._problem.edges
        diagonal = sum_at_nodes(n, edges[:, 0], np.einsum("kaa->ka", ii)) + sum_at_nodes(
            n, edges[:, 1], np.einsum("kaa->ka", jj)
        )
        level = damping * diagonal + _MIN_DAMPING * diagonal.max(axis=0)
        poses = self._pattern.assemble(ii, jj, ij, level[:, :, None] * np.eye(6))
        matrix = poses if not len(self.free) else self._bordered(poses, at, damping)
        try:
            return -factorize(matrix).solve(at.gradient)
        except SingularMatrixError:
            return None

    def _bordered(self, poses: sp.csc_array, at: _Linearized, damping: float) -> sp.csc_array:
        n, f, edges = self._problem.num_images, len(self.free), self._problem.edges
        unknown = (6 * edges[:, :, None] + np.arange(6)).reshape(len(edges), 12)
        rows = np.broadcast_to(unknown[:, :, None], at.cross_blocks.shape)
        columns = np.broadcast_to(self._slot[:, None, :], at.cross_blocks.shape)
        used = columns >= 0
        cross = sp.coo_array((at.cross_blocks[used], (rows[used], columns[used])), shape=(6 * n, f))
        first = np.broadcast_to(self._slot[:, :, None], at.focal_blocks.shape)
        second = np.broadcast_to(self._slot[:, None, :], at.focal_blocks.shape)
        used = (first >= 0) & (second >= 0)
        focal = sp.csc_array(sp.coo_array((at.focal_blocks[used], (first[used], second[used])), shape=(f, f)))
        level = focal.diagonal() * damping
        focal = focal + sp.diags_array(level + 1e-12 * max(float(focal.diagonal().max()), 1e-300))
        return sp.csc_array(sp.block_array([[poses, cross], [cross.T, focal]]))
