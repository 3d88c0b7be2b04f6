"""Sampson errors of all edges' matches, their robust costs, and normal equations by what moves each edge.

In the frame ``Q = [B, d]`` of camera 1, its third axis the direction d of camera 2's centre, with ``y = Q^T x1`` and
``z = (R Q)^T x2`` for unit bearings x1, x2, the epipolar constraint and its variance under a pixel of noise are

    c = x2^T R [d]_x x1 = z_1 y_2 - z_2 y_1,    s^2 = (1 - y_3^2 - c^2) / f_2^2 + (1 - z_3^2 - c^2) / f_1^2,

and the residual ``r = c / s`` is in pixels (Sampson error on the tangent planes of the bearings). Derivatives include
those of s. An edge is moved by ``R <- R exp(Q w)``, ``d <- Q (tau, 1)`` normalised, and the logarithms of its two focal
lengths: a longer focal draws a bearing x towards the axis, ``dx = x_3 (e_3 - x_3 x)``, and shrinks a pixel.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized, tangent_basis
from colmap_vg.two_view.segments import rows_of_segments, segment_of_rows, segment_quantiles

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

_ROWS_PER_BLOCK = 32_768  # matches; the columns of one block stay in the second-level cache


@dataclass(frozen=True, eq=False)
class Matches:
    """Matches of edges with the inverse squared focal lengths of their cameras.

    Attributes
    ----------
    offsets : (m + 1,) int64 array
        Matches of edge k are rows ``offsets[k]:offsets[k + 1]``.
    bearings1, bearings2 : (k, 3) array
        Unit rays.
    variances1, variances2 : (m,) array
        ``1 / f^2``, squared radians per squared pixel.
    """

    offsets: IntArray
    bearings1: Array
    bearings2: Array
    variances1: Array
    variances2: Array

    def of(self, edges: IntArray) -> "Matches":
        """The matches of some edges, in their order."""
        if len(edges) == len(self.offsets) - 1:
            return self
        rows, offsets = rows_of_segments(self.offsets, edges)
        return Matches(
            offsets, self.bearings1[rows], self.bearings2[rows], self.variances1[edges], self.variances2[edges]
        )


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Robust cost (m,), gradient (m, b) and Gauss-Newton Hessian (m, b, b) of each edge, squared pixels."""

    costs: Array
    gradients: Array
    hessians: Array


@dataclass(frozen=True, eq=False)
class SampsonDerivatives:
    """Residuals (k,) in pixels, with derivatives by (w, tau) and the log focals (b, k), and by the keypoints.

    `by_ray1` and `by_ray2` (3, k) are tangent to the rays, in the frames of their cameras, per pixel of the keypoint's
    noise; the noise's pull on s is left out, being of second order. Their squared norms sum to one.
    """

    r: Array
    by_pose: Array
    by_ray1: Array
    by_ray2: Array


def frames(R: Array, d: Array) -> tuple[Array, Array]:
    """``Q = [B, d]`` in camera 1's frame and the same axes ``R Q`` in camera 2's: (m, 3, 3) each."""
    Q = np.concatenate([tangent_basis(d), d[:, :, None]], axis=2)
    return Q, R @ Q


def moved(R: Array, d: Array, step: Array) -> tuple[Array, Array]:
    """Edges after a step (m, 5) of rotation and direction."""
    Q, _ = frames(R, d)
    turned = R @ Q @ so3.exp(step[:, :3]) @ np.swapaxes(Q, 1, 2)
    along = np.concatenate([step[:, 3:], np.ones((len(d), 1))], axis=1)
    return turned, normalized(np.einsum("mab,mb->ma", Q, along))


def cauchy_costs(matches: Matches, R: Array, d: Array, scales: Array) -> Array:
    """``sum s^2 log(1 + r^2 / s^2)`` of each edge, with its scale s (m,) in pixels: (m,)."""
    costs = np.zeros(len(R))
    for edges, _, offsets, r in residuals_by_block(matches, R, d):
        squared_scale = np.square(scales[edges])[segment_of_rows(offsets)]
        costs[edges] = segment_totals(offsets, squared_scale * np.log1p(r * r / squared_scale))
    return costs


def median_errors(matches: Matches, R: Array, d: Array) -> Array:
    """Median absolute Sampson error of each edge in pixels, NaN without matches: (m,)."""
    medians = np.full(len(R), np.nan)
    for edges, _, offsets, r in residuals_by_block(matches, R, d):
        medians[edges] = segment_quantiles(offsets, np.abs(r))
    return medians


def normal_equations(
    matches: Matches, R: Array, d: Array, scales: Array, *, with_focals: bool = False
) -> NormalEquations:
    """Cauchy costs and their normal equations by (w, tau), b = 5, and the two log focal lengths where asked, b = 7."""
    m, b = len(R), 7 if with_focals else 5
    upper = np.triu_indices(b)
    costs, gradients, hessians = np.zeros(m), np.zeros((m, b)), np.zeros((m, b, b))
    for edges, rows, offsets in _blocks(matches):
        at = _at_frames(matches, R, d, edges, rows, offsets)
        squared_scale = np.square(scales[edges])[segment_of_rows(offsets)]
        ratio = at.r * at.r / squared_scale
        J = _jacobian(at, with_focals)
        weighted = J / (1.0 + ratio)
        costs[edges] = segment_totals(offsets, squared_scale * np.log1p(ratio))
        gradients[edges] = segment_totals(offsets, weighted * at.r).T
        totals = segment_totals(offsets, weighted[upper[0]] * J[upper[1]]).T
        block = hessians[edges]
        block[:, upper[0], upper[1]] = totals
        block[:, upper[1], upper[0]] = totals
    return NormalEquations(costs, gradients, hessians)


def residuals_by_block(matches: Matches, R: Array, d: Array) -> Iterator[tuple[slice, slice, IntArray, Array]]:
    """Runs of whole edges: their slice, their rows' slice, offsets from the first row, residuals in pixels."""
    for edges, rows, offsets in _blocks(matches):
        yield edges, rows, offsets, _at_frames(matches, R, d, edges, rows, offsets).r


def derivatives_by_block(
    matches: Matches, R: Array, d: Array, *, with_focals: bool = False
) -> Iterator[tuple[slice, slice, IntArray, "SampsonDerivatives"]]:
    """Runs of whole edges as `residuals_by_block`, with the residuals' derivatives by poses and by keypoints."""
    for edges, rows, offsets in _blocks(matches):
        at = _at_frames(matches, R, d, edges, rows, offsets)
        edge = segment_of_rows(offsets)
        Q1, Q2 = frames(R[edges], d[edges])
        rays = []
        sides = ((Q1, -at.z[1], at.z[0], matches.bearings1, at.v1), (Q2, at.y[1], -at.y[0], matches.bearings2, at.v2))
        for Q, first, second, bearings, v in sides:
            line = np.stack([Q[:, a, 0][edge] * first + Q[:, a, 1][edge] * second for a in range(3)])
            rays.append((line - at.c * bearings[rows].T) * np.sqrt(v / at.variance))
        yield edges, rows, offsets, SampsonDerivatives(at.r, _jacobian(at, with_focals), rays[0], rays[1])


def segment_totals(offsets: IntArray, values: Array) -> Array:
    """Sums over segments along the last axis, zero for empty ones: (..., k) to (..., m)."""
    filled = np.flatnonzero(np.diff(offsets) > 0)
    totals = np.zeros((*values.shape[:-1], len(offsets) - 1))
    if len(filled):
        totals[..., filled] = np.add.reduceat(values, offsets[:-1][filled], axis=-1)
    return totals


@dataclass(frozen=True, eq=False)
class _AtFrames:
    """Coordinates of a block's matches in their edges' frames, and what is made of them; lists of (k,) arrays."""

    y: list[Array]
    z: list[Array]
    axis1: list[Array]
    axis2: list[Array]
    depth1: Array
    depth2: Array
    v1: Array
    v2: Array
    c: Array
    variance: Array
    r: Array


def _at_frames(matches: Matches, R: Array, d: Array, edges: slice, rows: slice, offsets: IntArray) -> _AtFrames:
    edge = segment_of_rows(offsets)
    Q1, Q2 = frames(R[edges], d[edges])
    x1, x2 = matches.bearings1[rows].T, matches.bearings2[rows].T
    y = [sum((Q1[:, a, b][edge] * x1[a] for a in range(3)), start=np.zeros(len(edge))) for b in range(3)]
    z = [sum((Q2[:, a, b][edge] * x2[a] for a in range(3)), start=np.zeros(len(edge))) for b in range(3)]
    v1, v2 = matches.variances1[edges][edge], matches.variances2[edges][edge]
    c = z[0] * y[1] - z[1] * y[0]
    squared = c * c
    # 1 - y_3^2 without cancellation near the epipole; the floor keeps a match on both epipoles finite.
    variance = (y[0] * y[0] + y[1] * y[1] - squared) * v2 + (z[0] * z[0] + z[1] * z[1] - squared) * v1
    variance = np.maximum(variance, 1e-12 * (v1 + v2))
    axis1, axis2 = ([Q[:, 2, b][edge] for b in range(2)] for Q in (Q1, Q2))
    return _AtFrames(y, z, axis1, axis2, x1[2], x2[2], v1, v2, c, variance, c / np.sqrt(variance))


def _jacobian(at: _AtFrames, with_focals: bool) -> Array:
    """Derivatives of the residuals: (5, k), or (7, k) with the focal lengths."""
    y, z, v1, v2, c = at.y, at.z, at.v1, at.v2, at.c
    slope = np.empty((7 if with_focals else 5, len(c)))
    slope[0], slope[1], slope[2] = -y[0] * z[2], -y[1] * z[2], y[0] * z[0] + y[1] * z[1]
    slope[3], slope[4] = z[1] * y[2] - z[2] * y[1], z[2] * y[0] - z[0] * y[2]
    if with_focals:
        dy = [at.depth1 * (at.axis1[b] - at.depth1 * y[b]) for b in range(2)]
        dz = [at.depth2 * (at.axis2[b] - at.depth2 * z[b]) for b in range(2)]
        slope[5], slope[6] = z[0] * dy[1] - z[1] * dy[0], dz[0] * y[1] - dz[1] * y[0]
    half = -c * (v1 + v2) * slope  # half the derivative of s^2
    half[0] += z[2] * z[1] * v1
    half[1] -= z[2] * z[0] * v1
    half[3] -= y[2] * y[0] * v2 + z[2] * z[0] * v1
    half[4] -= y[2] * y[1] * v2 + z[2] * z[1] * v1
    if with_focals:
        squared = c * c
        half[5] += (y[0] * dy[0] + y[1] * dy[1]) * v2 - (z[0] * z[0] + z[1] * z[1] - squared) * v1
        half[6] += (z[0] * dz[0] + z[1] * dz[1]) * v1 - (y[0] * y[0] + y[1] * y[1] - squared) * v2
    return np.asarray(slope / np.sqrt(at.variance) - (at.r / at.variance) * half)


def _blocks(matches: Matches) -> Iterator[tuple[slice, slice, IntArray]]:
    """Runs of whole edges of about `_ROWS_PER_BLOCK` rows: edges, rows, and offsets from the first row."""
    offsets = matches.offsets
    first, last = 0, len(offsets) - 1
    while first < last:
        stop = int(np.searchsorted(offsets, offsets[first] + _ROWS_PER_BLOCK, side="right")) - 1
        stop = min(max(stop, first + 1), last)
        yield slice(first, stop), slice(offsets[first], offsets[stop]), offsets[first : stop + 1] - offsets[first]
        first = stop
