"""Sampson errors of the matches of all edges, their robust costs, and normal equations by the parameters of each edge.

In the frame ``Q = [B, d]`` in camera 1, whose third axis is the direction d of camera 2's centre, with ``y = Q^T x1``
and ``z = (R Q)^T x2`` for unit bearings x1, x2, the epipolar constraint and its variance under a pixel of noise are

    c = x2^T R [d]_x x1 = z_1 y_2 - z_2 y_1,    s^2 = (1 - y_3^2 - c^2) / f_2^2 + (1 - z_3^2 - c^2) / f_1^2,

and the residual ``r = c / s`` is in pixels (Sampson error on the tangent planes of the bearings). Derivatives include
those of s. The parameters of an edge are ``R <- R exp(Q w)``, ``d <- Q (tau, 1)`` normalised, and of its lenses the
logarithms of the two focal lengths and a radial term of both. A longer focal length moves a bearing x towards the axis,
``dx = x_3 (e_3 - x_3 x)``, and reduces the angle of a pixel; the radial term moves it likewise, by a factor per ray.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized, tangent_basis
from colmap_vg.two_view.pieces import Block, Pieces, rescaled_rays
from colmap_vg.two_view.segments import rows_of_segments, segment_quantiles

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
_MIN_SLOPE = 0.25  # lower limit of the factor on the Hessian where outliers dominate, dimensionless


@dataclass(frozen=True, eq=False)
class Matches:
    """Matches of edges with the inverse squared focal lengths of their cameras.

    Attributes
    ----------
    pieces : Pieces
        Unit rays in image 1 and image 2: six columns.
    variances : (2, m) array
        ``1 / f^2`` of camera 1 and 2, squared radians per squared pixel.
    focal_ratios : (2, m) array or None
        Old over new focal length of camera 1 and 2: the first two coordinates of the rays are multiplied by it, and the
        rays normalised. None if no focal length is an unknown.
    radial_gains : (p, 2, length) array or None
        Shift of each ray by the radial term over that by the log focal length; None if the term is no unknown.
    """

    pieces: Pieces
    variances: Array
    focal_ratios: Array | None = None
    radial_gains: Array | None = None

    @property
    def num_lens_unknowns(self) -> int:
        """Unknowns of each edge beside its pose: none, two log focal lengths, or these and the radial term."""
        return 0 if self.focal_ratios is None else 2 + (self.radial_gains is not None)

    @classmethod
    def of_rays(
        cls, offsets: IntArray, bearings1: Array, bearings2: Array, variances1: Array, variances2: Array
    ) -> "Matches":
        """Create from unit rays (k, 3); the matches of edge k are rows ``offsets[k]:offsets[k + 1]``."""
        return cls(cut_rays(offsets, bearings1, bearings2), np.stack([variances1, variances2]))

    @property
    def counts(self) -> IntArray:
        """Number of matches of each edge: (m,)."""
        return np.diff(self.pieces.offsets)

    def of(self, edges: IntArray) -> "Matches":
        """Matches of the given edges, in the given order."""
        focal_ratios = None if self.focal_ratios is None else self.focal_ratios[:, edges]
        gains = self.radial_gains
        if gains is not None and len(edges) < self.pieces.num_segments:
            gains = gains[rows_of_segments(self.pieces.starts, edges)[0]]
        return Matches(self.pieces.of(edges), self.variances[:, edges], focal_ratios, gains)


def cut_rays(offsets: IntArray, bearings1: Array, bearings2: Array) -> Pieces:
    """Cut the rays (k, 3) of matches in image 1 and image 2 into pieces."""
    return Pieces.cut(offsets, [*bearings1.T, *bearings2.T])


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Robust cost (m,), gradient (m, b) and Gauss-Newton Hessian (m, b, b) of each edge, squared pixels.

    `slopes` (m,) are sums of the derivatives of the influence function over sums of the weights.
    """

    costs: Array
    gradients: Array
    hessians: Array
    slopes: Array

    @property
    def newton_hessians(self) -> Array:
        """Hessians with derivatives of the influence function as weights. Those of reweighted least squares, with the
        weights themselves, give about half the step under pure noise."""
        return self.hessians * np.maximum(self.slopes, _MIN_SLOPE)[:, None, None]


@dataclass(frozen=True, eq=False)
class SampsonDerivatives:
    """Residuals (k,) in pixels, with derivatives by (w, tau) and the lens unknowns (b, k), and by the keypoints.

    `by_ray1` and `by_ray2` (3, k) are tangent to the rays, in the frames of their cameras, per pixel of keypoint noise.
    The effect of the noise on s, of second order, is neglected. Their squared norms sum to one.
    """

    r: Array
    by_pose: Array
    by_ray1: Array
    by_ray2: Array


def frames(R: Array, d: Array) -> tuple[Array, Array]:
    """Frames ``Q = [B, d]`` of edges in camera 1's frame, and the same axes ``R Q`` in camera 2's: (m, 3, 3) each."""
    Q = np.concatenate([tangent_basis(d), d[:, :, None]], axis=2)
    return Q, R @ Q


def moved(R: Array, d: Array, step: Array) -> tuple[Array, Array]:
    """Relative rotations (m, 3, 3) and directions (m, 3) after a step (m, 5) of ``(w, tau)``."""
    Q, _ = frames(R, d)
    turned = R @ Q @ so3.exp(step[:, :3]) @ np.swapaxes(Q, 1, 2)
    along = np.concatenate([step[:, 3:], np.ones((len(d), 1))], axis=1)
    return turned, normalized(np.einsum("mab,mb->ma", Q, along))


def cauchy_costs(matches: Matches, R: Array, d: Array, scales: Array) -> Array:
    """Cauchy costs ``sum s^2 log(1 + r^2 / s^2)`` of each edge, with its scale s (m,) in pixels: (m,)."""
    costs, squared_scales = np.zeros(len(R)), np.square(scales)
    for block, at in _by_block(matches, R, d):
        ratio = at.r * at.r / squared_scales[at.edge][:, None]
        costs[block.segments] = block.totals(np.log1p(ratio).sum(axis=1))
    return costs * squared_scales


def median_errors(matches: Matches, R: Array, d: Array) -> Array:
    """Median absolute Sampson error of each edge in pixels, NaN without matches: (m,)."""
    return segment_quantiles(matches.pieces.offsets, np.abs(residuals(matches, R, d)))


def normal_equations(matches: Matches, R: Array, d: Array, scales: Array) -> NormalEquations:
    """Cauchy costs and normal equations by (w, tau) and the lens unknowns of the matches, b = 5, 7 or 8."""
    m, b, squared_scales = len(R), 5 + matches.num_lens_unknowns, np.square(scales)
    costs, products, slopes = np.zeros(m), np.zeros((m, b, b + 1)), np.ones(m)
    for block, at in _by_block(matches, R, d):
        ratio = at.r * at.r / squared_scales[at.edge][:, None]
        weights = 1.0 / (1.0 + ratio)
        slopes[block.segments] = _mean_slopes(matches.pieces, block, weights)
        columns = _jacobian_and_residuals(at, np.sqrt(weights))
        costs[block.segments] = block.totals(np.log1p(ratio).sum(axis=1))
        products[block.segments] = block.totals(columns[:, :b] @ np.swapaxes(columns, 1, 2))
    hessians = products[:, :, :b]
    # Both triangles were summed separately and differ in the last digits.
    hessians = 0.5 * (hessians + np.swapaxes(hessians, 1, 2))
    return NormalEquations(costs * squared_scales, products[:, :, b], hessians, slopes)


def _mean_slopes(pieces: Pieces, block: Block, weights: Array) -> Array:
    """Sum of ``psi' = w (2 w - 1)`` over that of the Cauchy weights w (pieces, length), for each segment: (m,)."""
    padding = weights.shape[1] - pieces.counts[block.pieces]  # of weight one
    sums = np.stack([weights.sum(axis=1), np.square(weights).sum(axis=1)], axis=1) - padding[:, None]
    first, second = block.totals(sums).T
    return np.asarray(2.0 * second / np.maximum(first, 1e-300) - 1.0)


def residuals(matches: Matches, R: Array, d: Array) -> Array:
    """Sampson errors of all matches in pixels, in the order of their rows: (k,)."""
    parts = [matches.pieces.rows(at.r, block) for block, at in _by_block(matches, R, d)]
    return np.concatenate([np.zeros(0), *parts])


def derivatives_by_block(
    matches: Matches, R: Array, d: Array
) -> Iterator[tuple[slice, slice, IntArray, "SampsonDerivatives"]]:
    """Iterate over runs of whole edges: their slice, the slice of their rows, relative offsets, and derivatives."""
    pieces = matches.pieces
    for block, at in _by_block(matches, R, d):
        rays = []
        columns = pieces.columns[block.pieces]
        x1, x2 = columns[:, :3], columns[:, 3:]
        if matches.focal_ratios is not None:
            ratios1, ratios2 = matches.focal_ratios[:, at.edge]
            x1, x2 = rescaled_rays(x1, ratios1), rescaled_rays(x2, ratios2)
        for Q, x, first, second, v in (
            (at.Q1, x1, -at.z[1], at.z[0], at.v1),
            (at.Q2, x2, at.y[1], -at.y[0], at.v2),
        ):
            line = np.stack([Q[:, a, 0, None] * first + Q[:, a, 1, None] * second for a in range(3)])
            rays.append(pieces.rows((line - at.c * np.moveaxis(x, 1, 0)) * np.sqrt(v / at.variance), block))
        by_pose = np.moveaxis(_jacobian_and_residuals(at)[:, :-1], 1, 0)
        offsets = pieces.offsets[block.segments.start : block.segments.stop + 1]
        yield (
            block.segments,
            slice(int(offsets[0]), int(offsets[-1])),
            offsets - offsets[0],
            SampsonDerivatives(pieces.rows(at.r, block), pieces.rows(by_pose, block), rays[0], rays[1]),
        )


@dataclass(frozen=True, eq=False)
class _AtFrames:
    """Coordinates of a block's matches in the frames of their edges, with constraints, variances and residuals.

    Scalars per match are (pieces, length), vectors (3, pieces, length); per piece there are the edge (pieces,), frames
    (pieces, 3, 3) and variances (pieces, 1). Depths are the third coordinates of the rays in their cameras. Gains
    (2, pieces, length) are those of the radial term.
    """

    edge: IntArray
    Q1: Array
    Q2: Array
    depth1: Array
    depth2: Array
    y: Array
    z: Array
    v1: Array
    v2: Array
    c: Array
    variance: Array
    r: Array
    num_lens_unknowns: int
    radial_gains: Array | None


def _by_block(matches: Matches, R: Array, d: Array) -> Iterator[tuple[Block, _AtFrames]]:
    Q1, Q2 = frames(R, d)
    for block in matches.pieces.blocks():
        yield block, _at_frames(matches, Q1, Q2, block)


def _at_frames(matches: Matches, frames1: Array, frames2: Array, block: Block) -> _AtFrames:
    edge = matches.pieces.segments[block.pieces]
    Q1, Q2 = frames1[edge], frames2[edge]
    columns = matches.pieces.columns[block.pieces]
    focal_ratios = (None, None) if matches.focal_ratios is None else matches.focal_ratios[:, edge]
    y, depth1 = _rotated(Q1, columns[:, :3], focal_ratios[0])
    z, depth2 = _rotated(Q2, columns[:, 3:], focal_ratios[1])
    v1, v2 = matches.variances[:, edge, None]
    c = z[0] * y[1] - z[1] * y[0]
    squared = c * c
    # 1 - y_3^2 without cancellation near the epipole; the floor keeps a match at both epipoles finite.
    variance = (y[0] * y[0] + y[1] * y[1] - squared) * v2 + (z[0] * z[0] + z[1] * z[1] - squared) * v1
    np.maximum(variance, 1e-12 * (v1 + v2), out=variance)
    r = c / np.sqrt(variance)
    gains = None if matches.radial_gains is None else np.moveaxis(matches.radial_gains[block.pieces], 1, 0)
    return _AtFrames(edge, Q1, Q2, depth1, depth2, y, z, v1, v2, c, variance, r, matches.num_lens_unknowns, gains)


def _rotated(Q: Array, x: Array, focal_ratio: Array | None) -> tuple[Array, Array]:
    """Coordinates ``Q^T x`` (3, pieces, length) and depths of unit rays (pieces, 3, length) after rescaling."""
    depth = x[:, 2]
    if focal_ratio is None:
        return np.moveaxis(np.swapaxes(Q, 1, 2) @ x, 1, 0), depth
    # The frame is scaled instead of the rays; the length follows from that of a unit ray.
    factors = np.stack([focal_ratio, focal_ratio, np.ones_like(focal_ratio)], axis=1)
    squared = np.square(focal_ratio)[:, None]
    inverse = 1.0 / np.sqrt(squared + (1.0 - squared) * (depth * depth))
    turned = np.swapaxes(Q * factors[:, :, None], 1, 2) @ x
    turned *= inverse[:, None]
    return np.moveaxis(turned, 1, 0), depth * inverse


def _jacobian_and_residuals(at: _AtFrames, weights: Array | float = 1.0) -> Array:
    """Derivatives of the residuals by pose (5) and lens unknowns, then the residuals: (pieces, 6, 8 or 9, length).

    With the derivative ``c'`` of the constraint and ``h + c c' (-v_1 - v_2)``, half that of s^2,
    ``r' = c' (1 / s + r c (v_1 + v_2) / s^2) - h r / s^2``. All are multiplied by the weights (pieces, length).
    """
    y, z, c = at.y, at.z, at.c
    bend = at.r / at.variance
    gain = (1.0 / np.sqrt(at.variance) + bend * c * (at.v1 + at.v2)) * weights
    bend *= weights
    bend1, bend2 = bend * at.v1, bend * at.v2
    along1, along2 = bend2 * y[2], bend1 * z[2]
    J = np.empty((len(c), 6 + at.num_lens_unknowns, c.shape[1]))
    J[:, 0] = -gain * y[0] * z[2] - along2 * z[1]
    J[:, 1] = along2 * z[0] - gain * y[1] * z[2]
    J[:, 2] = gain * (y[0] * z[0] + y[1] * z[1])
    J[:, 3] = gain * (z[1] * y[2] - z[2] * y[1]) + along1 * y[0] + along2 * z[0]
    J[:, 4] = gain * (z[2] * y[0] - z[0] * y[2]) + along1 * y[1] + along2 * z[1]
    if at.num_lens_unknowns:
        depth1, depth2 = at.depth1, at.depth2
        dy = [depth1 * (at.Q1[:, 2, b, None] - depth1 * y[b]) for b in range(2)]
        dz = [depth2 * (at.Q2[:, 2, b, None] - depth2 * z[b]) for b in range(2)]
        squared = c * c
        J[:, 5] = gain * (z[0] * dy[1] - z[1] * dy[0]) - (y[0] * dy[0] + y[1] * dy[1]) * bend2
        J[:, 6] = gain * (dz[0] * y[1] - dz[1] * y[0]) - (z[0] * dz[0] + z[1] * dz[1]) * bend1
        if at.radial_gains is not None:
            J[:, 7] = at.radial_gains[0] * J[:, 5] + at.radial_gains[1] * J[:, 6]
        # A longer focal length reduces the angle of a pixel, too.
        J[:, 5] += (z[0] * z[0] + z[1] * z[1] - squared) * bend1
        J[:, 6] += (y[0] * y[0] + y[1] * y[1] - squared) * bend2
    J[:, -1] = at.r * weights
    return J
