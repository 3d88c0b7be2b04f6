"""Focal length from the cycle consistency of relative rotations, for scenes whose single pairs do not determine it.

On a turntable, where optical axes meet at equal distances, every focal length gives each pair a valid essential matrix;
only the rotation angle changes. The angles of several pairs still have to be consistent: with a wrong focal length,
rotations around cycles of the view graph do not compose to the identity. For each focal length on a grid, relative
poses are computed from the fundamental matrices, refined for a few steps and averaged robustly. The cost is the sum of
``c^2 log(1 + r^2 / (c^2 (v + s^2)))`` with the residual angles ``r``, the mean variance ``v`` of the three rotation
parameters of each edge, and the model error ``s``. The minimum is refined on finer grids and by a parabola.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.calibration.focal_curves import CAUCHY_SCALE
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.rotations.robust import average_rotations_robust
from colmap_vg.scene.components import components_by_size
from colmap_vg.two_view.edge_information import refine_relative_poses
from colmap_vg.two_view.essential import essential_from_fundamental, poses_from_essential
from colmap_vg.two_view.segments import rows_of_segments, segment_of_rows, segment_subset

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_COARSE_LOG_FACTORS = np.linspace(np.log(0.4), np.log(4.5), 15)  # steps of 19 %
_FINE_STEPS = (0.06, 0.02)  # log factor; steps of the two finer grids, about a third of the step before
_NEARLY_LOWEST = 1.25  # coarse minima up to this times the lowest are looked at closely: refinement changes 10 %
_NUM_FINE = 3  # values of a finer grid on each side of the minimum
_MATCHES_PER_PAIR = 100
_NUM_STEPS = 6  # Levenberg-Marquardt steps; the nearest essential matrix is within a few standard deviations
_NUM_COARSE_STEPS = 3  # on the coarse grid, whose neighbours differ by far more
_MODEL_SIGMA = 1e-3  # radians; error of the lens model and correlation of keypoints, beside the noise of the matches
_AVERAGING_SIGMA_DEG = 2.0  # degrees; scale of the robust rotation averaging
_SIDE = np.log(1.25)  # log factor at which the rise of the cost is measured
_CHECKED_SHIFT = 0.1  # log factor at which given focal lengths are compared


@dataclass(frozen=True, eq=False)
class CycleVote:
    """Focal lengths of best cycle consistency, with the cost curve.

    Attributes
    ----------
    factor : float
        Common factor on the unit focal lengths of the estimated cameras.
    focal_lengths : (c,) array
        Pixels; unchanged for the other cameras.
    log_factors, costs : (g,) array
        The evaluated cost curve: sums of robust squared residuals, in squared standard deviations.
    rise : float
        Cost 25 % away, on the side where it is lower, over the cost at the minimum.
    reliable : bool
        Whether the minimum is inside the range, the cost 25 % away on both sides is more than a tenth and more than 9
        above it, and the graph has at least three independent cycles.
    """

    factor: float
    focal_lengths: Array
    log_factors: Array
    costs: Array
    rise: float
    reliable: bool


@dataclass(frozen=True, eq=False)
class CyclePairs:
    """Pairs of the largest connected component, with a subsample of their matches.

    Attributes
    ----------
    num_images : int
    images : (m, 2) int64 array
        Images of each pair, renumbered from zero.
    cameras : (m, 2) int array
        Camera rows of each pair.
    F : (m, 3, 3) array
        Fundamental matrices on undistorted pixels.
    offsets : (m + 1,) int64 array
    points1, points2 : (k, 2) array
        Matched keypoints, undistorted pixels.
    """

    num_images: int
    images: IntArray
    cameras: IntArray
    F: Array
    offsets: IntArray
    points1: Array
    points2: Array


def vote_focal_by_rotation_cycles(
    pairs: CyclePairs, unit_focal_lengths: Array, aspect_ratios: Array, principal_points: Array, estimated: BoolArray
) -> CycleVote:
    """Estimate the common factor on the focal lengths of some cameras at which rotation cycles are most consistent.

    Intended for cameras whose estimates by :func:`colmap_vg.calibration.focal.vote_focal_lengths` are not reliable.

    Parameters
    ----------
    pairs : CyclePairs
    unit_focal_lengths : (c,) array
        Pixels. For cameras to estimate the length that the factor multiplies, such as the longer image side; for the
        others their focal length.
    aspect_ratios : (c,) array
        Vertical over horizontal focal length.
    principal_points : (c, 2) array
        Pixels.
    estimated : (c,) bool array
        Cameras whose focal length is estimated.

    Returns
    -------
    CycleVote
    """

    def cost(log_factor: float, num_steps: int = _NUM_STEPS) -> float:
        focal = unit_focal_lengths * np.where(estimated, np.exp(log_factor), 1.0)
        return _cycle_cost(pairs, focal, focal * aspect_ratios, principal_points, num_steps)

    curve = {float(x): cost(float(x), _NUM_COARSE_STEPS) for x in _COARSE_LOG_FACTORS}
    centers, fine = _lowest_minima(_COARSE_LOG_FACTORS, np.array(list(curve.values()))), dict[float, float]()
    for step in _FINE_STEPS:
        around = (centers[:, None] + step * np.arange(-_NUM_FINE, _NUM_FINE + 1)).ravel()
        fine.update({float(x): cost(float(x)) for x in around if float(x) not in fine})
        centers = np.array([min(fine, key=lambda x: fine[x])])
    curve.update(fine)
    x = np.array(sorted(curve))
    y = np.array([curve[v] for v in x])
    log_factor, lowest = _parabola(x, y)
    sides = np.interp([log_factor - _SIDE, log_factor + _SIDE], x, y)
    num_cycles = len(pairs.images) - pairs.num_images + 1
    inside = _COARSE_LOG_FACTORS[0] < log_factor < _COARSE_LOG_FACTORS[-1]
    rises = sides.min() > 1.1 * lowest and sides.min() > lowest + 9.0
    factor = float(np.exp(log_factor))
    return CycleVote(
        factor,
        unit_focal_lengths * np.where(estimated, factor, 1.0),
        x,
        y,
        float(sides.min() / max(lowest, 1e-300)),
        bool(inside and rises and num_cycles >= 3),
    )


def focal_fits_cycles(
    pairs: CyclePairs, focal_lengths: Array, aspect_ratios: Array, principal_points: Array, estimated: BoolArray
) -> bool:
    """Whether neither 10 % longer nor 10 % shorter focal lengths of some cameras make rotation cycles more consistent.

    Parameters
    ----------
    pairs, aspect_ratios, principal_points, estimated
        As for :func:`vote_focal_by_rotation_cycles`.
    focal_lengths : (c,) array
        Pixels.

    Returns
    -------
    bool
    """
    factors = [np.where(estimated, np.exp(shift), 1.0) for shift in (0.0, -_CHECKED_SHIFT, _CHECKED_SHIFT)]
    at, shorter, longer = (
        _cycle_cost(pairs, focal_lengths * f, focal_lengths * f * aspect_ratios, principal_points) for f in factors
    )
    return min(shorter, longer) >= at


def select_cycle_pairs(
    F: Array,
    edges: IntArray,
    camera_idx: IntArray,
    offsets: IntArray,
    points1: Array,
    points2: Array,
    *,
    max_num_pairs: int = 1000,
    min_num_matches: int = 30,
) -> CyclePairs | None:
    """Select the pairs for :func:`vote_focal_by_rotation_cycles`; None if they connect fewer than three images.

    Parameters
    ----------
    F : (m, 3, 3) array
        Fundamental matrices on undistorted pixels, ``x2^T F x1 = 0``. Pairs with NaN are ignored.
    edges : (m, 2) int array
        Image rows of each pair.
    camera_idx : (n,) int array
        Camera row of each image.
    offsets : (m + 1,) int array
    points1, points2 : (k, 2) array
        Matched keypoints, pixels.
    max_num_pairs : int
        Maximum number of pairs; those with most matches are used.
    min_num_matches : int
        Pairs with fewer matches are ignored.

    Returns
    -------
    CyclePairs or None
    """
    count = np.diff(offsets)
    usable = np.flatnonzero(np.isfinite(F).all(axis=(1, 2)) & (count >= min_num_matches))
    strongest = np.sort(usable[np.argsort(-count[usable], kind="stable")[:max_num_pairs]])
    component = components_by_size(len(camera_idx), edges[strongest])
    chosen = strongest[component[edges[strongest, 0]] == 0]
    images, renumbered = np.unique(edges[chosen], return_inverse=True)
    if len(images) < 3:
        return None
    rows, of_chosen = rows_of_segments(offsets, chosen)
    place = np.arange(len(rows)) - of_chosen[:-1][segment_of_rows(of_chosen)]
    stride = np.maximum(count[chosen] // _MATCHES_PER_PAIR, 1)[segment_of_rows(of_chosen)]
    keep = place % stride == 0
    return CyclePairs(
        len(images),
        renumbered.reshape(-1, 2).astype(np.int64),
        camera_idx[edges[chosen]],
        F[chosen],
        segment_subset(of_chosen, keep),
        points1[rows[keep]],
        points2[rows[keep]],
    )


def _cycle_cost(
    pairs: CyclePairs, focal_x: Array, focal_y: Array, principal_points: Array, num_steps: int = _NUM_STEPS
) -> float:
    calibration = np.zeros((len(focal_x), 3, 3))
    calibration[:, 0, 0], calibration[:, 1, 1], calibration[:, 2, 2] = focal_x, focal_y, 1.0
    calibration[:, :2, 2] = principal_points
    first, second = pairs.cameras.T
    E = essential_from_fundamental(pairs.F, calibration[first], calibration[second])
    edge = segment_of_rows(pairs.offsets)
    rays = []
    for points, camera in ((pairs.points1, first[edge]), (pairs.points2, second[edge])):
        x = (points - principal_points[camera]) / np.stack([focal_x, focal_y], axis=1)[camera]
        rays.append(normalized(np.concatenate([x, np.ones((len(x), 1))], axis=1)))
    poses = poses_from_essential(E, pairs.offsets, rays[0], rays[1])
    refined = refine_relative_poses(
        pairs.offsets,
        rays[0],
        rays[1],
        poses.rotations,
        poses.directions,
        focal_x[first],
        focal_x[second],
        max_num_steps=num_steps,
    )
    # Unobservable parameters get a standard deviation of a radian instead of an infinite one.
    covariance = np.linalg.inv(refined.information + np.eye(5))[:, :3, :3]
    # One variance per edge: full covariances overweight the best-known axes, whose errors the model error dominates (on
    # temple the focal length was 3 % off with full covariances, 2 % with one variance).
    weights = 1.0 / (np.trace(covariance, axis1=1, axis2=2) / 3.0 + _MODEL_SIGMA**2)
    averaged = average_rotations_robust(
        pairs.num_images,
        pairs.images,
        refined.rotations,
        weights / np.median(weights),
        sigma_deg=_AVERAGING_SIGMA_DEG,
        adapt_sigma=False,
    ).cam_from_world_rotations
    solved = averaged[pairs.images[:, 1]] @ np.swapaxes(averaged[pairs.images[:, 0]], 1, 2)
    residual = so3.log(solved @ np.swapaxes(refined.rotations, 1, 2))
    squared = np.einsum("ma,ma->m", residual, residual) * weights
    return float((CAUCHY_SCALE**2 * np.log1p(squared / CAUCHY_SCALE**2)).sum())


def _lowest_minima(x: Array, y: Array) -> Array:
    """Locations of the local minima, ends included, that are nearly as low as the lowest one."""
    around = np.concatenate([[np.inf], y, [np.inf]])
    return np.asarray(x[(y <= around[:-2]) & (y <= around[2:]) & (y <= _NEARLY_LOWEST * y.min())])


def _parabola(x: Array, y: Array) -> tuple[float, float]:
    """Location and value of the minimum of a least-squares parabola through the points around the lowest one."""
    k = int(np.argmin(y))
    near = slice(max(k - 2, 0), k + 3)
    quadratic, linear, constant = np.polyfit(x[near] - x[k], y[near], 2) if len(x[near]) > 2 else (0.0, 0.0, y[k])
    if quadratic <= 0:
        return float(x[k]), float(y[k])
    shift = float(np.clip(-linear / (2 * quadratic), x[near][0] - x[k], x[near][-1] - x[k]))
    return float(x[k]) + shift, float(min(y[k], constant - linear**2 / (4 * quadratic)))
