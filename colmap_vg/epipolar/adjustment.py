"""Epipolar adjustment: refinement of all rotations, positions and free lenses by the epipolar errors of matches.

No point is triangulated. The Cauchy cost of the Sampson errors (see :mod:`colmap_vg.two_view.sampson`) of all edges is
minimised over the cameras, ``R <- exp(w) R`` (w in the camera's frame), ``p <- p + x``, by Levenberg's method on sparse
blocks, together with that of the differences of depths in image triplets (see
:mod:`colmap_vg.epipolar.depth_agreement`). The normal equations of each edge by its pose and lenses are mapped to its
cameras by the chain rule

    w_ij = Q^T (R_ij^T w_j - w_i),   tau_ij = B^T (w_i x d) + B^T R_i (x_j - x_i) / |p_j - p_i|,   Q = [B, d].

The robust scale decreases in stages, down to the noise of the matches. Only steps that lower the true cost are taken.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
from numpy.typing import NDArray

from colmap_vg.epipolar.cameras import SHORTEST_BASELINE, Cameras, CameraSteps, gauged
from colmap_vg.epipolar.depth_agreement import TripletPoses, depth_costs, depth_equations, depth_residuals
from colmap_vg.epipolar.normal_system import CameraTerms, NormalSystem
from colmap_vg.epipolar.problem import EpipolarProblem, Lenses
from colmap_vg.errors import GraphError
from colmap_vg.events import report_progress
from colmap_vg.geometry import so3
from colmap_vg.linear.robust_losses import MAD_TO_SIGMA
from colmap_vg.scene.solution import LogEntry
from colmap_vg.two_view.sampson import cauchy_costs, frames, median_errors, normal_equations, residuals
from colmap_vg.two_view.segments import segment_quantiles

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_MAX_DAMPING = 1e6  # share of the Hessian's diagonal
_EARLY_TOLERANCE = 300.0  # factor on the tolerance before the last stage, since the next scale changes the cameras more
_MAX_LOG_FOCAL = np.log(3.0)  # beyond it a focal length has diverged; errors vanish with the focal length
MAX_RADIAL_TERM = 0.6
"""Largest absolute value of the radial term, at the focal lengths of the problem; beyond it the term has diverged."""
START_SIGMAS = 3.0
"""Limit of the scales, in robust standard deviations of the matches' errors at their start. Where the camera moved
little, a wider loss takes in false matches, whose errors are as large as the parallax of the others."""
_MIN_SIGMA_PX = 0.05  # pixels; below the noise of any keypoints, and keeps the scale of exact data finite


@dataclass(frozen=True, eq=False)
class AdjustmentResult:
    """Cameras after an epipolar adjustment, with convergence information.

    Attributes
    ----------
    cam_from_world_rotations : (n, 3, 3) array
    projection_centers : (n, 3) array
        Centroid 0, root mean square distance 1.
    focal_scales : (c,) array
        Factors on the focal lengths that the bearings were computed with; 1 for cameras that were not free.
    lost_focals : (c,) bool array
        Free focal lengths that the matches do not determine: they diverged and are fixed at their initial value.
    reversed_edges : (m,) bool array
        Edges whose given direction is more than a right angle from the solved one; dropped during the adjustment.
    cost : float
        Robust cost at the last scale, squared pixels.
    converged : bool
    scale_px : float
        The last Cauchy scale, pixels.
    log : tuple of LogEntry
        One entry per iteration.
    radial_term : float
        At the problem's focal lengths, dimensionless; 0 if the problem has no bent cameras.
    """

    cam_from_world_rotations: Array
    projection_centers: Array
    focal_scales: Array
    lost_focals: BoolArray
    reversed_edges: BoolArray
    cost: float
    converged: bool
    scale_px: float
    log: tuple[LogEntry, ...]
    radial_term: float = 0.0

    @property
    def cameras(self) -> "Cameras":
        """Poses and lenses."""
        lenses = Lenses(np.log(self.focal_scales), self.radial_term)
        return Cameras(self.cam_from_world_rotations, self.projection_centers, lenses)


def adjust_epipolar(
    problem: EpipolarProblem,
    initial_rotations: Array,
    initial_centers: Array,
    directions: Array,
    *,
    initial_lenses: Lenses | None = None,
    scales_px: tuple[float, ...] = (8.0, 2.0),
    final_sigmas: float = 1.0,
    near: bool = False,
    max_num_iterations: int = 50,
    tolerance: float = 1e-5,
) -> AdjustmentResult:
    """Refine cameras by minimising the epipolar errors of all matches.

    Parameters
    ----------
    problem : EpipolarProblem
    initial_rotations : (n, 3, 3) array
        cam_from_world rotations.
    initial_centers : (n, 3) array
        Projection centres, world frame.
    directions : (m, 3) array
        Camera 2's centre in camera 1's frame by the edge's own matches. The cost does not distinguish opposite
        directions, so after each scale edges more than a right angle from the solved direction are dropped.
    initial_lenses : Lenses, optional
        Default: the problem's focal lengths, without distortion.
    scales_px : tuple of float
        Upper limits of successive Cauchy scales, pixels, see `START_SIGMAS`.
    final_sigmas : float
        Last Cauchy scale, in robust standard deviations of the matches' errors, if that is below the previous one:
        false matches with errors of a pixel would bias a result that is accurate to a quarter of it. 0 omits it.
    near : bool
        The initial cameras are near the minimum, so that full Newton steps are safe from the start.
    max_num_iterations : int
        Maximum number of steps at each scale.
    tolerance : float
        Relative change of the cost at which the last scale ends; earlier ones end at three hundred times that.

    Returns
    -------
    AdjustmentResult

    Raises
    ------
    GraphError
        There are no matches, or all cameras coincide.
    """
    if len(problem.bearings1) == 0:
        raise GraphError("epipolar adjustment: the edges have no matches")
    lost = np.zeros(len(problem.focal_lengths), dtype=bool)
    while True:
        lenses = Lenses(np.zeros(len(lost))) if initial_lenses is None else initial_lenses
        lenses = replace(lenses, log_scales=np.where(lost, 0.0, lenses.log_scales))
        start = Cameras(initial_rotations, gauged(initial_centers), lenses)
        restricted = replace(problem, free_focals=problem.free_focals & ~lost)
        found = _in_stages(restricted, start, directions, scales_px, final_sigmas, near, max_num_iterations, tolerance)
        diverged = np.abs(np.log(found.focal_scales)) > _MAX_LOG_FOCAL
        if not diverged.any():
            return replace(found, lost_focals=lost)
        lost |= diverged


def _in_stages(
    problem: EpipolarProblem,
    cameras: Cameras,
    directions: Array,
    scales_px: tuple[float, ...],
    final_sigmas: float,
    near: bool,
    max_num_iterations: int,
    tolerance: float,
) -> AdjustmentResult:
    """Minimise at successive scales; end early if a lens diverges."""
    reversed_edges, rows = np.zeros(len(problem.edges), dtype=bool), np.arange(len(problem.edges))
    log: list[LogEntry] = []
    scale, cost, converged = np.inf, np.inf, False
    num_stages = len(scales_px) + (final_sigmas > 0)
    for stage in range(num_stages):
        last = stage + 1 == num_stages
        if stage < len(scales_px):
            scale = min(scales_px[stage], max(START_SIGMAS * _sigma(problem, cameras), _MIN_SIGMA_PX))
        else:
            scale = min(scale, max(final_sigmas * _sigma(problem, cameras), _MIN_SIGMA_PX))
        end = tolerance if last else _EARLY_TOLERANCE * tolerance
        close = near or stage > 0
        cameras, cost, converged = _minimized(problem, cameras, scale, max_num_iterations, end, log, near=close)
        if _lens_diverged(cameras):
            break
        away = np.einsum("ka,ka->k", cameras.relative(problem.edges)[1], directions[rows]) < 0.0
        if away.any() and not away.all():
            reversed_edges[rows[away]] = True
            problem, rows = problem.without(away), rows[~away]
            if last:
                cameras, cost, converged = _minimized(problem, cameras, scale, max_num_iterations, end, log, near=True)
    return AdjustmentResult(
        so3.project(cameras.rotations),
        cameras.centers,
        np.exp(cameras.lenses.log_scales),
        np.zeros(len(cameras.lenses.log_scales), dtype=bool),
        reversed_edges,
        cost,
        converged,
        scale,
        tuple(log),
        cameras.lenses.radial_term,
    )


def edge_errors(problem: EpipolarProblem, found: AdjustmentResult) -> Array:
    """Residual of each edge's matches at adjusted cameras, pixels: (m,).

    The median Sampson error or, if larger, the median depth residual in the best of the edge's triplets: false matches
    along their epipolar lines, as on a façade with repeated structure, have large residuals in depth only.
    """
    cameras = found.cameras
    R, d, _ = cameras.relative(problem.edges)
    errors = median_errors(problem.matches(cameras.lenses), R, d)
    triplets = problem.triplets
    if triplets is None:
        return errors
    rays = problem.triplet_rays(triplets, cameras.lenses)
    medians = segment_quantiles(triplets.offsets, np.abs(depth_residuals(rays, cameras.about_middle(triplets.images))))
    best = np.full(len(errors), np.inf)
    np.minimum.at(best, triplets.edges.ravel(), np.repeat(medians, 2))
    return np.asarray(np.maximum(errors, np.where(np.isfinite(best), best, 0.0)))


def _sigma(problem: EpipolarProblem, cameras: Cameras) -> float:
    """Robust standard deviation of all matches' Sampson errors, pixels."""
    R, d, _ = cameras.relative(problem.edges)
    return MAD_TO_SIGMA * float(np.median(np.abs(residuals(problem.matches(cameras.lenses), R, d))))


def _lens_diverged(cameras: Cameras) -> bool:
    lenses = cameras.lenses
    return bool(np.any(np.abs(lenses.log_scales) > _MAX_LOG_FOCAL)) or abs(lenses.radial_term) > MAX_RADIAL_TERM


def cost_and_gradient(problem: EpipolarProblem, cameras: Cameras, scale_px: float) -> tuple[float, Array]:
    """Half the Cauchy cost, and its gradient (6 n + u,) in the parameters of `Cameras.moved`."""
    terms = _terms(problem, cameras, scale_px)
    return _total(terms) / 2.0, normal_system(problem).gradient(terms)


def normal_system(problem: EpipolarProblem) -> NormalSystem:
    """Normal equations of the poses and free lenses of a problem."""
    images = [problem.edges] if problem.triplets is None else [problem.edges, problem.triplets.images]
    free = np.flatnonzero(problem.free_focals)
    return NormalSystem(
        problem.num_images,
        images,
        problem.camera_idx,
        free,
        len(problem.focal_lengths),
        with_radial=problem.bent_cameras is not None and problem.lenses_are_free,
    )


def _terms(problem: EpipolarProblem, cameras: Cameras, scale: float, *, near: bool = False) -> list[CameraTerms]:
    """Robust costs of edges and triplets with derivatives by the cameras; Newton Hessians of edges if `near`."""
    edges, (R, d, length) = problem.edges, cameras.relative(problem.edges)
    at = normal_equations(problem.matches(cameras.lenses), R, d, np.full(len(edges), scale))
    chain = edge_chain(cameras.rotations[edges[:, 0]], R, d, length)
    hessians = at.newton_hessians if near else at.hessians
    terms = [CameraTerms.chained(edges, at.costs, at.gradients, hessians, chain)]
    if problem.triplets is not None:
        images = problem.triplets.images
        rays = problem.triplet_rays(problem.triplets, cameras.lenses)
        poses = cameras.about_middle(images)
        depth = depth_equations(rays, poses, scale)
        chain = triplet_chain(cameras.rotations[images[:, 1]], poses)
        terms.append(CameraTerms.chained(images, depth.costs, depth.gradients, depth.hessians, chain))
    return terms


def _cost(problem: EpipolarProblem, cameras: Cameras, scale: float) -> float:
    R, d, _ = cameras.relative(problem.edges)
    cost = cauchy_costs(problem.matches(cameras.lenses), R, d, np.full(len(R), scale)).sum()
    if problem.triplets is not None:
        rays = problem.triplet_rays(problem.triplets, cameras.lenses)
        cost += depth_costs(rays, cameras.about_middle(problem.triplets.images), scale).sum()
    return float(cost)


def edge_chain(R_i: Array, R: Array, d: Array, length: Array) -> Array:
    """Derivatives (m, 5, 12) of an edge's five parameters by its cameras' ``(w_i, x_i, w_j, x_j)``."""
    Q1, Q2 = frames(R, d)
    B = np.swapaxes(Q1[:, :, :2], 1, 2)
    along = B @ R_i / length[:, None, None]
    chain = np.zeros((len(R), 5, 12))
    chain[:, :3, :3], chain[:, :3, 6:9] = -np.swapaxes(Q1, 1, 2), np.swapaxes(Q2, 1, 2)
    chain[:, 3, :3], chain[:, 4, :3] = B[:, 1], -B[:, 0]
    chain[:, 3:, 3:6], chain[:, 3:, 9:] = -along, along
    # The direction between coinciding cameras is undefined: it must not move them apart.
    chain[length <= SHORTEST_BASELINE, 3:] = 0.0
    return chain


def triplet_chain(R_b: Array, poses: TripletPoses) -> Array:
    """Derivatives (q, 12, 18) of a triplet's parameters by its cameras' ``(w, x)``, in the order a, b, c."""
    chain = np.zeros((len(R_b), 12, 18))
    for side, first in ((0, 0), (1, 12)):
        turn, shift = slice(3 * side, 3 * side + 3), slice(6 + 3 * side, 9 + 3 * side)
        chain[:, turn, first : first + 3] = -poses.rotations[side]
        chain[:, turn, 6:9] = np.eye(3)
        chain[:, shift, 6:9] = -so3.hat(poses.baselines[side])
        chain[:, shift, first + 3 : first + 6] = -R_b
        chain[:, shift, 9:12] = R_b
        short = np.linalg.norm(poses.baselines[side], axis=1) <= SHORTEST_BASELINE
        chain[short, shift] = 0.0
    return chain


def _minimized(
    problem: EpipolarProblem,
    cameras: Cameras,
    scale: float,
    max_num_iterations: int,
    end: float,
    log: list[LogEntry],
    *,
    near: bool,
) -> tuple[Cameras, float, bool]:
    """Minimise at one scale; return the cameras, the cost, and whether the cost converged.

    Far from the minimum (not `near`), where many matches have large errors, the steps are those of reweighted least
    squares, which are shorter but safer.
    """
    system, steps, damping = normal_system(problem), CameraSteps(cameras, problem.edges), 1e-4
    terms = _terms(problem, cameras, scale, near=near)
    before = _total(terms)
    for iteration in range(max_num_iterations):
        report_progress("epipolar adjustment")
        gradient, ahead = system.gradient(terms), None
        for attempt in count():
            step = system.step(terms, gradient, damping)
            if step is not None:
                trial = steps.taken(cameras, step, system.free)
                # A first step is nearly always accepted: unless it is expected to be the last one, compute the
                # derivatives needed next, which include its cost.
                goes_on = attempt == 0 and -float(gradient @ step) >= end * before
                ahead = _terms(problem, trial, scale, near=near) if goes_on else None
                cost = _total(ahead) if ahead is not None else _cost(problem, trial, scale)
                if cost < before:
                    break
            damping *= 10.0
            if damping > _MAX_DAMPING:
                return cameras, before, True
        change = (before - cost) / before
        cameras, before, damping = trial, cost, damping / 10.0
        log.append(LogEntry("epipolar", iteration + 1, cost, change))
        if change < end:
            return cameras, cost, True
        if _lens_diverged(cameras):
            break
        terms = ahead if ahead is not None else _terms(problem, cameras, scale, near=near)
    return cameras, before, False


def _total(terms: Sequence[CameraTerms]) -> float:
    return sum(float(t.costs.sum()) for t in terms)
