"""Nonlinear refinement of the relative poses of all edges on their inliers, with 5-DoF information matrices.

The robust Sampson error of edge k (see :mod:`colmap_vg.two_view.sampson`) is minimised over its rotation (3) and
direction (2) by Levenberg-Marquardt, each edge with its own damping.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.events import report_progress
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.linear.robust_losses import EFFICIENT_CAUCHY, MAD_TO_SIGMA
from colmap_vg.two_view.sampson import (
    Matches,
    cauchy_costs,
    frames,
    median_errors,
    moved,
    normal_equations,
    residuals,
)
from colmap_vg.two_view.segments import segment_sums

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

_MIN_SIGMA_PX = 0.02  # pixels; below the noise of real keypoints, and keeps the information of exact data finite
_TOLERANCES = (1e-2, 1e-5, 1e-7)  # relative cost change, one per round; early rounds are redone at the next scale
MAX_NUM_STEPS = 30
"""Maximum number of steps of each edge, all rounds together."""


@dataclass(frozen=True, eq=False)
class RefinedEdges:
    """Refined relative poses with their information matrices and residual statistics.

    Attributes
    ----------
    rotations : (m, 3, 3) array
        cam2_from_cam1 rotations.
    directions : (m, 3) array
        Unit directions of camera 2's centre in camera 1's frame.
    information : (m, 5, 5) array
        Inverse covariance of ``(w, tau)``, radians: the truth is ``exp(w) R`` (`w` in camera 2's frame) and
        ``d + B tau`` normalised, with ``B = tangent_basis(d)``. Zero for edges without matches.
    median_errors_px : (m,) array
        Median absolute Sampson error in pixels; NaN for edges without matches.
    sigmas_px : (m,) array
        Robust standard deviation of the Sampson error in pixels, corrected for the five fitted parameters.
    """

    rotations: Array
    directions: Array
    information: Array
    median_errors_px: Array
    sigmas_px: Array


def refine_relative_poses(
    offsets: IntArray,
    bearings1: Array,
    bearings2: Array,
    rotations: Array,
    directions: Array,
    focal_lengths1: Array,
    focal_lengths2: Array,
    *,
    max_num_steps: int = MAX_NUM_STEPS,
) -> RefinedEdges:
    """Minimise the Cauchy Sampson error of each edge over its relative pose, and estimate its information matrix.

    The Cauchy scale follows the median error of each edge, in three rounds. The information is the inverse of the
    sandwich covariance of an M-estimator with one noise level per edge (Huber & Ronchetti, Robust Statistics, §7.6), so
    it depends neither on the robust weights nor on an assumed keypoint noise. Correlations between pairs that share
    keypoints are not included.

    Parameters
    ----------
    offsets : (m + 1,) int array
        Matches of edge k are rows ``offsets[k]:offsets[k + 1]``; edges without matches are returned unchanged.
    bearings1, bearings2 : (k, 3) array
        Unit rays of the matches.
    rotations : (m, 3, 3) array
        cam2_from_cam1 rotations to start from.
    directions : (m, 3) array
        Directions of camera 2's centre in camera 1's frame to start from.
    focal_lengths1, focal_lengths2 : (m,) array
        Focal lengths of each edge's cameras, pixels.
    max_num_steps : int
        Most steps per edge, all rounds together, rounded up to a multiple of their number; with none the poses stay. An
        edge stops when its cost does.

    Returns
    -------
    RefinedEdges
    """
    filled = np.flatnonzero(np.diff(offsets) > 0)
    m = len(rotations)
    R, d = rotations.astype(np.float64), normalized(directions.astype(np.float64))
    information, median, sigma = np.zeros((m, 5, 5)), np.full(m, np.nan), np.full(m, np.nan)
    matches = Matches.of_rays(offsets, bearings1, bearings2, focal_lengths1**-2.0, focal_lengths2**-2.0).of(filled)
    most = -(-max_num_steps // len(_TOLERANCES))
    for tolerance in _TOLERANCES if most else ():
        scale = EFFICIENT_CAUCHY * _robust_sigmas(matches, R[filled], d[filled])
        R[filled], d[filled] = _levenberg(matches, R[filled], d[filled], scale, most, tolerance)
    median[filled], sigma[filled] = _medians_and_sigmas(matches, R[filled], d[filled])
    information[filled] = _information(matches, R[filled], d[filled], sigma[filled])
    return RefinedEdges(R, d, information, median, sigma)


def _levenberg(
    matches: Matches, R: Array, d: Array, scale: Array, num_iterations: int, tolerance: float
) -> tuple[Array, Array]:
    """Levenberg-Marquardt at a fixed Cauchy scale (m,) in pixels; each edge stops when its own cost has converged."""
    R, d = R.copy(), d.copy()
    damping = np.full(len(R), 1e-4)
    active = np.arange(len(R))
    for _ in range(num_iterations):
        report_progress("relative poses")
        at_work = matches.of(active)
        at = normal_equations(at_work, R[active], d[active], scale[active])
        cost, gradient, hessian = at.costs, at.gradients, at.newton_hessians
        diagonal = np.einsum("maa->ma", hessian)
        # Marquardt's scaling, with a floor so that a direction that no match constrains does not change.
        level = damping[active, None] * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-30
        step = -np.linalg.solve(hessian + level[:, :, None] * np.eye(5), gradient[:, :, None])[:, :, 0]
        # The linearisation is not valid beyond a radian.
        step = step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1.0)
        new_R, new_d = moved(R[active], d[active], step)
        new_cost = cauchy_costs(at_work, new_R, new_d, scale[active])
        better = new_cost < cost
        R[active[better]], d[active[better]] = new_R[better], new_d[better]
        damping[active] = np.clip(damping[active] * np.where(better, 0.1, 10.0), 1e-10, 1e8)
        still = np.abs(cost - new_cost) <= tolerance * cost
        active = active[~still & (damping[active] < 1e6)]
        if not len(active):
            break
    return so3.project(R), d


def _medians_and_sigmas(matches: Matches, R: Array, d: Array) -> tuple[Array, Array]:
    median = median_errors(matches, R, d)
    count = matches.counts
    return median, MAD_TO_SIGMA * median * np.sqrt(count / np.maximum(count - 5, 1))


def _robust_sigmas(matches: Matches, R: Array, d: Array) -> Array:
    return np.maximum(_medians_and_sigmas(matches, R, d)[1], _MIN_SIGMA_PX)


def _information(matches: Matches, R: Array, d: Array, sigma: Array) -> Array:
    """Inverse covariance in ``(w, tau)``: ``(J^T W J / mean w) (mean psi')^2 / mean psi^2``, (m, 5, 5)."""
    scale = EFFICIENT_CAUCHY * np.maximum(sigma, _MIN_SIGMA_PX)
    hessian = normal_equations(matches, R, d, scale).hessians
    offsets, count = matches.pieces.offsets, matches.counts
    ratio = np.square(residuals(matches, R, d) / np.repeat(scale, count))
    weight = 1.0 / (1.0 + ratio)
    rows = np.stack([weight, (1.0 - ratio) * weight * weight, ratio * weight * weight], axis=1)
    sums = segment_sums(offsets, rows).T
    sums[2] *= np.square(scale)
    mean_weight, mean_slope = sums[0] / count, np.maximum(sums[1] / count, 0.1)
    squared_psi = sums[2] / np.maximum(count - 5, 1)
    variance = np.maximum(squared_psi / np.square(mean_slope), _MIN_SIGMA_PX**2)
    _, axes = frames(R, d)
    turn = np.zeros((len(R), 5, 5))
    turn[:, :3, :3] = axes
    turn[:, 3, 3] = turn[:, 4, 4] = 1.0
    return np.asarray(turn @ hessian @ np.swapaxes(turn, 1, 2) / (mean_weight * variance)[:, None, None])
