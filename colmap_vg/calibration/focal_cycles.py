"""The focal length at which relative rotations close around cycles, for scenes whose single pairs cannot know it.

On a turntable, where optical axes meet at equal distances, any focal gives each pair an essential matrix, and only its
rotation angle changes. The angles of several pairs still have to agree: with a wrong focal, rotations around cycles of
the view graph do not close. For each focal on a grid, relative poses are taken from the fundamental matrices, refined
for a few steps, averaged robustly, and the residual angles ``r`` are compared with what each edge knows of its
rotation: ``c^2 log(1 + r^2 / (c^2 (v + s^2)))``, summed, ``v`` the mean variance of the edge's three rotation
parameters. The minimum is refined on finer grids and by a parabola.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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

_COARSE = np.linspace(np.log(0.4), np.log(4.5), 15)  # steps of 19 %
_FINER = (0.06, 0.02)  # half the step of the coarse grid and of the one after it: what the finer grids step by
_NUM_FINER = 3  # finer values on each side
_MATCHES_PER_PAIR = 100
_NUM_STEPS = 6  # Levenberg steps from the nearest essential matrix: it starts within a few sigma
_CAUCHY_SCALE = 3.0  # standard deviations
_MODEL_SIGMA = 1e-3  # radians; lens model and correlated keypoints beside the matches' own noise
_GATE_DEG = 2.0  # degrees, of the robust averaging
_SIDE = np.log(1.25)
_CHECKED_SHIFT = 0.1


@dataclass(frozen=True, eq=False)
class CycleVote:
    """The focal length that closes rotations around cycles.

    Attributes
    ----------
    factor : float
        On the unit focal lengths of the cameras asked, shared by them.
    focal_lengths : (c,) array
        Pixels; those of cameras not asked as they were.
    log_factors, costs : (g,) array
        The curve that was found: sums of saturating squared residuals, in squared standard deviations.
    rise : float
        Cost 25 % away, on the side where it is lower, over the cost at the minimum.
    reliable : bool
        The minimum lies inside the range, the curve rises by a tenth and by 9 on both sides, and the graph has cycles.
    """

    factor: float
    focal_lengths: Array
    log_factors: Array
    costs: Array
    rise: float
    reliable: bool


@dataclass(frozen=True, eq=False)
class CyclePairs:
    """Pairs of the largest component, their images renumbered, with a spread of their matches."""

    num_images: int
    images: IntArray
    cameras: IntArray
    F: Array
    offsets: IntArray
    points1: Array
    points2: Array


def vote_focal_by_rotation_cycles(
    pairs: CyclePairs, unit_focal_lengths: Array, aspect_ratios: Array, principal_points: Array, asked: BoolArray
) -> CycleVote:
    """Common factor on the focal lengths of the cameras asked at which relative rotations agree best.

    For cameras that :func:`colmap_vg.calibration.focal.vote_focal_lengths` calls unreliable.

    Parameters
    ----------
    pairs : CyclePairs
    unit_focal_lengths : (c,) array
        Pixels: for cameras asked what the factor applies to, such as the longer image side; for others their focal
        length.
    aspect_ratios : (c,) array
        Vertical over horizontal focal length.
    principal_points : (c, 2) array
        Pixels.
    asked : (c,) bool array

    Returns
    -------
    CycleVote
    """

    def cost(log_factor: float) -> float:
        focal = unit_focal_lengths * np.where(asked, np.exp(log_factor), 1.0)
        return _cycle_cost(pairs, focal, focal * aspect_ratios, principal_points)

    curve = {float(x): cost(float(x)) for x in _COARSE}
    for step in _FINER:
        center = min(curve, key=lambda x: curve[x])
        around = center + step * np.arange(-_NUM_FINER, _NUM_FINER + 1)
        curve.update({float(x): cost(float(x)) for x in around if float(x) not in curve})
    x = np.array(sorted(curve))
    y = np.array([curve[v] for v in x])
    log_factor, lowest = _parabola(x, y)
    sides = np.interp([log_factor - _SIDE, log_factor + _SIDE], x, y)
    num_cycles = len(pairs.images) - pairs.num_images + 1
    inside = _COARSE[0] < log_factor < _COARSE[-1]
    rises = sides.min() > 1.1 * lowest and sides.min() > lowest + 9.0
    factor = float(np.exp(log_factor))
    return CycleVote(
        factor,
        unit_focal_lengths * np.where(asked, factor, 1.0),
        x,
        y,
        float(sides.min() / max(lowest, 1e-300)),
        bool(inside and rises and num_cycles >= 3),
    )


def focal_fits_cycles(
    pairs: CyclePairs, focal_lengths: Array, aspect_ratios: Array, principal_points: Array, asked: BoolArray
) -> bool:
    """Whether neither longer nor shorter focal lengths of the cameras asked close rotations better: three costs only.

    Parameters
    ----------
    pairs, aspect_ratios, principal_points, asked
        As for :func:`vote_focal_by_rotation_cycles`.
    focal_lengths : (c,) array
        Pixels.

    Returns
    -------
    bool
    """
    factors = [np.where(asked, np.exp(shift), 1.0) for shift in (0.0, -_CHECKED_SHIFT, _CHECKED_SHIFT)]
    at, shorter, longer = (
        _cycle_cost(pairs, focal_lengths * f, focal_lengths * f * aspect_ratios, principal_points) for f in factors
    )
    return min(shorter, longer) >= at


def chosen_pairs(
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
    """The pairs that rotation cycles are looked for in; None where they connect fewer than three images.

    Parameters
    ----------
    F : (m, 3, 3) array
        Fundamental matrices on undistorted pixels, ``x2^T F x1 = 0``. Pairs with NaN are left out.
    edges : (m, 2) int array
        Image rows of each pair.
    camera_idx : (n,) int array
        Camera row of each image.
    offsets : (m + 1,) int array
    points1, points2 : (k, 2) array
        Matched keypoints, pixels.
    max_num_pairs : int
        Pairs with most matches that are used.
    min_num_matches : int
        Pairs with fewer are left out.

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


def _cycle_cost(pairs: CyclePairs, focal_x: Array, focal_y: Array, principal_points: Array) -> float:
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
        num_iterations=_NUM_STEPS,
    )
    # Unobservable directions get a standard deviation of a radian instead of an infinite one.
    covariance = np.linalg.inv(refined.information + np.eye(5))[:, :3, :3]
    # One variance per edge: full covariances gave the axes that are known best too much say over a model that is not
    # that good (temple, 2 instead of 3 % off with one).
    weights = 1.0 / (np.trace(covariance, axis1=1, axis2=2) / 3.0 + _MODEL_SIGMA**2)
    averaged = average_rotations_robust(
        pairs.num_images,
        pairs.images,
        refined.rotations,
        weights / np.median(weights),
        sigma_deg=_GATE_DEG,
        adapt_sigma=False,
    ).cam_from_world_rotations
    solved = averaged[pairs.images[:, 1]] @ np.swapaxes(averaged[pairs.images[:, 0]], 1, 2)
    residual = so3.log(solved @ np.swapaxes(refined.rotations, 1, 2))
    squared = np.einsum("ma,ma->m", residual, residual) * weights
    return float((_CAUCHY_SCALE**2 * np.log1p(squared / _CAUCHY_SCALE**2)).sum())


def _parabola(x: Array, y: Array) -> tuple[float, float]:
    """Place and value of the minimum of a least-squares parabola through the five lowest neighbours."""
    k = int(np.argmin(y))
    near = slice(max(k - 2, 0), k + 3)
    quadratic, linear, constant = np.polyfit(x[near] - x[k], y[near], 2) if len(x[near]) > 2 else (0.0, 0.0, y[k])
    if quadratic <= 0:
        return float(x[k]), float(y[k])
    shift = float(np.clip(-linear / (2 * quadratic), x[near][0] - x[k], x[near][-1] - x[k]))
    return float(x[k]) + shift, float(min(y[k], constant - linear**2 / (4 * quadratic)))
