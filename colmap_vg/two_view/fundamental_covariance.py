"""Covariance matrices of the fundamental matrices of all edges, from their matches.

The Sampson cost is ``vec(F)^T M vec(F)`` with the weighted 9x9 moments M of the matches, so ``M / sigma^2`` is the
information of F, restricted to the seven directions that change neither its norm nor its rank (Hartley & Zisserman
§11.4.3; Csurka et al., Characterizing the uncertainty of the fundamental matrix, 1997).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.linear.robust_losses import EFFICIENT_CAUCHY, MAD_TO_SIGMA, cauchy_weight
from colmap_vg.two_view.eight_point import cofactors, weighted_moments
from colmap_vg.two_view.pieces import Pieces
from colmap_vg.two_view.sampson_errors import squared_errors_and_variances
from colmap_vg.two_view.segments import segment_quantiles

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

_MIN_SIGMA_PX = 0.15  # pixels; below this the unmodelled distortion dominates the keypoint noise


@dataclass(frozen=True, eq=False)
class FundamentalCovariances:
    """Covariances of fundamental matrices.

    Attributes
    ----------
    covariances : (m, 9, 9) array
        Covariances of the row-major ``vec(F)`` in the scale of the given F; rank seven.
    sigmas_px : (m,) array
        Robust standard deviation of the Sampson error, corrected for the seven fitted parameters.
    """

    covariances: Array
    sigmas_px: Array


def fundamental_covariances(
    offsets: IntArray, points1: Array, points2: Array, F: Array, *, max_effective_matches: float = np.inf
) -> FundamentalCovariances:
    """Covariance of each fundamental matrix from its matches.

    Parameters
    ----------
    offsets : (m + 1,) int array
        Every edge needs at least eight matches.
    points1, points2 : (k, 2) array
        Matched keypoints, pixels.
    F : (m, 3, 3) array
        Fitted fundamental matrices, ``x2^T F x1 = 0``, of rank two.
    max_effective_matches : float
        Largest number of matches that add information. Errors of the lens and keypoint models are systematic: they do
        not average out over more matches.

    Returns
    -------
    FundamentalCovariances
    """
    size = max(float(np.abs(points1).max(initial=1.0)), float(np.abs(points2).max(initial=1.0)))
    grow = np.array([size, size, 1.0])
    scaled = grow[:, None] * F * grow
    norm = np.linalg.norm(scaled, axis=(1, 2))
    unit = scaled / norm[:, None, None]
    moments, sigma = _information(offsets, points1 / size, points2 / size, unit, _MIN_SIGMA_PX / size)
    count = np.diff(offsets)
    moments *= np.minimum(1.0, max_effective_matches / np.maximum(count, 1))[:, None, None]
    fixed, _ = np.linalg.qr(np.stack([unit.reshape(-1, 9), cofactors(unit).reshape(-1, 9)], axis=2))
    free = np.eye(9) - fixed @ np.swapaxes(fixed, 1, 2)
    level = np.trace(moments, axis1=1, axis2=2)[:, None, None]
    # The relative floor bounds the covariance of directions that no match constrains (planar pairs).
    inverse = np.linalg.inv(free @ moments @ free + level * (np.eye(9) - free) + 1e-13 * level * np.eye(9))
    back = (norm[:, None, None] / np.outer(grow, grow)).reshape(-1, 9)
    covariances = back[:, :, None] * (free @ inverse @ free) * back[:, None, :]
    return FundamentalCovariances(covariances, sigma * size)


def _information(offsets: IntArray, points1: Array, points2: Array, F: Array, min_sigma: float) -> tuple[Array, Array]:
    ones = np.ones(len(points1))
    pieces = Pieces.cut(offsets, [*points1.T, ones, *points2.T, ones])
    squared, variance = squared_errors_and_variances(F, pieces, on_sphere=False)
    variance += 1e-300
    squared /= variance
    count = np.diff(offsets)
    median = np.sqrt(segment_quantiles(offsets, pieces.rows(squared)))
    sigma = np.maximum(MAD_TO_SIGMA * median * np.sqrt(count / np.maximum(count - 7, 1)), min_sigma)
    weights = cauchy_weight(squared / np.square(EFFICIENT_CAUCHY * sigma)[pieces.segments, None]) / variance
    return weighted_moments(pieces, weights) / np.square(sigma)[:, None, None], sigma
