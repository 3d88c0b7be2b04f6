"""Focal lengths of cameras by robust voting over the fundamental matrices of their pairs.

Every pair gives a cost curve over the focal length (see :mod:`colmap_vg.calibration.focal_curves`). The robust costs of
all pairs of a camera are summed on a logarithmic grid, then on a finer grid around the minimum, which a parabola
refines.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.calibration.focal_curves import (
    CAUCHY_SCALE,
    HIGHEST,
    LOWEST,
    FocalCurves,
    curves_of_each_camera,
    curves_of_one_camera,
    focal_curves,
)
from colmap_vg.events import report_progress
from colmap_vg.linear.assembly import sum_at_nodes

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_COARSE_LOG_FOCALS = np.linspace(LOWEST, HIGHEST, 160)  # log of focal over image size, steps of 1.8 %
_FINE_SHIFTS = np.linspace(-0.036, 0.036, 41)  # log factor around the coarse minimum, steps of 0.18 %
_COMMON_SHIFTS = np.linspace(-0.5, 0.5, 41)  # log factor on all cameras together, between sweeps
_MAX_FITTING_COST = CAUCHY_SCALE**2 * np.log(2.0)  # squared standard deviations; cost of a pair three of them off
_MIN_SUPPORTING_RISE = 4.0  # squared standard deviations; least cost increase 25 % away for a pair to support a focal
_NEARBY = np.log(1.25)  # log factor at which support is tested


@dataclass(frozen=True, eq=False)
class FocalEstimates:
    """Focal lengths estimated from fundamental matrices, with their uncertainty and support.

    Attributes
    ----------
    focal_lengths : (c,) array
        Pixels. Cameras without usable pairs get the common ratio of focal length to image size.
    sigmas : (c,) array
        Standard deviation of the log focal length with the other cameras fixed, from the curvature of the cost;
        infinite without a minimum.
    support : (c,) int64 array
        Number of pairs of the camera that fit its focal length, but neither one 25 % away nor a joint change of both
        cameras by as much.
    num_pairs : (c,) int64 array
        Number of pairs of the camera with a usable fundamental matrix.
    reliable : (c,) bool array
        Whether at least `min_support` pairs support the focal length and its standard deviation is at most `max_sigma`.
    common_ratio : float
        Focal length over the longer image side of best total cost if all cameras share it.
    """

    focal_lengths: Array
    sigmas: Array
    support: IntArray
    num_pairs: IntArray
    reliable: BoolArray
    common_ratio: float


@dataclass(frozen=True, eq=False)
class FocalAgreement:
    """Agreement of given focal lengths with the fundamental matrices.

    Attributes
    ----------
    ratios : (c,) array
        Given over estimated focal length.
    excess_costs : (c,) array
        Cost at the given minus cost at the estimated focal length, per supporting pair, squared standard deviations;
        0 without support.
    contradicted : (c,) bool array
        Whether the estimate is reliable, the ratio is outside the tolerance, and the excess cost above its threshold.
    estimates : FocalEstimates
    """

    ratios: Array
    excess_costs: Array
    contradicted: BoolArray
    estimates: FocalEstimates


def vote_focal_lengths(
    F: Array,
    edges: IntArray,
    principal_points: Array,
    image_sizes: Array,
    *,
    covariances: Array | None = None,
    num_inliers: IntArray | None = None,
    aspect_ratios: Array | None = None,
    min_support: int = 3,
    max_sigma: float = 0.03,
    num_sweeps: int = 20,
) -> FocalEstimates:
    """Estimate the focal length of each camera from the fundamental matrices of its pairs.

    All cameras start from one common ratio of focal length to image size. Damped sweeps then minimise the cost of each
    camera with the others fixed; after each sweep all focal lengths are scaled by a common factor of least total cost.

    Parameters
    ----------
    F : (m, 3, 3) array
        Fundamental matrices on undistorted pixels, ``x2^T F x1 = 0``, of any scale. Rows with NaN are ignored.
    edges : (m, 2) int array
        Camera rows of each pair (not image rows); equal for two images of one camera.
    principal_points : (c, 2) array
        Pixels.
    image_sizes : (c,) or (c, 2) array
        Pixels; of width and height the larger is used.
    covariances : (m, 9, 9) array, optional
        Covariances of the row-major ``vec(F)``, from `fundamental_covariances`. Recommended: without them planar pairs,
        which do not determine the focal length, have the same weight as others.
    num_inliers : (m,) array, optional
        Number of matches of each pair, used only without `covariances`. Default: 100.
    aspect_ratios : (c,) array, optional
        Vertical over horizontal focal length. Default: 1. The focal length returned is the horizontal one.
    min_support : int
        See `FocalEstimates`.
    max_sigma : float
        See `FocalEstimates`.
    num_sweeps : int
        Maximum number of sweeps if there are several cameras.

    Returns
    -------
    FocalEstimates

    Raises
    ------
    GraphError
        No pair has a finite fundamental matrix, or an edge has a camera row out of range.
    """
    size = _sizes(image_sizes)
    curves = focal_curves(F, edges, principal_points, size, covariances, num_inliers, aspect_ratios)
    found, _ = _vote(curves, size, min_support, max_sigma, num_sweeps)
    return found


def focal_agreement(
    focal_lengths: Array,
    F: Array,
    edges: IntArray,
    principal_points: Array,
    image_sizes: Array,
    *,
    covariances: Array | None = None,
    num_inliers: IntArray | None = None,
    aspect_ratios: Array | None = None,
    min_support: int = 3,
    max_sigma: float = 0.03,
    num_sweeps: int = 20,
    tolerance: float = 0.05,
    min_excess_cost: float = 1.0,
) -> FocalAgreement:
    """Compare given focal lengths with those estimated from the fundamental matrices.

    Parameters
    ----------
    focal_lengths : (c,) array
        Given focal lengths, pixels.
    F, edges, principal_points, image_sizes, covariances, num_inliers, aspect_ratios, min_support, max_sigma, num_sweeps
        As for :func:`vote_focal_lengths`.
    tolerance : float
        Largest relative difference that is accepted in any case; it includes the error of the estimate.
    min_excess_cost : float
        Excess cost per supporting pair above which the given focal length is contradicted, squared standard deviations.

    Returns
    -------
    FocalAgreement
    """
    size = _sizes(image_sizes)
    curves = focal_curves(F, edges, principal_points, size, covariances, num_inliers, aspect_ratios)
    found, sides = _vote(curves, size, min_support, max_sigma, num_sweeps)
    log_given, log_found = np.log(focal_lengths / size), np.log(found.focal_lengths / size)
    # Only the focal length of the camera in question changes; the others stay at their estimates.
    at_given, at_found = (sides.costs(at[sides.camera][:, None], log_found)[:, 0] for at in (log_given, log_found))
    excess = sum_at_nodes(len(size), sides.camera, at_given - at_found)
    excess = np.where(found.support > 0, excess / np.maximum(found.support, 1), 0.0)
    outside: BoolArray = np.abs(log_given - log_found) > np.maximum(np.log1p(tolerance), 3.0 * found.sigmas)
    contradicted = found.reliable & outside & (excess > min_excess_cost)
    return FocalAgreement(focal_lengths / found.focal_lengths, excess, np.asarray(contradicted), found)


def _vote(
    curves: FocalCurves, size: Array, min_support: int, max_sigma: float, num_sweeps: int
) -> tuple[FocalEstimates, FocalCurves]:
    c = len(size)
    # Start from one ratio of focal length to image size for all cameras, which is right for most image folders.
    common, _ = _minimized(curves_of_one_camera(curves), np.zeros(1))
    log_focals = np.full(c, common[0])
    sides = curves_of_each_camera(curves, log_focals)
    several = bool((sides.cameras[:, 0] != sides.cameras[:, 1]).any())
    sigmas = np.full(c, np.inf)
    for _ in range(num_sweeps if several else 1):
        report_progress("focal lengths")
        best, sigmas = _minimized(sides, log_focals)
        # Pairs of two cameras determine mostly the product of their focals: full steps of both would overshoot.
        step = np.where(np.isfinite(sigmas), best - log_focals, 0.0) * (0.6 if several else 1.0)
        if several:
            step = step + _common_shift(sides, log_focals + step)
        log_focals = np.clip(log_focals + step, LOWEST, HIGHEST)
        if np.abs(step).max(initial=0.0) < 1e-4:
            break
    num_pairs = np.bincount(sides.camera, minlength=c).astype(np.int64)
    support = _support(sides, log_focals)
    reliable = (support >= min_support) & (sigmas <= max_sigma)
    found = FocalEstimates(np.exp(log_focals) * size, sigmas, support, num_pairs, reliable, float(np.exp(common[0])))
    return found, sides


def _minimized(curves: FocalCurves, log_focals: Array) -> tuple[Array, Array]:
    """Best log focal of each camera with the others fixed, and its standard deviation: (c,), (c,)."""
    c, o = len(log_focals), len(curves.camera)
    total = sum_at_nodes(
        c, curves.camera, curves.costs(np.broadcast_to(_COARSE_LOG_FOCALS, (o, len(_COARSE_LOG_FOCALS))), log_focals)
    )
    center = _COARSE_LOG_FOCALS[np.argmin(total, axis=1)]
    fine = center[:, None] + _FINE_SHIFTS
    total = sum_at_nodes(c, curves.camera, curves.costs(fine[curves.camera], log_focals))
    row, k = np.arange(c), np.clip(np.argmin(total, axis=1), 1, len(_FINE_SHIFTS) - 2)
    before, at, after = total[row, k - 1], total[row, k], total[row, k + 1]
    curvature, width = before - 2.0 * at + after, _FINE_SHIFTS[1] - _FINE_SHIFTS[0]
    inside = (curvature > 0) & (at <= before) & (at <= after) & (center > LOWEST) & (center < HIGHEST)
    shift = np.where(inside, 0.5 * (before - after) / np.where(inside, curvature, 1.0), 0.0)
    # The cost is a chi-square: twice its inverse second derivative is the variance.
    sigma = np.where(inside, width * np.sqrt(2.0 / np.where(inside, curvature, 1.0)), np.inf)
    return fine[row, k] + width * shift, sigma


def _common_shift(curves: FocalCurves, log_focals: Array) -> float:
    """Change of all log focals together of least total cost, which sweeps over single cameras are slow to find."""
    shift = 0.0
    for grid in (_COMMON_SHIFTS, _FINE_SHIFTS):
        shifted = log_focals[:, None] + (shift + grid)
        shift += float(grid[np.argmin(curves.costs(shifted[curves.camera], shifted).sum(axis=0))])
    return shift


def _support(curves: FocalCurves, log_focals: Array) -> IntArray:
    at = log_focals[curves.camera][:, None]
    cost = curves.costs(at + np.array([0.0, -_NEARBY, _NEARBY]), log_focals)
    # A pair may determine the product of two focals only: require that a joint change of both is rejected, too.
    joint = [curves.costs(at + shift, log_focals + shift)[:, 0] for shift in (-_NEARBY, _NEARBY)]
    lowest = np.minimum(cost[:, 1:].min(axis=1), np.minimum(*joint))
    supports = (cost[:, 0] <= _MAX_FITTING_COST) & (lowest >= cost[:, 0] + _MIN_SUPPORTING_RISE)
    return np.bincount(curves.camera[supports], minlength=len(log_focals)).astype(np.int64)


def _sizes(image_sizes: Array) -> Array:
    return np.asarray(image_sizes if image_sizes.ndim == 1 else image_sizes.max(axis=1), dtype=np.float64)
