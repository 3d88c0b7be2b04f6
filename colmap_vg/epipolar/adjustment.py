"""Epipolar adjustment: all rotations, positions and free focal lengths by the epipolar errors of all matches.

The Cauchy cost of the Sampson errors (see :mod:`colmap_vg.epipolar.sampson`) of all edges is minimised over the
cameras, ``R <- exp(w) R`` (w in the camera), ``p <- p + x``, by Levenberg's method on sparse blocks: each edge's normal
equations by its five or seven parameters are carried to its cameras by the chain rule

    w_ij = Q^T (R_ij^T w_j - w_i),   tau_ij = B^T (w_i x d) + B^T R_i (x_j - x_i) / |p_j - p_i|,   Q = [B, d].

The robust scale shrinks in steps, the last one to the noise of the matches themselves: on repeated structure wrong
matches agree on geometry a pixel off. A step is taken only where it lowers the true cost. Epipolar errors do not fix
the ratio of baselines along a line of cameras: a few tracks of three views or more join at the end, and their points
are eliminated from each system.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from colmap_vg.epipolar.problem import EpipolarProblem
from colmap_vg.epipolar.sampson import cauchy_costs, frames, normal_equations, residuals_by_block
from colmap_vg.epipolar.track_errors import TrackEquations, TrackErrors
from colmap_vg.epipolar.tracks import Tracks, triangulated
from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.linear.assembly import BlockPattern, sum_at_nodes
from colmap_vg.linear.solvers import SingularMatrixError, factorize
from colmap_vg.robust import EFFICIENT_CAUCHY, MAD_TO_SIGMA
from colmap_vg.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_MIN_DAMPING, _MAX_DAMPING = 1e-9, 1e6  # shares of the Hessian's diagonal
_SHORTEST_BASELINE = 1e-6  # of the RMS distance of cameras; keeps the direction of coinciding cameras finite
_MAX_LOG_FOCAL_STEP = 0.3
_SMALLEST_SCALE_PX = 0.25  # keypoints of photographs are not better than a tenth of a pixel
_TRACK_GATE_PX = 16.0  # an observation farther off than this from its track's point does not take part


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
    """cam_from_world rotations (n, 3, 3), centres (n, 3), log focal factors (c,), and points of tracks (t, 3)."""

    rotations: Array
    centers: Array
    log_scales: Array
    points: Array

    def moved(self, step: Array, free: IntArray, point_step: Array | None = None) -> "Cameras":
        """After a step (6 n + f,) of w and x of each image and the free log focals, and one of points (t, 3)."""
        n = len(self.centers)
        poses = step[: 6 * n].reshape(n, 6)
        log_scales = self.log_scales.copy()
        log_scales[free] += np.clip(step[6 * n :], -_MAX_LOG_FOCAL_STEP, _MAX_LOG_FOCAL_STEP)
        points = self.points if point_step is None else self.points + point_step
        return Cameras(so3.exp(poses[:, :3]) @ self.rotations, self.centers + poses[:, 3:], log_scales, points)

    def gauged(self) -> "Cameras":
        """The same with centroid 0 and root mean square distance 1.

        Raises
        ------
        GraphError
            All centres are the same.
        """
        middle = self.centers.mean(axis=0)
        spread = np.sqrt(np.mean(np.sum((self.centers - middle) ** 2, axis=1)))
        if not spread > 0:
            raise GraphError("epipolar adjustment: all cameras are at one place")
        return replace(self, centers=(self.centers - middle) / spread, points=(self.points - middle) / spread)

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
    tracks: Tracks | None = None,
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
    tracks : Tracks, optional
        Join after the last of `scales_px`.
    scales_px : tuple of float
        Cauchy scales in turn, pixels. The noise of the matches gives one more, where it is below the last.
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
    cameras = Cameras(
        initial_rotations, initial_centers, np.zeros(len(problem.focal_lengths)), np.zeros((0, 3))
    ).gauged()
    reversed_edges, rows = np.zeros(len(problem.edges), dtype=bool), np.arange(len(problem.edges))
    log: list[LogEntry] = []
    objective, cost, converged = _Objective(problem), np.inf, False
    rounds: list[tuple[float | None, bool]] = [(scale, False) for scale in scales_px]
    with_tracks = tracks is not None and tracks.num_tracks > 0
    rounds += [(scales_px[-1], True)] * with_tracks + [(None, with_tracks)]
    for count, (given, joined) in enumerate(rounds, start=1):
        if joined and tracks is not None:
            objective, cameras = _joined(problem, tracks, cameras)
        scale = min(scales_px[-1], _noise_scale(problem, cameras)) if given is None else given
        end = tolerance if count == len(rounds) else 100.0 * tolerance
        cameras, cost, converged = _minimized(objective, cameras, scale, max_num_iterations, end, log)
        away = np.einsum("ka,ka->k", cameras.relative(problem.edges)[1], directions[rows]) < 0.0
        if away.any() and not away.all():
            reversed_edges[rows[away]] = True
            problem, rows = problem.without(away), rows[~away]
            objective = _Objective(problem, objective.tracks)
            if count == len(rounds):
                cameras, cost, converged = _minimized(objective, cameras, scale, max_num_iterations, end, log)
    return AdjustmentResult(
        so3.project(cameras.rotations),
        cameras.centers,
        np.exp(cameras.log_scales),
        reversed_edges,
        cost,
        converged,
        tuple(log),
    )


@dataclass(frozen=True, eq=False)
class Linearized:
    """Half the cost's gradient (6 n + f,), and blocks of the Gauss-Newton Hessian: of edges, and of tracks.

    Attributes
    ----------
    cost : float
    gradient : (6 n + f,) array
        By cameras, tracks included.
    pose_blocks, cross_blocks, focal_blocks : (m, 12, 12), (m, 12, 2), (m, 2, 2) array
    tracks : TrackEquations or None
    """

    cost: float
    gradient: Array
    pose_blocks: Array
    cross_blocks: Array
    focal_blocks: Array
    tracks: TrackEquations | None


class _Objective:
    """The true robust cost of matches and tracks, its linearisation, and Levenberg's steps."""

    def __init__(self, problem: EpipolarProblem, tracks: Tracks | None = None) -> None:
        self.problem, self.tracks = problem, tracks
        self.free = np.flatnonzero(problem.free_focals)
        place = np.full(len(problem.focal_lengths), -1)
        place[self.free] = np.arange(len(self.free))
        self._slots = place[problem.camera_idx]
        self._pattern = BlockPattern(problem.num_images, problem.edges, 6)
        self._errors = None
        if tracks is not None:
            self._errors = TrackErrors(tracks, problem.num_images, self._slots, len(self.free))

    def cost(self, cameras: Cameras, scale: float) -> float:
        R, d, _ = cameras.relative(self.problem.edges)
        scales = np.full(len(self.problem.edges), scale)
        total = float(cauchy_costs(self.problem.matches(cameras.log_scales), R, d, scales).sum())
        if self._errors is not None:
            total += self._errors.cost(*self._seen(cameras), scale)
        return total

    def track_errors(self, cameras: Cameras) -> Array:
        """Reprojection errors of the tracks' observations, pixels."""
        return np.zeros(0) if self._errors is None else self._errors.lengths(*self._seen(cameras))

    def linearized(self, cameras: Cameras, scale: float) -> Linearized:
        problem, n, edges = self.problem, self.problem.num_images, self.problem.edges
        R, d, length = cameras.relative(edges)
        scales = np.full(len(edges), scale)
        matches = problem.matches(cameras.log_scales)
        at = normal_equations(matches, R, d, scales, with_focals=len(self.free) > 0)
        chain = _chain(cameras.rotations[edges[:, 0]], R, d, length)
        turned = np.swapaxes(chain, 1, 2)
        by_pose = at.gradients[:, None, :5] @ chain
        gradient = sum_at_nodes(n, edges.ravel(), by_pose.reshape(-1, 6)).ravel()
        if len(self.free):
            slot = self._slots[edges].ravel()
            by_focal = at.gradients[:, 5:].reshape(-1, 1)
            summed = sum_at_nodes(len(self.free), slot[slot >= 0], by_focal[slot >= 0])
            gradient = np.concatenate([gradient, summed.ravel()])
        cost, tracks = float(at.costs.sum()), None
        if self._errors is not None:
            tracks = self._errors.equations(*self._seen(cameras), scale)
            cost, gradient = cost + tracks.cost, gradient + tracks.camera_gradient
        cross = turned @ at.hessians[:, :5, 5:]
        return Linearized(
            cost, gradient, turned @ at.hessians[:, :5, :5] @ chain, cross, at.hessians[:, 5:, 5:], tracks
        )

    def step(self, at: Linearized, damping: float) -> tuple[Array, Array | None] | None:
        """Levenberg's step of cameras and points, each diagonal entry raised by its share; None where none is found."""
        matrix = self._hessian(at)
        right, inverse = -at.gradient, None
        diagonal = matrix.diagonal()
        if at.tracks is not None:
            # The points go first: S = H - W V^-1 W^T.
            diagonal = diagonal + at.tracks.camera_hessian.diagonal()
            matrix = matrix + at.tracks.camera_hessian
            blocks = at.tracks.point_blocks
            spread = np.einsum("taa->ta", blocks)
            level = damping * spread + _MIN_DAMPING * spread.max(axis=1, keepdims=True) + 1e-300
            inverse = np.linalg.inv(blocks + level[:, :, None] * np.eye(3))
            count = len(inverse)
            divided = at.tracks.mixed @ sp.bsr_array(
                (inverse, np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count)
            )
            matrix = matrix - divided @ at.tracks.mixed.T
            right = right + divided @ at.tracks.point_gradient
        level = damping * diagonal + _MIN_DAMPING * _largest_of_kind(diagonal, self.problem.num_images)
        try:
            step = factorize(sp.csc_array(matrix + sp.diags_array(level))).solve(right)
        except SingularMatrixError:
            return None
        if at.tracks is None or inverse is None:
            return step, None
        toward = -(at.tracks.point_gradient + at.tracks.mixed.T @ step).reshape(-1, 3)
        return step, np.einsum("tab,tb->ta", inverse, toward)

    def _seen(self, cameras: Cameras) -> tuple[Array, Array, Array, Array, Array]:
        """Rotations, centres, points, and the observations' bearings and focal lengths at the cameras' focals."""
        if self.tracks is None:
            raise GraphError("epipolar adjustment: there are no tracks")
        camera = self.problem.camera_idx[self.tracks.images]
        bearings = self.tracks.bearings
        if len(self.free):
            shrink = np.exp(-cameras.log_scales[camera])
            bearings = normalized(bearings * np.stack([shrink, shrink, np.ones(len(shrink))], axis=1))
        focals = self.problem.focal_lengths[camera] * np.exp(cameras.log_scales[camera])
        return cameras.rotations, cameras.centers, cameras.points, bearings, focals

    def _hessian(self, at: Linearized) -> sp.csc_array:
        """Of the edges' cost, (6 n + f) square."""
        n, edges, f = self.problem.num_images, self.problem.edges, len(self.free)
        ii, jj, ij = at.pose_blocks[:, :6, :6], at.pose_blocks[:, 6:, 6:], at.pose_blocks[:, :6, 6:]
        poses = self._pattern.assemble(ii, jj, ij)
        if f == 0:
            return poses
        slots = self._slots[edges]
        unknown = (6 * edges[:, :, None] + np.arange(6)).reshape(len(edges), 12)
        rows = np.broadcast_to(unknown[:, :, None], at.cross_blocks.shape)
        columns = np.broadcast_to(slots[:, None, :], at.cross_blocks.shape)
        used = columns >= 0
        cross = sp.coo_array((at.cross_blocks[used], (rows[used], columns[used])), shape=(6 * n, f))
        first = np.broadcast_to(slots[:, :, None], at.focal_blocks.shape)
        second = np.broadcast_to(slots[:, None, :], at.focal_blocks.shape)
        used = (first >= 0) & (second >= 0)
        focal = sp.coo_array((at.focal_blocks[used], (first[used], second[used])), shape=(f, f))
        return sp.csc_array(sp.block_array([[poses, cross], [cross.T, focal]]))


def linearized(problem: EpipolarProblem, cameras: Cameras, scale_px: float, tracks: Tracks | None = None) -> Linearized:
    """Cost and half its gradient, as `Cameras.moved` takes steps, of matches and tracks."""
    return _Objective(problem, tracks).linearized(cameras, scale_px)


def cost_of(problem: EpipolarProblem, cameras: Cameras, scale_px: float, tracks: Tracks | None = None) -> float:
    """The robust cost alone, squared pixels."""
    return _Objective(problem, tracks).cost(cameras, scale_px)


def _joined(problem: EpipolarProblem, tracks: Tracks, cameras: Cameras) -> tuple[_Objective, Cameras]:
    """The objective with the tracks, less observations that are far off, and their points triangulated."""
    for _ in range(2):
        points = triangulated(tracks, cameras.rotations, cameras.centers)
        cameras = replace(cameras, points=points)
        objective = _Objective(problem, tracks)
        near = objective.track_errors(cameras) <= _TRACK_GATE_PX
        if near.all():
            break
        tracks = tracks.of(near)
    return objective, cameras


def _noise_scale(problem: EpipolarProblem, cameras: Cameras) -> float:
    """Cauchy scale, pixels, at which normal noise of the matches' own size loses 5 % of efficiency."""
    R, d, _ = cameras.relative(problem.edges)
    parts = [np.abs(r) for _, _, _, r in residuals_by_block(problem.matches(cameras.log_scales), R, d)]
    return max(EFFICIENT_CAUCHY * MAD_TO_SIGMA * float(np.median(np.concatenate(parts))), _SMALLEST_SCALE_PX)


def _largest_of_kind(diagonal: Array, num_images: int) -> Array:
    """For each unknown the largest diagonal entry among those of its kind: rotations, positions, focal lengths."""
    poses = diagonal[: 6 * num_images].reshape(-1, 6)
    largest = np.tile(np.repeat([poses[:, :3].max(), poses[:, 3:].max()], 3), num_images)
    focals = diagonal[6 * num_images :]
    return np.concatenate([largest, np.full(len(focals), focals.max(initial=0.0))]) + 1e-300


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
    objective: _Objective, cameras: Cameras, scale: float, max_num_iterations: int, end: float, log: list[LogEntry]
) -> tuple[Cameras, float, bool]:
    """Cameras at the minimum for one scale, the cost, and whether the cost stood still."""
    at, damping = objective.linearized(cameras, scale), 1e-4
    for iteration in range(max_num_iterations):
        while True:
            step = objective.step(at, damping)
            if step is not None:
                trial = cameras.moved(step[0], objective.free, step[1])
                cost = objective.cost(trial, scale)
                if cost < at.cost:
                    break
            damping *= 10.0
            if damping > _MAX_DAMPING:
                return cameras, at.cost, True
        change = (at.cost - cost) / at.cost
        cameras, damping = trial.gauged(), max(damping / 10.0, _MIN_DAMPING)
        at = objective.linearized(cameras, scale)
        log.append(LogEntry("epipolar", iteration + 1, at.cost, change))
        if change < end:
            return cameras, at.cost, True
    return cameras, at.cost, False
