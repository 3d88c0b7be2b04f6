"""What each edge knows: relative poses refined on their inliers, with 5-DoF information matrices, all edges at once.

The robust Sampson error of edge k is minimised over its rotation (3) and direction (2) by Levenberg-Marquardt, each
edge with its own damping. In the frame ``Q = [B, d]`` of camera 1 whose third axis is the direction d, with
``y = Q^T x1`` and ``z = Q^T R^T x2``, the constraint and its variance under a pixel of noise are

    c = x2^T E x1 = z_1 y_2 - z_2 y_1,    s^2 = (1 - y_3^2 - c^2) / f_2^2 + (1 - z_3^2 - c^2) / f_1^2,

and the residual ``c / s`` is in pixels (Sampson error on the tangent planes of the unit bearings). The derivatives
below include those of s.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized, tangent_basis
from colmap_vg.two_view.segments import rows_of_segments, segment_of_rows, segment_quantiles

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

_EFFICIENT_CAUCHY = (
    2.385  # Cauchy scale over sigma at which normal noise loses 5 % of efficiency (Holland & Welsch 1977)
)
_MAD_TO_SIGMA = 1.4826  # standard deviation over median absolute deviation of a normal distribution
_MIN_SIGMA_PX = 0.02  # pixels; keypoints are not better than this, and exact data keep finite information
_ROWS_PER_BLOCK = 32_768  # matches; the columns of one block stay in the second-level cache
_UPPER = np.triu_indices(5)


@dataclass(frozen=True, eq=False)
class RefinedEdges:
    """Refined relative poses and what is known of them.

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


@dataclass(frozen=True, eq=False)
class _Matches:
    """Rows of the edges at work, with the inverse squared focal lengths of those edges."""

    offsets: IntArray
    bearings1: Array
    bearings2: Array
    variances1: Array
    variances2: Array

    def of(self, edges: IntArray) -> "_Matches":
        if len(edges) == len(self.offsets) - 1:
            return self
        rows, offsets = rows_of_segments(self.offsets, edges)
        return _Matches(
            offsets, self.bearings1[rows], self.bearings2[rows], self.variances1[edges], self.variances2[edges]
        )


def refine_relative_poses(
    offsets: IntArray,
    bearings1: Array,
    bearings2: Array,
    rotations: Array,
    directions: Array,
    focal_lengths1: Array,
    focal_lengths2: Array,
    *,
    num_iterations: int = 30,
) -> RefinedEdges:
    """Minimise each edge's Cauchy Sampson error over its relative pose, and say how well it is known.

    The Cauchy scale follows each edge's own median error, in three rounds. The information is the sandwich of an
    M-estimator with one noise level per edge (Huber & Ronchetti, Robust Statistics, §7.6), so neither the robust
    weights nor a wrong idea of the keypoint noise distort it. Pairs that share keypoints are still correlated with each
    other.

    Parameters
    ----------
    offsets : (m + 1,) int array
        Matches of edge k are rows ``offsets[k]:offsets[k + 1]``; edges without matches stay as they are.
    bearings1, bearings2 : (k, 3) array
        Unit rays of the matches.
    rotations : (m, 3, 3) array
        cam2_from_cam1 rotations to start from.
    directions : (m, 3) array
        Directions of camera 2's centre in camera 1's frame to start from.
    focal_lengths1, focal_lengths2 : (m,) array
        Focal lengths of each edge's cameras, pixels.
    num_iterations : int
        Most steps per edge, all rounds together; an edge stops when its cost does.

    Returns
    -------
    RefinedEdges
    """
    matches = _Matches(offsets, bearings1, bearings2, focal_lengths1**-2.0, focal_lengths2**-2.0)
    R, d = rotations.astype(np.float64), normalized(directions.astype(np.float64))
    filled = np.flatnonzero(np.diff(offsets) > 0)
    num_rounds = 3
    for _ in range(num_rounds):
        sigma = _robust_sigmas(matches.of(filled), R[filled], d[filled])
        R[filled], d[filled] = _levenberg(
            matches.of(filled), R[filled], d[filled], _EFFICIENT_CAUCHY * sigma, -(-num_iterations // num_rounds)
        )
    m = len(R)
    information, median, sigma = np.zeros((m, 5, 5)), np.full(m, np.nan), np.full(m, np.nan)
    at_work = matches.of(filled)
    median[filled], sigma[filled] = _medians_and_sigmas(at_work, R[filled], d[filled])
    information[filled] = _information(at_work, R[filled], d[filled], sigma[filled])
    return RefinedEdges(R, d, information, median, sigma)


def _levenberg(matches: _Matches, R: Array, d: Array, scale: Array, num_iterations: int) -> tuple[Array, Array]:
    """Levenberg-Marquardt at a fixed Cauchy scale (m,) in pixels; edges leave when their cost stands still."""
    R, d = R.copy(), d.copy()
    damping = np.full(len(R), 1e-4)
    active = np.arange(len(R))
    for _ in range(num_iterations):
        at_work = matches.of(active)
        cost, gradient, hessian = _normal_equations(at_work, R[active], d[active], scale[active])
        diagonal = np.einsum("maa->ma", hessian)
        # Marquardt's scaling, with a floor so that a direction that no match sees stays where it is.
        level = damping[active, None] * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-30
        step = -np.linalg.solve(hessian + level[:, :, None] * np.eye(5), gradient[:, :, None])[:, :, 0]
        # Beyond a radian the linearisation says nothing.
        step = step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1.0)
        new_R, new_d = _moved(R[active], d[active], step)
        new_cost = _costs(at_work, new_R, new_d, scale[active])
        better = new_cost < cost
        R[active[better]], d[active[better]] = new_R[better], new_d[better]
        damping[active] = np.clip(damping[active] * np.where(better, 0.1, 10.0), 1e-10, 1e8)
        still = np.abs(cost - new_cost) <= 1e-7 * cost
        active = active[~still & (damping[active] < 1e6)]
        if not len(active):
            break
    return so3.project(R), d


def _frames(R: Array, d: Array) -> tuple[Array, Array]:
    """``Q = [B, d]`` in camera 1's frame and the same axes ``R Q`` in camera 2's: (m, 3, 3) each."""
    Q = np.concatenate([tangent_basis(d), d[:, :, None]], axis=2)
    return Q, R @ Q


def _moved(R: Array, d: Array, step: Array) -> tuple[Array, Array]:
    Q, _ = _frames(R, d)
    turned = R @ Q @ so3.exp(step[:, :3]) @ np.swapaxes(Q, 1, 2)
    along = np.concatenate([step[:, 3:], np.ones((len(d), 1))], axis=1)
    return turned, normalized(np.einsum("mab,mb->ma", Q, along))


def _blocks(matches: _Matches) -> Iterator[tuple[slice, slice, IntArray]]:
    """Runs of whole edges of about `_ROWS_PER_BLOCK` rows: edges, rows, and offsets from the first row."""
    offsets = matches.offsets
    first, last = 0, len(offsets) - 1
    while first < last:
        stop = int(np.searchsorted(offsets, offsets[first] + _ROWS_PER_BLOCK, side="right")) - 1
        stop = min(max(stop, first + 1), last)
        yield slice(first, stop), slice(offsets[first], offsets[stop]), offsets[first : stop + 1] - offsets[first]
        first = stop


def _rays_in_frames(
    matches: _Matches, R: Array, d: Array, edges: slice, rows: slice, offsets: IntArray
) -> tuple[list[Array], list[Array], Array, Array]:
    """Coordinates y and z of a block's matches, and the inverse squared focal lengths of each row."""
    edge = segment_of_rows(offsets)
    Q1, Q2 = _frames(R[edges], d[edges])
    x1, x2 = matches.bearings1[rows].T, matches.bearings2[rows].T
    y = [sum((Q1[:, a, b][edge] * x1[a] for a in range(3)), start=np.zeros(len(edge))) for b in range(3)]
    z = [sum((Q2[:, a, b][edge] * x2[a] for a in range(3)), start=np.zeros(len(edge))) for b in range(3)]
    return y, z, matches.variances1[edges][edge], matches.variances2[edges][edge]


def _residuals_of(y: list[Array], z: list[Array], v1: Array, v2: Array) -> tuple[Array, Array, Array]:
    """Constraint c, variance s^2 and residual c / s in pixels."""
    c = z[0] * y[1] - z[1] * y[0]
    squared = c * c
    # 1 - y_3^2 without cancellation near the epipole; the floor keeps a match on both epipoles finite.
    variance = (y[0] * y[0] + y[1] * y[1] - squared) * v2 + (z[0] * z[0] + z[1] * z[1] - squared) * v1
    variance = np.maximum(variance, 1e-12 * (v1 + v2))
    return c, variance, c / np.sqrt(variance)


def _jacobian(y: list[Array], z: list[Array], v1: Array, v2: Array, c: Array, variance: Array, r: Array) -> Array:
    """Derivatives of the residuals by the rotation vector in Q's axes and the direction's tangent: (5, k)."""
    slope = np.empty((5, len(c)))
    slope[0], slope[1], slope[2] = -y[0] * z[2], -y[1] * z[2], y[0] * z[0] + y[1] * z[1]
    slope[3], slope[4] = z[1] * y[2] - z[2] * y[1], z[2] * y[0] - z[0] * y[2]
    both = c * (v1 + v2)
    half = -both * slope  # half the derivative of s^2
    half[0] += z[2] * z[1] * v1
    half[1] -= z[2] * z[0] * v1
    half[3] -= y[2] * y[0] * v2 + z[2] * z[0] * v1
    half[4] -= y[2] * y[1] * v2 + z[2] * z[1] * v1
    return np.asarray(slope / np.sqrt(variance) - (r / variance) * half)


def _normal_equations(matches: _Matches, R: Array, d: Array, scale: Array) -> tuple[Array, Array, Array]:
    """Cauchy cost (m,), gradient (m, 5) and Gauss-Newton Hessian (m, 5, 5), in pixels squared."""
    m = len(R)
    cost, gradient, hessian = np.empty(m), np.empty((m, 5)), np.empty((m, 5, 5))
    for edges, rows, offsets in _blocks(matches):
        y, z, v1, v2 = _rays_in_frames(matches, R, d, edges, rows, offsets)
        c, variance, r = _residuals_of(y, z, v1, v2)
        squared_scale = np.square(scale[edges])[segment_of_rows(offsets)]
        ratio = r * r / squared_scale
        weight = 1.0 / (1.0 + ratio)
        J = _jacobian(y, z, v1, v2, c, variance, r)
        weighted = weight * J
        starts = offsets[:-1]
        cost[edges] = np.add.reduceat(squared_scale * np.log1p(ratio), starts)
        gradient[edges] = np.add.reduceat(weighted * r, starts, axis=1).T
        _fill_symmetric(hessian[edges], np.add.reduceat(weighted[_UPPER[0]] * J[_UPPER[1]], starts, axis=1))
    return cost, gradient, hessian


def _fill_symmetric(into: Array, upper: Array) -> None:
    into[:, _UPPER[0], _UPPER[1]] = upper.T
    into[:, _UPPER[1], _UPPER[0]] = upper.T


def _over_blocks(matches: _Matches, R: Array, d: Array, reduce: Callable[[Array, slice, IntArray], None]) -> None:
    for edges, rows, offsets in _blocks(matches):
        _, _, r = _residuals_of(*_rays_in_frames(matches, R, d, edges, rows, offsets))
        reduce(r, edges, offsets)


def _costs(matches: _Matches, R: Array, d: Array, scale: Array) -> Array:
    cost = np.empty(len(R))

    def reduce(r: Array, edges: slice, offsets: IntArray) -> None:
        squared_scale = np.square(scale[edges])[segment_of_rows(offsets)]
        cost[edges] = np.add.reduceat(squared_scale * np.log1p(r * r / squared_scale), offsets[:-1])

    _over_blocks(matches, R, d, reduce)
    return cost


def _medians_and_sigmas(matches: _Matches, R: Array, d: Array) -> tuple[Array, Array]:
    median = np.empty(len(R))

    def reduce(r: Array, edges: slice, offsets: IntArray) -> None:
        median[edges] = segment_quantiles(offsets, np.abs(r))

    _over_blocks(matches, R, d, reduce)
    count = np.diff(matches.offsets)
    return median, _MAD_TO_SIGMA * median * np.sqrt(count / np.maximum(count - 5, 1))


def _robust_sigmas(matches: _Matches, R: Array, d: Array) -> Array:
    return np.maximum(_medians_and_sigmas(matches, R, d)[1], _MIN_SIGMA_PX)


def _information(matches: _Matches, R: Array, d: Array, sigma: Array) -> Array:
    """Inverse covariance in ``(w, tau)``: ``(J^T W J / mean w) (mean psi')^2 / mean psi^2``, (m, 5, 5)."""
    scale = _EFFICIENT_CAUCHY * np.maximum(sigma, _MIN_SIGMA_PX)
    _, _, hessian = _normal_equations(matches, R, d, scale)
    sums = np.empty((3, len(R)))

    def reduce(r: Array, edges: slice, offsets: IntArray) -> None:
        ratio = np.square(r / scale[edges][segment_of_rows(offsets)])
        weight = 1.0 / (1.0 + ratio)
        rows = np.stack([weight, (1.0 - ratio) * weight * weight, np.square(r * weight)])
        sums[:, edges] = np.add.reduceat(rows, offsets[:-1], axis=1)

    _over_blocks(matches, R, d, reduce)
    count = np.diff(matches.offsets)
    mean_weight, mean_slope = sums[0] / count, np.maximum(sums[1] / count, 0.1)
    squared_psi = sums[2] / np.maximum(count - 5, 1)
    variance = np.maximum(squared_psi / np.square(mean_slope), _MIN_SIGMA_PX**2)
    _, axes = _frames(R, d)
    turn = np.zeros((len(R), 5, 5))
    turn[:, :3, :3] = axes
    turn[:, 3, 3] = turn[:, 4, 4] = 1.0
    return np.asarray(turn @ hessian @ np.swapaxes(turn, 1, 2) / (mean_weight * variance)[:, None, None])
