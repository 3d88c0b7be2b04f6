"""Depth residuals of image triplets, which determine ratios of baselines along lines of cameras.

Epipolar errors do not depend on the ratio of two baselines along a line. But a point that three cameras see has one
depth in the middle one. With the rays ``u`` of a track in images a, b, c, all in the frame of b, and ``t = p_b - p_a``,
the inverse depth in b along ``u_b`` from image a is

    rho_a = A . P / P . P,    A = u_b x u_a,    P = u_a x t,

and likewise from c. The residual is ``r = h / s``, ``h = rho_a - rho_c``, with the variance ``s^2`` of h under a pixel
of noise in each of the three rays. It is in pixels and, like a disparity, close to normal for distant points, too. No
point is triangulated. Derivatives include those of s: with ``G = dh/du`` and ``g = v (G - (G . u) u)``, half the
derivative of ``s^2 = sum g . G`` is the derivative of G along g.

The parameters of a triplet are rotations of the rays of a and c in the frame of b (3 + 3), t of a and of c (3 + 3), and
of the lenses the logarithms of the three focal lengths and a radial term of all.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.two_view.pieces import Block, Pieces, rescaled_rays

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class TripletRays:
    """Tracks of triplets of images (a, b, c) with the inverse squared focal lengths of their cameras.

    Attributes
    ----------
    pieces : Pieces
        Unit rays in a, b and c, each in its own camera: nine columns.
    variances : (3, q) array
        ``1 / f^2``, squared radians per squared pixel.
    focal_ratios : (3, q) array or None
        Old over new focal length: the first two coordinates of the rays are multiplied by it, and the rays normalised.
        None if no focal length is an unknown.
    radial_gains : (p, 3, length) array or None
        Shift of each ray by the radial term over that by the log focal length; None if the term is no unknown.
    """

    pieces: Pieces
    variances: Array
    focal_ratios: Array | None = None
    radial_gains: Array | None = None

    @property
    def num_lens_unknowns(self) -> int:
        """Unknowns of each triplet beside its poses: none, three log focal lengths, or these and the radial term."""
        return 0 if self.focal_ratios is None else 3 + (self.radial_gains is not None)


@dataclass(frozen=True, eq=False)
class TripletPoses:
    """Poses of a and of c relative to b.

    Attributes
    ----------
    rotations : (2, q, 3, 3) array
        Rotations from a to b, and from c to b.
    baselines : (2, q, 3) array
        ``p_b - p_a`` and ``p_b - p_c`` in b's frame.
    """

    rotations: Array
    baselines: Array


@dataclass(frozen=True, eq=False)
class TripletEquations:
    """Robust cost (q,), gradient (q, b) and Gauss-Newton Hessian (q, b, b) of each triplet, squared pixels."""

    costs: Array
    gradients: Array
    hessians: Array


def depth_residuals(rays: TripletRays, poses: TripletPoses) -> Array:
    """Depth residuals of all tracks in pixels: (k,)."""
    parts = [rays.pieces.rows(_evaluate(rays, poses, block).r, block) for block in rays.pieces.blocks()]
    return np.concatenate([np.zeros(0), *parts])


def inverse_depths(rays: TripletRays, poses: TripletPoses) -> Array:
    """Inverse depths of all tracks in b, from image a and from image c: (2, k)."""
    pieces = rays.pieces
    parts = [
        pieces.rows(np.stack([side.rho for side in _evaluate(rays, poses, block).sides]), block)
        for block in pieces.blocks()
    ]
    return np.concatenate([np.zeros((2, 0)), *parts], axis=1)


def depth_costs(rays: TripletRays, poses: TripletPoses, scale: float) -> Array:
    """Cauchy costs ``sum s^2 log(1 + r^2 / s^2)`` of each triplet, with the scale s in pixels: (q,)."""
    costs = np.zeros(rays.pieces.num_segments)
    for block in rays.pieces.blocks():
        ratio = np.square(_evaluate(rays, poses, block).r / scale)
        costs[block.segments] = block.totals(np.log1p(ratio).sum(axis=1))
    return scale**2 * costs


def depth_equations(rays: TripletRays, poses: TripletPoses, scale: float) -> TripletEquations:
    """Cauchy costs and normal equations by (rotation of a, of c, t of a, of c) and the lens unknowns of the rays."""
    q, b = rays.pieces.num_segments, 12 + rays.num_lens_unknowns
    costs, products = np.zeros(q), np.zeros((q, b, b + 1))
    for block in rays.pieces.blocks():
        at = _evaluate(rays, poses, block)
        columns = _jacobian_and_residuals(at)
        ratio = np.square(at.r / scale)
        weighted = columns[:, :b] / (1.0 + ratio)[:, None]
        costs[block.segments] = block.totals(np.log1p(ratio).sum(axis=1))
        products[block.segments] = block.totals(weighted @ np.swapaxes(columns, 1, 2))
    hessians = products[:, :, :b]
    # Both triangles were summed separately and differ in the last digits.
    hessians = 0.5 * (hessians + np.swapaxes(hessians, 1, 2))
    return TripletEquations(scale**2 * costs, products[:, :, b], hessians)


@dataclass(frozen=True, eq=False)
class DepthDerivatives:
    """Residuals (k,) in pixels, with derivatives by the poses and lens unknowns (b, k) and by the keypoints.

    `by_rays` (3, 3, k) are derivatives by the rays in images a, b, c, tangent to them in the frames of their cameras,
    per pixel of keypoint noise (its effect on s is neglected); the squared norms sum to one.
    """

    r: Array
    by_pose: Array
    by_rays: Array


def depth_derivatives_by_block(
    rays: TripletRays, poses: TripletPoses
) -> Iterator[tuple[slice, slice, IntArray, DepthDerivatives]]:
    """Iterate over runs of whole triplets: their slice, the slice of their rows, relative offsets, and derivatives."""
    pieces = rays.pieces
    for block in pieces.blocks():
        at = _evaluate(rays, poses, block)
        by_rays = np.stack(at.along) / np.sqrt(at.variances * at.variance)[:, None]
        for image in (0, 2):
            by_rays[image] = _rotated(np.swapaxes(at.turns[image // 2], 1, 2), np.moveaxis(by_rays[image], 0, 1))
        by_pose = np.moveaxis(_jacobian_and_residuals(at)[:, :-1], 1, 0)
        offsets = pieces.offsets[block.segments.start : block.segments.stop + 1]
        yield (
            block.segments,
            slice(int(offsets[0]), int(offsets[-1])),
            offsets - offsets[0],
            DepthDerivatives(pieces.rows(at.r, block), pieces.rows(by_pose, block), pieces.rows(by_rays, block)),
        )


@dataclass(frozen=True, eq=False)
class _Side:
    """Inverse depth in b from one other image, with derivatives by rays and baseline: (3, pieces, length)."""

    u: Array
    t: Array
    A: Array
    P: Array
    square: Array
    rho: Array
    alpha: Array
    beta: Array
    by_middle: Array
    by_own: Array
    by_baseline: Array


@dataclass(frozen=True, eq=False)
class _Tracks:
    """Residuals r of a block of tracks with dh/du of each image (`by_ray`), g (`along`), g . G (`noise`) and s^2.

    Vectors are (3, pieces, length); own rays (3, pieces, 3, length), rotations `turns` (2, pieces, 3, 3), variances
    (3, pieces, 1), gains of the radial term (3, pieces, length).
    """

    own: Array
    turns: Array
    middle: Array
    variances: Array
    sides: tuple[_Side, _Side]
    by_ray: list[Array]
    along: list[Array]
    noise: list[Array]
    variance: Array
    r: Array
    num_lens_unknowns: int
    radial_gains: Array | None


def _evaluate(rays: TripletRays, poses: TripletPoses, block: Block) -> _Tracks:
    triplet = rays.pieces.segments[block.pieces]
    columns = rays.pieces.columns[block.pieces]
    own = np.stack([columns[:, 3 * s : 3 * s + 3] for s in range(3)])
    if rays.focal_ratios is not None:
        own = np.stack([rescaled_rays(x, ratios[triplet]) for x, ratios in zip(own, rays.focal_ratios, strict=True)])
    turns, baselines = poses.rotations[:, triplet], poses.baselines[:, triplet]
    middle = np.moveaxis(own[1], 1, 0)
    a, c = (_side(_rotated(turns[s], own[2 * s]), middle, baselines[s].T[:, :, None]) for s in (0, 1))
    variances = rays.variances[:, triplet, None]
    by_ray = [a.by_own, a.by_middle - c.by_middle, -c.by_own]
    along, noise = [], []
    for G, u, v in zip(by_ray, (a.u, middle, c.u), variances, strict=True):
        tangential = G - _dot(G, u) * u
        along.append(v * tangential)
        noise.append(v * _dot(tangential, tangential))
    variance = np.maximum(noise[0] + noise[1] + noise[2], np.finfo(float).tiny)
    r = (a.rho - c.rho) / np.sqrt(variance)
    gains = None if rays.radial_gains is None else np.moveaxis(rays.radial_gains[block.pieces], 1, 0)
    return _Tracks(
        own, turns, middle, variances, (a, c), by_ray, along, noise, variance, r, rays.num_lens_unknowns, gains
    )


def _rotated(turns: Array, x: Array) -> Array:
    """Rotated vectors (pieces, 3, length), with the components as first axis."""
    return np.moveaxis(turns @ x, 1, 0)


def _side(u: Array, middle: Array, t: Array) -> _Side:
    A, P = _cross(middle, u), _cross(u, t)
    # The depth of a point on the line through both cameras is undetermined: P = 0 and, with the floor, huge variance.
    square = np.maximum(_dot(P, P), 1e-24 * _dot(t, t) + np.finfo(float).tiny)
    alpha = P / square
    rho = _dot(A, alpha)
    beta = A / square - 2.0 * rho * alpha
    return _Side(
        u,
        t,
        A,
        P,
        square,
        rho,
        alpha,
        beta,
        by_middle=_cross(u, alpha),
        by_own=_cross(alpha, middle) + _cross(t, beta),
        by_baseline=_cross(beta, u),
    )


def _derivative(side: _Side, middle: Array, du: Array, dmiddle: Array) -> tuple[Array, Array, Array]:
    """Directional derivatives of a side's `by_middle`, `by_own` and `by_baseline` along changes du, dmiddle of rays."""
    dA = _cross(dmiddle, side.u) + _cross(middle, du)
    dP = _cross(du, side.t)
    dsquare = 2.0 * _dot(side.P, dP)
    dalpha = (dP - side.alpha * dsquare) / side.square
    drho = _dot(side.alpha, dA) + _dot(side.beta, dP)
    dbeta = (dA - 2.0 * drho * side.P - 2.0 * side.rho * dP - side.beta * dsquare) / side.square
    by_middle = _cross(du, side.alpha) + _cross(side.u, dalpha)
    by_own = _cross(dalpha, middle) + _cross(side.alpha, dmiddle) + _cross(side.t, dbeta)
    return by_middle, by_own, _cross(dbeta, side.u) + _cross(side.beta, du)


def _jacobian_and_residuals(at: _Tracks) -> Array:
    """Derivatives of the residuals by poses (12) and lens unknowns, then the residuals: (pieces, b + 1, length)."""
    (a, c), rays = at.sides, (at.sides[0].u, at.middle, at.sides[1].u)
    bend_a = _derivative(a, at.middle, at.along[0], at.along[1])
    bend_c = _derivative(c, at.middle, at.along[2], at.along[1])
    inverse, ratio = 1.0 / np.sqrt(at.variance), at.r / at.variance
    bends = (bend_a[1], bend_a[0] - bend_c[0], -bend_c[1])
    # d(h/s) = dh/s - (r/s^2) d(s^2)/2; (G . u)^2 depends on the ray itself, too.
    by_ray = [
        G * inverse - ratio * (bend - _dot(G, u) * along)
        for G, bend, u, along in zip(at.by_ray, bends, rays, at.along, strict=True)
    ]
    count, length = at.r.shape
    whole = np.empty((count, 13 + at.num_lens_unknowns, length))
    J = np.moveaxis(whole, 1, 0)
    J[0:3], J[3:6] = _cross(a.u, by_ray[0]), _cross(c.u, by_ray[2])
    J[6:9] = a.by_baseline * inverse - ratio * bend_a[2]
    J[9:12] = -(c.by_baseline * inverse - ratio * bend_c[2])
    if at.num_lens_unknowns:
        axis = np.array([0.0, 0.0, 1.0])[:, None]
        for k, x in enumerate(at.own):
            depth = x[:, 2:]
            pull = depth * (axis - depth * x)
            pull = np.moveaxis(pull, 1, 0) if k == 1 else _rotated(at.turns[k // 2], pull)
            J[12 + k] = _dot(by_ray[k], pull)
        if at.radial_gains is not None:
            J[15] = np.sum(at.radial_gains * J[12:15], axis=0)
        for k in range(3):  # a longer focal length reduces the angle of a pixel, too
            J[12 + k] += ratio * at.noise[k]
    J[-1] = at.r
    return whole


def _cross(a: Array, b: Array) -> Array:
    result = np.empty((3, *np.broadcast_shapes(a.shape[1:], b.shape[1:])))
    for k in range(3):
        np.subtract(a[k - 2] * b[k - 1], a[k - 1] * b[k - 2], out=result[k])
    return result


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
