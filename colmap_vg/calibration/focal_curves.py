"""Difference of the singular values of each pair's essential matrix, as a function of one camera's focal length.

With the right focal lengths ``E = K2^T F K1`` has two equal singular values (Huang & Faugeras 1989; as a cost over the
focal: Mendonça & Cipolla 1999). Each pair gives ``h = (s1 - s2) / (s1 + s2)`` with its standard deviation, propagated
from the covariance of F: pairs that do not determine the focal (planar scenes, or optical axes that meet at equal
distances) have a large one and hardly any weight.

The curves need no SVD: for rank two ``s1^2 + s2^2 = ||E||^2`` and ``s1 s2 = ||cof E||``, both polynomials in the
squared focals with sums of squares of F and of its cofactors as coefficients. Focals are in units of the image size.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import GraphError
from colmap_vg.two_view.eight_point import cofactors

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

LOWEST, HIGHEST = float(np.log(0.3)), float(np.log(5.0))  # log focal over image size: 118° to 11° of view
CAUCHY_SCALE = 3.0  # standard deviations; also of the costs of rotation cycles
_NODES = np.linspace(LOWEST, HIGHEST, 10)  # log focals; the standard deviations, smooth in log f, are interpolated
_DEFAULT_SIGMA = 2e-3  # of vec(F) per match without covariances, dimensionless: image sizes and ||F|| are 1
_DEFAULT_MATCHES = 100


@dataclass(frozen=True, eq=False)
class FocalCurves:
    """Functions h of a log focal, one for each pair and each of its cameras whose focal varies.

    Attributes
    ----------
    camera : (o,) int64 array
        The camera whose focal varies.
    cameras : (o, 2) int64 array
        Cameras of the pair's two sides.
    F : (o, 3, 3) array
        Fundamental matrices in units of the image sizes, principal points at zero.
    covariances : (o, 9, 9) array
        Covariances of the row-major ``vec(F)``.
    log_sd : (o, nodes) array
        Logarithm of the standard deviation of h at the log focals of the nodes.
    """

    camera: IntArray
    cameras: IntArray
    F: Array
    covariances: Array
    log_sd: Array

    @property
    def varies(self) -> BoolArray:
        """Mask (o, 2) of the sides whose focal varies."""
        return np.asarray(self.cameras == self.camera[:, None])

    def costs(self, log_f: Array, log_focals: Array) -> Array:
        """Robust costs ``c^2 log(1 + h^2 / (c sd)^2)`` at log focals log_f (o, g) of the varying camera: (o, g).

        The other cameras are fixed at log_focals, (n,), or (n, g) where they differ between the columns.
        """
        deviation = self.deviations(log_f, log_focals)
        sd = np.exp(_interpolated(self.log_sd, log_f))
        return np.asarray(CAUCHY_SCALE**2 * np.log1p(np.square(deviation / (CAUCHY_SCALE * sd))))

    def deviations(self, log_f: Array, log_focals: Array) -> Array:
        """``h = (s1 - s2) / (s1 + s2)`` at log focals log_f (o, g) of the varying camera: (o, g)."""
        log_fixed = (log_focals[:, None] if log_focals.ndim == 1 else log_focals)[self.cameras]
        f1, f2 = (np.exp(2.0 * np.where(self.varies[:, s, None], log_f, log_fixed[:, s])) for s in (0, 1))
        n = _sums_of_squares(self.F)[:, :, None]
        k = _sums_of_squares(cofactors(self.F))[:, :, None]
        both = f1 * f2
        # cof(diag(f, f, 1)) = diag(f, f, f^2).
        total = n[:, 3] + n[:, 2] * f1 + n[:, 1] * f2 + n[:, 0] * both
        product = 2.0 * np.sqrt(both * (k[:, 0] + k[:, 1] * f1 + k[:, 2] * f2 + k[:, 3] * both))
        return np.asarray(np.sqrt(np.maximum(total - product, 0.0) / (total + product)))


def focal_curves(
    F: Array,
    edges: IntArray,
    principal_points: Array,
    sizes: Array,
    covariances: Array | None = None,
    num_inliers: IntArray | None = None,
    aspect_ratios: Array | None = None,
) -> FocalCurves:
    """One curve for each pair, over the focal of its first camera, with deviations as if both cameras had that focal.

    Parameters are those of :func:`colmap_vg.calibration.focal.vote_focal_lengths`, with sizes (c,).

    Raises
    ------
    GraphError
        An edge has a camera row out of range, or no fundamental matrix is finite.
    """
    if len(edges) and (edges.min() < 0 or edges.max() >= len(sizes)):
        raise GraphError(f"edges have camera rows {edges.min()} to {edges.max()}, but there are {len(sizes)} cameras")
    use = np.isfinite(F).all(axis=(1, 2)) & (np.abs(F).max(axis=(1, 2), initial=0.0) > 0)
    if covariances is not None:
        use &= np.isfinite(covariances).all(axis=(1, 2))
    if not use.any():
        raise GraphError("no pair has a fundamental matrix to estimate focal lengths from: verify the matches first")
    aspect = np.ones(len(sizes)) if aspect_ratios is None else aspect_ratios
    frames = np.zeros((len(sizes), 3, 3))
    frames[:, 0, 0], frames[:, 1, 1], frames[:, 2, 2] = sizes, sizes * aspect, 1.0
    frames[:, :2, 2] = principal_points
    T1, T2 = frames[edges[use, 0]], frames[edges[use, 1]]
    normalized = np.swapaxes(T2, 1, 2) @ F[use] @ T1
    norm = np.linalg.norm(normalized, axis=(1, 2))
    unit = normalized / norm[:, None, None]
    if covariances is None:
        count = np.full(len(F), _DEFAULT_MATCHES) if num_inliers is None else np.maximum(num_inliers, 1)
        spread = np.square(_DEFAULT_SIGMA) / count[use]
        in_frame = spread[:, None, None] * np.eye(9)
    else:
        # vec(T2^T F T1) = (T2^T ⊗ T1^T) vec(F), row-major.
        map_ = np.einsum("mki,mlj->mijkl", T2, T1).reshape(-1, 9, 9) / norm[:, None, None]
        in_frame = map_ @ covariances[use] @ np.swapaxes(map_, 1, 2)
    log_sd = np.stack([np.log(_standard_deviations(unit, in_frame, np.exp(f), np.exp(f))) for f in _NODES], axis=1)
    cameras = edges[use].astype(np.int64)
    return FocalCurves(cameras[:, 0], cameras, unit, in_frame, log_sd)


def curves_of_one_camera(curves: FocalCurves) -> FocalCurves:
    """The same pairs as if one camera had taken all images."""
    zero = np.zeros_like(curves.cameras)
    return FocalCurves(zero[:, 0], zero, curves.F, curves.covariances, curves.log_sd)


def curves_of_each_camera(curves: FocalCurves, log_focals: Array) -> FocalCurves:
    """Curves over the focal of each camera: two for pairs of two cameras, with the other log focal fixed (n,)."""
    first, second = curves.cameras.T
    mixed = first != second
    if not mixed.any():
        return curves
    F, covariances = curves.F[mixed], curves.covariances[mixed]
    held1, held2 = np.exp(log_focals[first[mixed]]), np.exp(log_focals[second[mixed]])
    log_sd1 = np.stack([np.log(_standard_deviations(F, covariances, np.exp(f), held2)) for f in _NODES], axis=1)
    log_sd2 = np.stack([np.log(_standard_deviations(F, covariances, held1, np.exp(f))) for f in _NODES], axis=1)
    return FocalCurves(
        np.concatenate([first[~mixed], first[mixed], second[mixed]]),
        np.concatenate([curves.cameras[~mixed], curves.cameras[mixed], curves.cameras[mixed]]),
        np.concatenate([curves.F[~mixed], F, F]),
        np.concatenate([curves.covariances[~mixed], covariances, covariances]),
        np.concatenate([curves.log_sd[~mixed], log_sd1, log_sd2]),
    )


def _standard_deviations(F: Array, covariances: Array, f1: Array | float, f2: Array | float) -> Array:
    """Standard deviation of h from that of F, (m,).

    In the axes of E's singular vectors its upper 2x2 block B is ``diag(s1, s2)``; it is a multiple of a rotation where
    ``((B11 - B22), (B12 + B21)) / (s1 + s2)`` vanishes. The information of h is that of the pair along its first.
    """
    m = len(F)
    d1, d2 = (np.stack([np.broadcast_to(f, m), np.broadcast_to(f, m), np.ones(m)], axis=1) for f in (f1, f2))
    U, s, Vt = np.linalg.svd(d2[:, :, None] * F * d1[:, None, :])
    left, right = U * d2[:, :, None], np.swapaxes(Vt, 1, 2) * d1[:, :, None]

    def block(i: int, j: int) -> Array:
        return np.asarray((left[:, :, i, None] * right[:, None, :, j]).reshape(m, 9))

    total = (s[:, 0] + s[:, 1])[:, None]
    h = (s[:, 0] - s[:, 1])[:, None] / total
    along = (block(0, 0) - block(1, 1) - h * (block(0, 0) + block(1, 1))) / total
    across = (block(0, 1) + block(1, 0)) / total
    aa, ab, bb = (
        np.einsum("mi,mij,mj->m", u, covariances, v) for u, v in ((along, along), (along, across), (across, across))
    )
    # First diagonal entry of the inverse of [[aa, ab], [ab, bb]], inverted: Schur's complement.
    variance = aa - ab * ab / np.maximum(bb, 1e-300)
    return np.asarray(np.sqrt(np.maximum(variance, 1e-12)))


def _sums_of_squares(M: Array) -> Array:
    """Sums of the squares of M over the upper left 2x2 block, the last column, the last row and the corner: (m, 4)."""
    S = np.square(M)
    return np.stack(
        [S[:, :2, :2].sum(axis=(1, 2)), S[:, :2, 2].sum(axis=1), S[:, 2, :2].sum(axis=1), S[:, 2, 2]], axis=1
    )


def _interpolated(at_nodes: Array, log_f: Array) -> Array:
    """Linear interpolation of each row (o, nodes) at its own log focals (o, g), constant beyond the ends."""
    last = len(_NODES) - 1
    place = np.clip((log_f - LOWEST) / (HIGHEST - LOWEST), 0.0, 1.0) * last
    low = np.minimum(place.astype(np.int64), last - 1)
    share = place - low
    row = np.arange(len(at_nodes))[:, None]
    return np.asarray((1.0 - share) * at_nodes[row, low] + share * at_nodes[row, low + 1])
