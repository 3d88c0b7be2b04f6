"""Scale along lines of cameras: a point that three cameras see has one depth in the middle one.

Epipolar errors do not feel the ratio of two baselines along a line. With the rays ``u`` of a track in images a, b, c,
all in the frame of b, and ``t = p_b - p_a``, the inverse depth in b along ``u_b`` by image a is

    rho_a = A . P / P . P,    A = u_b x u_a,    P = u_a x t,

and likewise by c. The residual is ``r = h / s``, ``h = rho_a - rho_c``, with the variance ``s^2`` of h under a pixel of
noise in each of the three rays: it is in pixels, and close to normal for far points too, as disparities are. No point
is made. Derivatives include those of s: with ``G = dh/du`` and ``g = v (G - (G . u) u)``, half the derivative of
``s^2 = sum g . G`` is the derivative of G along g.

A triplet is moved by turns of the rays of a and c in the frame of b (3 + 3), by t of a and of c (3 + 3), and by the
logarithms of the three focal lengths.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.epipolar.sampson import segment_totals
from colmap_vg.two_view.segments import segment_of_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

_ROWS_PER_BLOCK = 16_384  # tracks; the columns of one block stay in the second-level cache


@dataclass(frozen=True, eq=False)
class TripletRays:
    """Tracks of triplets of images (a, b, c) with the inverse squared focal lengths of their cameras.

    Attributes
    ----------
    offsets : (q + 1,) int64 array
        Tracks of triplet k are rows ``offsets[k]:offsets[k + 1]``.
    bearings : (3, 3, k) array
        Unit rays in a, b and c, each in its own camera; components second.
    variances : (3, q) array
        ``1 / f^2``, squared radians per squared pixel.
    """

    offsets: IntArray
    bearings: Array
    variances: Array


@dataclass(frozen=True, eq=False)
class TripletPoses:
    """Relative poses of a and of c seen from b.

    Attributes
    ----------
    rotations : (2, q, 3, 3) array
        From a to b, and from c to b.
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
    """Residuals of all tracks in pixels: (k,)."""
    r = np.empty(int(rays.offsets[-1]))
    for triplets, rows, offsets in _blocks(rays.offsets):
        r[rows] = _evaluate(rays, poses, triplets, rows, offsets).r
    return r


def depth_costs(rays: TripletRays, poses: TripletPoses, scale: float) -> Array:
    """``sum s^2 log(1 + r^2 / s^2)`` of each triplet, with the scale s in pixels: (q,)."""
    r = depth_residuals(rays, poses)
    return scale**2 * segment_totals(rays.offsets, np.log1p(np.square(r / scale)))


def depth_equations(
    rays: TripletRays, poses: TripletPoses, scale: float, *, with_focals: bool = False
) -> TripletEquations:
    """Cauchy costs and their normal equations by (turn a, turn c, t of a, t of c), and the log focals where asked."""
    q, b = len(rays.offsets) - 1, 15 if with_focals else 12
    upper = np.triu_indices(b)
    costs, gradients, hessians = np.zeros(q), np.zeros((q, b)), np.zeros((q, b, b))
    for triplets, rows, offsets in _blocks(rays.offsets):
        at = _evaluate(rays, poses, triplets, rows, offsets)
        J = _jacobian(at, with_focals)
        ratio = np.square(at.r / scale)
        weighted = J / (1.0 + ratio)
        costs[triplets] = scale**2 * segment_totals(offsets, np.log1p(ratio))
        gradients[triplets] = segment_totals(offsets, weighted * at.r).T
        totals = segment_totals(offsets, weighted[upper[0]] * J[upper[1]]).T
        block = hessians[triplets]
        block[:, upper[0], upper[1]] = totals
        block[:, upper[1], upper[0]] = totals
    return TripletEquations(costs, gradients, hessians)


@dataclass(frozen=True, eq=False)
class DepthDerivatives:
    """Residuals (k,) in pixels, with derivatives by the poses and log focals (b, k) and by the keypoints.

    `by_rays` (3, 3, k): of images a, b, c, tangent to the rays in the frames of their cameras, per pixel of the
    keypoint's noise (its pull on s left out); the squared norms sum to one.
    """

    r: Array
    by_pose: Array
    by_rays: Array


def depth_derivatives_by_block(
    rays: TripletRays, poses: TripletPoses, *, with_focals: bool = False
) -> Iterator[tuple[slice, slice, IntArray, DepthDerivatives]]:
    """Runs of whole triplets: their slice, their rows' slice, offsets from the first row, and derivatives."""
    for triplets, rows, offsets in _blocks(rays.offsets):
        at = _evaluate(rays, poses, triplets, rows, offsets)
        v = rays.variances[:, triplets][:, segment_of_rows(offsets)]
        by_rays = np.stack(at.along) / np.sqrt(v * at.variance)[:, None]
        for image in (0, 2):
            by_rays[image] = np.einsum("bak,bk->ak", at.turns[image // 2], by_rays[image])
        yield triplets, rows, offsets, DepthDerivatives(at.r, _jacobian(at, with_focals), by_rays)


@dataclass(frozen=True, eq=False)
class _Side:
    """Inverse depth in b by one other image, and its derivatives by the rays and the baseline; (3, k) arrays."""

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
    """A block of tracks: dh/du of each image (`by_ray`), g (`along`), g . G (`noise`), s^2, r, and their sources."""

    own: Array
    turns: Array
    middle: Array
    sides: tuple[_Side, _Side]
    by_ray: list[Array]
    along: list[Array]
    noise: list[Array]
    variance: Array
    r: Array


def _evaluate(rays: TripletRays, poses: TripletPoses, triplets: slice, rows: slice, offsets: IntArray) -> _Tracks:
    triplet = segment_of_rows(offsets)
    own = rays.bearings[:, :, rows]
    turns = poses.rotations[:, triplets].transpose(0, 2, 3, 1)[..., triplet]
    middle = own[1]
    sides = tuple(
        _side(np.einsum("abk,bk->ak", turns[s], own[2 * s]), middle, poses.baselines[s, triplets].T[:, triplet])
        for s in (0, 1)
    )
    a, c = sides
    by_ray = [a.by_own, a.by_middle - c.by_middle, -c.by_own]
    along, noise = [], []
    for G, u, v in zip(by_ray, (a.u, middle, c.u), rays.variances[:, triplets][:, triplet], strict=True):
        tangential = G - _dot(G, u) * u
        along.append(v * tangential)
        noise.append(v * _dot(tangential, tangential))
    variance = np.maximum(noise[0] + noise[1] + noise[2], np.finfo(float).tiny)
    return _Tracks(own, turns, middle, (a, c), by_ray, along, noise, variance, (a.rho - c.rho) / np.sqrt(variance))


def _side(u: Array, middle: Array, t: Array) -> _Side:
    A, P = _cross(middle, u), _cross(u, t)
    # A point on the line of the two cameras has no depth by them: P = 0 and, with the floor, infinite variance.
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
    """Derivatives of a side's `by_middle`, `by_own` and `by_baseline` as its rays move along du and dmiddle."""
    dA = _cross(dmiddle, side.u) + _cross(middle, du)
    dP = _cross(du, side.t)
    dsquare = 2.0 * _dot(side.P, dP)
    dalpha = (dP - side.alpha * dsquare) / side.square
    drho = _dot(side.alpha, dA) + _dot(side.beta, dP)
    dbeta = (dA - 2.0 * drho * side.P - 2.0 * side.rho * dP - side.beta * dsquare) / side.square
    by_middle = _cross(du, side.alpha) + _cross(side.u, dalpha)
    by_own = _cross(dalpha, middle) + _cross(side.alpha, dmiddle) + _cross(side.t, dbeta)
    return by_middle, by_own, _cross(dbeta, side.u) + _cross(side.beta, du)


def _jacobian(at: _Tracks, with_focals: bool) -> Array:
    """Derivatives of the residuals: (12, k), or (15, k) with the focal lengths."""
    (a, c), rays = at.sides, (at.sides[0].u, at.middle, at.sides[1].u)
    bend_a = _derivative(a, at.middle, at.along[0], at.along[1])
    bend_c = _derivative(c, at.middle, at.along[2], at.along[1])
    inverse, ratio = 1.0 / np.sqrt(at.variance), at.r / at.variance
    bends = (bend_a[1], bend_a[0] - bend_c[0], -bend_c[1])
    # d(h/s) = dh/s - (r/s^2) d(s^2)/2; the ray itself moves in (G . u)^2 too.
    by_ray = [
        G * inverse - ratio * (bend - _dot(G, u) * along)
        for G, bend, u, along in zip(at.by_ray, bends, rays, at.along, strict=True)
    ]
    J = np.empty((15 if with_focals else 12, len(at.r)))
    J[0:3], J[3:6] = _cross(a.u, by_ray[0]), _cross(c.u, by_ray[2])
    J[6:9] = a.by_baseline * inverse - ratio * bend_a[2]
    J[9:12] = -(c.by_baseline * inverse - ratio * bend_c[2])
    if with_focals:
        for k, x in enumerate(at.own):
            pull = x[2] * (np.array([[0.0], [0.0], [1.0]]) - x[2] * x)
            if k != 1:
                pull = np.einsum("abk,bk->ak", at.turns[k // 2], pull)
            J[12 + k] = _dot(by_ray[k], pull) + ratio * at.noise[k]
    return J


def _cross(a: Array, b: Array) -> Array:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _blocks(offsets: IntArray) -> Iterator[tuple[slice, slice, IntArray]]:
    """Runs of whole triplets of about `_ROWS_PER_BLOCK` rows: triplets, rows, and offsets from the first row."""
    first, last = 0, len(offsets) - 1
    while first < last:
        stop = int(np.searchsorted(offsets, offsets[first] + _ROWS_PER_BLOCK, side="right")) - 1
        stop = min(max(stop, first + 1), last)
        yield slice(first, stop), slice(offsets[first], offsets[stop]), offsets[first : stop + 1] - offsets[first]
        first = stop
