"""Focal lengths of cameras, voted by the fundamental matrices of all their pairs at once.

Every pair gives a curve over the focal length (see :mod:`colmap_vg.calibration.focal_curves`); cameras sum saturating
costs of their pairs on a logarithmic grid, then on a finer one around the best, and take the parabola's minimum.
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
from colmap_vg.linear.assembly import sum_at_nodes

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_COARSE = np.linspace(LOWEST, HIGHEST, 160)  # steps of 1.8 %
_FINE = np.linspace(-0.036, 0.036, 41)  # around the coarse minimum, steps of 0.18 %
_SHIFTS = np.linspace(-0.5, 0.5, 41)  # of all cameras together, between sweeps
_FITTING_COST = CAUCHY_SCALE**2 * np.log(2.0)  # of a pair three standard deviations off
_SUPPORTING_RISE = 4.0  # a pair supports a focal if one 25 % away costs it so much more
_NEARBY = np.log(1.25)


@dataclass(frozen=True, eq=False)
class FocalEstimates:
    """Focal lengths voted by pairs.

    Attributes
    ----------
    focal_lengths : (c,) array
        Pixels. Cameras without a vote of their own get the common ratio of focal length to image size.
    sigmas : (c,) array
        Standard deviation of the logarithm of the focal length with the other cameras' held, from the cost's curvature;
        infinite without a minimum.
    support : (c,) int64 array
        Pairs of the camera that fit its focal length, and would fit neither one 25 % away nor both cameras' changed
        together by as much.
    num_pairs : (c,) int64 array
        All pairs of the camera that had a vote.
    reliable : (c,) bool array
        At least `min_support` pairs, and a standard deviation of at most `max_sigma`.
    common_ratio : float
        The focal length over the longer image side that all pairs vote for as if all cameras shared it.
    """

    focal_lengths: Array
    sigmas: Array
    support: IntArray
    num_pairs: IntArray
    reliable: BoolArray
    common_ratio: float


@dataclass(frozen=True, eq=False)
class FocalAgreement:
    """Whether given focal lengths agree with the fundamental matrices.

    Attributes
    ----------
    ratios : (c,) array
        Given over voted focal length.
    excess_costs : (c,) array
        Cost at the given focal length less that at the voted one, per supporting pair; 0 without support.
    contradicted : (c,) bool array
        The vote is reliable, the ratio is outside the tolerance, and the pairs pay for it.
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
    """Focal length of each camera from the fundamental matrices of its pairs.

    All cameras are first taken to share one ratio of focal length to image size; then each follows its own pairs while
    the others hold, in damped sweeps, between which all move together.

    Parameters
    ----------
    F : (m, 3, 3) array
        Fundamental matrices on undistorted pixels, ``x2^T F x1 = 0``, of any scale. Rows with NaN have no vote.
    edges : (m, 2) int array
        Camera rows of each pair (not image rows); equal for two images of one camera.
    principal_points : (c, 2) array
        Pixels.
    image_sizes : (c,) or (c, 2) array
        Pixels; of two, the larger counts.
    covariances : (m, 9, 9) array, optional
        Of the row-major ``vec(F)``, from `fundamental_covariances`. Strongly advised: without them planar pairs count
        as much as others.
    num_inliers : (m,) array, optional
        Matches of each pair, used only without `covariances`; 100 where missing.
    aspect_ratios : (c,) array, optional
        Vertical over horizontal focal length; 1 where missing. The focal length returned is the horizontal one.
    min_support : int
        See `FocalEstimates`.
    max_sigma : float
        See `FocalEstimates`.
    num_sweeps : int
        Most sweeps over the cameras, when there are several.

    Returns
    -------
    FocalEstimates

    Raises
    ------
    GraphError
        No pair has a fundamental matrix, or a row points outside the cameras.
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
    """Whether given focal lengths can be trusted: their cost against that of the voted ones.

    Parameters
    ----------
    focal_lengths : (c,) array
        Given focal lengths, pixels.
    F, edges, principal_points, image_sizes, covariances, num_inliers, aspect_ratios, min_support, max_sigma, num_sweeps
        As for :func:`vote_focal_lengths`.
    tolerance : float
        Relative difference that is never held against a given focal length; the vote's own error is part of it.
    min_excess_cost : float
        Cost per supporting pair, in units of squared standard deviations.

    Returns
    -------
    FocalAgreement
    """
    size = _sizes(image_sizes)
    curves = focal_curves(F, edges, principal_points, size, covariances, num_inliers, aspect_ratios)
    found, sides = _vote(curves, size, min_support, max_sigma, num_sweeps)
    log_given, log_found = np.log(focal_lengths / size), np.log(found.focal_lengths / size)
    # Only the camera in question moves; the others stay at the vote.
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
    # First as if all cameras had one ratio of focal to size: the majority's, and right for most folders.
    common, _ = _minimized(curves_of_one_camera(curves), np.zeros(1))
    log_focals = np.full(c, common[0])
    sides = curves_of_each_camera(curves, log_focals)
    several = bool((sides.cameras[:, 0] != sides.cameras[:, 1]).any())
    sigmas = np.full(c, np.inf)
    for _ in range(num_sweeps if several else 1):
        best, sigmas = _minimized(sides, log_focals)
        # Two cameras' focals are mostly known as a product: full steps of both would overshoot.
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
    """Best log focal of each camera with the others held, and its standard deviation: (c,), (c,)."""
    c, o = len(log_focals), len(curves.camera)
    total = sum_at_nodes(c, curves.camera, curves.costs(np.broadcast_to(_COARSE, (o, len(_COARSE))), log_focals))
    center = _COARSE[np.argmin(total, axis=1)]
    fine = center[:, None] + _FINE
    total = sum_at_nodes(c, curves.camera, curves.costs(fine[curves.camera], log_focals))
    row, k = np.arange(c), np.clip(np.argmin(total, axis=1), 1, len(_FINE) - 2)
    before, at, after = total[row, k - 1], total[row, k], total[row, k + 1]
    bend, width = before - 2.0 * at + after, _FINE[1] - _FINE[0]
    inside = (bend > 0) & (at <= before) & (at <= after) & (center > LOWEST) & (center < HIGHEST)
    shift = np.where(inside, 0.5 * (before - after) / np.where(inside, bend, 1.0), 0.0)
    # The cost is a chi-square: twice its inverse second derivative is the variance.
    sigma = np.where(inside, width * np.sqrt(2.0 / np.where(inside, bend, 1.0)), np.inf)
    return fine[row, k] + width * shift, sigma


def _common_shift(curves: FocalCurves, log_focals: Array) -> float:
    """Change of all cameras together that costs least: what sweeps over single cameras are slow to find."""
    shift = 0.0
    for grid in (_SHIFTS, _FINE):
        shifted = log_focals[:, None] + (shift + grid)
        shift += float(grid[np.argmin(curves.costs(shifted[curves.camera], shifted).sum(axis=0))])
    return shift


def _support(curves: FocalCurves, log_focals: Array) -> IntArray:
    at = log_focals[curves.camera][:, None]
    cost = curves.costs(at + np.array([0.0, -_NEARBY, _NEARBY]), log_focals)
    # With the other camera held a pair may know the product of two focals only: it must also see both change together.
    joint = [curves.costs(at + shift, log_focals + shift)[:, 0] for shift in (-_NEARBY, _NEARBY)]
    lowest = np.minimum(cost[:, 1:].min(axis=1), np.minimum(*joint))
    supports = (cost[:, 0] <= _FITTING_COST) & (lowest >= cost[:, 0] + _SUPPORTING_RISE)
    return np.bincount(curves.camera[supports], minlength=len(log_focals)).astype(np.int64)


def _sizes(image_sizes: Array) -> Array:
    return np.asarray(image_sizes if image_sizes.ndim == 1 else image_sizes.max(axis=1), dtype=np.float64)
