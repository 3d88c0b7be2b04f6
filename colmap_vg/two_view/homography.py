"""Relative poses of planar pairs from homography decomposition, and pure rotations of pairs without a baseline.

A plane ``n^T X = h`` in camera 1's frame gives ``x2 ~ H x1`` with ``H = R + t n^T / h``. Faugeras & Lustman, Motion and
structure from motion in a piecewise planar environment (1988); the two solutions that remain when the plane lies in
front of camera 1 are given by Malis & Vargas, Deeper understanding of the homography decomposition (2007).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import angle_between, normalized
from colmap_vg.two_view.essential import RelativePoses, check_cheirality, essential_from_pose
from colmap_vg.two_view.sampson_errors import sampson_errors
from colmap_vg.two_view.segments import products_of_segments, segment_quantiles, segment_sums

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PlanarPoses:
    """The two relative poses of each homography, the better one first.

    The poses are ordered by the number of matches in front of both cameras, then by the median Sampson error.

    Attributes
    ----------
    better, alternative : RelativePoses
    normals : (2, m, 3) array
        Unit plane normals in camera 1's frame, pointing away from it; better first.
    median_errors : (2, m) array
        Median absolute Sampson error, radians; NaN for edges without matches.
    baseline_ratios : (m,) array
        ``|t| / h``: the baseline over the distance of the plane, equal for both poses. Near 0 the motion is a pure
        rotation and the directions are undetermined.
    """

    better: RelativePoses
    alternative: RelativePoses
    normals: Array
    median_errors: Array
    baseline_ratios: Array


@dataclass(frozen=True, eq=False)
class PureRotations:
    """Best pure rotation of each edge, under the assumption that the baseline is zero.

    Attributes
    ----------
    rotations : (m, 3, 3) array
        cam2_from_cam1 rotations.
    median_errors : (m,) array
        Median angle between ``R x1`` and ``x2``, radians; NaN for edges without matches.
    """

    rotations: Array
    median_errors: Array


def calibrated_homography(H: Array, K1: Array, K2: Array) -> Array:
    """Calibrated homographies ``K2^-1 H K1`` of pixel homographies ``x2 ~ H x1``, (m, 3, 3); K (m, 3, 3) or (3, 3)."""
    return np.asarray(np.linalg.solve(np.broadcast_to(K2, H.shape), H @ K1))


def poses_from_homography(H: Array, offsets: IntArray, bearings1: Array, bearings2: Array) -> PlanarPoses:
    """Decompose calibrated homographies into the two relative poses with the plane in front of camera 1.

    Parameters
    ----------
    H : (m, 3, 3) array
        Calibrated homographies, ``x2 ~ H x1``, of any scale and sign.
    offsets : (m + 1,) int array
        Matches of edge k are rows ``offsets[k]:offsets[k + 1]``.
    bearings1, bearings2 : (k, 3) array
        Unit rays of the matches.

    Returns
    -------
    PlanarPoses
        For ``H ~ R`` both rotations are R and the directions are arbitrary: see `baseline_ratios`.
    """
    # Both cameras lie on the same side of the plane, so det H > 0; the middle singular value of R + t n^T / h is 1.
    U, s, Vt = np.linalg.svd(H * np.where(np.linalg.det(H) < 0, -1.0, 1.0)[:, None, None])
    s = s / np.where(s[:, 1:2] > 0, s[:, 1:2], 1.0)
    d1, d3 = s[:, 0], s[:, 2]
    spread = d1 * d1 - d3 * d3
    flat = spread < 1e-12
    spread = np.where(flat, 1.0, spread)
    x1 = np.sqrt(np.clip(np.where(flat, 0.5, (d1 * d1 - 1.0) / spread), 0.0, 1.0))
    x3 = np.sqrt(np.clip(np.where(flat, 0.5, (1.0 - d3 * d3) / spread), 0.0, 1.0))
    sine = np.sqrt(np.maximum((d1 * d1 - 1.0) * (1.0 - d3 * d3), 0.0)) / (d1 + d3)
    cosine = (1.0 + d1 * d3) / (d1 + d3)
    mean_ray = segment_sums(offsets, bearings1)
    pair = [_decomposition(U, Vt, x1, sign * x3, sign * sine, cosine, mean_ray) for sign in (1.0, -1.0)]
    poses = [check_cheirality(R, d, offsets, bearings1, bearings2) for R, d, _ in pair]
    errors = np.stack(
        [
            segment_quantiles(offsets, np.abs(sampson_errors(essential_from_pose(R, d), offsets, bearings1, bearings2)))
            for R, d, _ in pair
        ]
    )
    swap = poses[1].num_in_front > poses[0].num_in_front
    swap |= (poses[1].num_in_front == poses[0].num_in_front) & (errors[1] < errors[0])
    normals = np.stack([n for _, _, n in pair])
    return PlanarPoses(
        better=_select(poses, swap),
        alternative=_select(poses, ~swap),
        normals=np.where(swap[None, :, None], normals[::-1], normals),
        median_errors=np.where(swap, errors[::-1], errors),
        baseline_ratios=d1 - d3,
    )


def pure_rotations(
    offsets: IntArray, bearings1: Array, bearings2: Array, *, num_iterations: int = 10, scale: float = 2e-3
) -> PureRotations:
    """Estimate a robust rotation ``x2 ≈ R x1`` for each edge (Wahba's problem with Cauchy weights).

    Parameters
    ----------
    offsets : (m + 1,) int array
        Matches of edge k are rows ``offsets[k]:offsets[k + 1]``.
    bearings1, bearings2 : (k, 3) array
        Unit rays of the matches.
    num_iterations : int
        Number of reweighting iterations.
    scale : float
        Cauchy scale, radians; the default corresponds to 2-3 pixels of an ordinary photograph.

    Returns
    -------
    PureRotations
    """
    products = bearings2[:, :, None] * bearings1[:, None, :]
    weights = np.ones(len(bearings1))
    for _ in range(num_iterations):
        rotations = so3.project(segment_sums(offsets, products, weights))
        angles = angle_between(products_of_segments(rotations, offsets, bearings1), bearings2)
        weights = 1.0 / (1.0 + np.square(angles / scale))
    return PureRotations(rotations, segment_quantiles(offsets, angles))


def _decomposition(
    U: Array, Vt: Array, x1: Array, x3: Array, sine: Array, cosine: Array, mean_ray: Array
) -> tuple[Array, Array, Array]:
    zero, one = np.zeros_like(x1), np.ones_like(x1)
    middle = np.stack([cosine, zero, -sine, zero, one, zero, sine, zero, cosine], axis=1).reshape(-1, 3, 3)
    R = so3.project(U @ middle @ Vt)
    t = np.einsum("mij,mj->mi", U, np.stack([x1, zero, -x3], axis=1))
    n = np.einsum("mji,mj->mi", Vt, np.stack([x1, zero, x3], axis=1))
    sign = np.where(np.einsum("mi,mi->m", n, mean_ray) < 0, -1.0, 1.0)[:, None]
    return R, normalized(-sign * np.einsum("mji,mj->mi", R, t)), normalized(sign * n)


def _select(pair: list[RelativePoses], second: NDArray[np.bool_]) -> RelativePoses:
    first, other = pair
    return RelativePoses(
        np.where(second[:, None, None], other.rotations, first.rotations),
        np.where(second[:, None], other.directions, first.directions),
        np.where(second, other.num_in_front, first.num_in_front),
        np.where(second, other.share_in_front, first.share_in_front),
        np.where(second, other.median_angles, first.median_angles),
    )
