"""Sampson errors of matches under given matrices: of unit rays, of pixels, and of matches in pieces.

The Sampson error ``x2^T M x1 / s`` is, to first order, the distance of a match from the nearest one that satisfies the
epipolar constraint (Hartley & Zisserman, Multiple View Geometry, §11.4.3). With the lines ``l1 = M^T x2`` and
``l2 = M x1``, ``s^2`` is a sum over both images of squared parts of these lines along which the points move:

* :func:`sampson_errors`: unit rays move in their tangent planes, ``s^2 = |P1 l1|^2 + |P2 l2|^2`` with the projections
  ``P = I - x x^T``. This is valid for any field of view, and focal lengths turn radians into pixels.
* :func:`pixel_sampson_errors`: points ``(u, v, 1)`` move in the image plane, so that ``s^2`` is the sum of the squares
  of the first two coordinates of both lines. This needs no calibration.
* :func:`squared_errors_and_variances`: numerators and denominators of either, for weights of the matches of all edges.

The residuals of :mod:`colmap_vg.two_view.sampson` are those of rays as a function of the pose, with derivatives.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.two_view.pieces import Pieces
from colmap_vg.two_view.segments import products_of_segments, segment_of_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


def sampson_errors(
    E: Array,
    offsets: IntArray,
    bearings1: Array,
    bearings2: Array,
    focal_lengths1: Array | None = None,
    focal_lengths2: Array | None = None,
) -> Array:
    """Signed Sampson error of each match, the first-order distance from its epipolar constraint on the unit sphere.

    ``x2^T E x1 / sqrt(|P1 E^T x2|^2 / f1^2 + |P2 E x1|^2 / f2^2)`` with the projection ``P = I - x x^T`` on the tangent
    plane of a bearing, which is valid for any field of view.

    Parameters
    ----------
    E : (m, 3, 3) array
        Essential matrices, of any scale.
    offsets : (m + 1,) int array
        Matches of edge k are rows ``offsets[k]:offsets[k + 1]``.
    bearings1, bearings2 : (k, 3) array
        Unit rays.
    focal_lengths1, focal_lengths2 : (m,) array, optional
        Focal lengths of each edge's cameras in pixels.

    Returns
    -------
    (k,) array
        Radians, or pixels if focal lengths are given. Zero for a match at both epipoles.
    """
    edge = segment_of_rows(offsets)
    line2 = products_of_segments(E, offsets, bearings1)
    line1 = products_of_segments(np.swapaxes(E, 1, 2), offsets, bearings2)
    algebraic = np.einsum("ki,ki->k", bearings2, line2)
    squared = np.square(algebraic)
    variance1 = np.einsum("ki,ki->k", line1, line1) - squared
    variance2 = np.einsum("ki,ki->k", line2, line2) - squared
    if focal_lengths1 is not None:
        variance1 = variance1 / np.square(focal_lengths1)[edge]
    if focal_lengths2 is not None:
        variance2 = variance2 / np.square(focal_lengths2)[edge]
    variance = variance1 + variance2
    good = variance > 0
    return np.asarray(np.where(good, algebraic / np.sqrt(np.where(good, variance, 1.0)), 0.0))


def pixel_sampson_errors(F: Array, offsets: IntArray, points1: Array, points2: Array) -> Array:
    """Signed Sampson error of each match in the image planes.

    Parameters
    ----------
    F : (m, 3, 3) array
        Fundamental matrices, of any scale.
    offsets : (m + 1,) int array
        Matches of edge k are rows ``offsets[k]:offsets[k + 1]``.
    points1, points2 : (k, 2) array
        Pixels.

    Returns
    -------
    (k,) array
        Pixels. Not finite for a match at both epipoles.
    """
    x1, x2 = (np.concatenate([p, np.ones((len(p), 1))], axis=1) for p in (points1, points2))
    line2 = products_of_segments(F, offsets, x1)
    line1 = products_of_segments(np.swapaxes(F, 1, 2), offsets, x2)
    length = np.sqrt((line2[:, :2] ** 2).sum(axis=1) + (line1[:, :2] ** 2).sum(axis=1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.einsum("ka,ka->k", x2, line2) / length)


def squared_errors_and_variances(matrices: Array, pieces: Pieces, *, on_sphere: bool) -> tuple[Array, Array]:
    """Squared algebraic errors ``(x2^T M x1)^2`` and their variances ``s^2``, whose ratio is the squared Sampson error.

    Parameters
    ----------
    matrices : (m, 3, 3) array
        Essential or fundamental matrices.
    pieces : Pieces
        Three columns of x1 and three of x2.
    on_sphere : bool
        Whether x1 and x2 are unit rays; otherwise their third coordinates are 1.

    Returns
    -------
    squared, variance : (p, length) array
    """
    squared, variance = np.empty((2, len(pieces.counts), pieces.columns.shape[2]))
    for block in pieces.blocks():
        columns, matrix = pieces.columns[block.pieces], matrices[pieces.segments[block.pieces]]
        line2 = matrix @ columns[:, :3]
        line1 = np.swapaxes(matrix, 1, 2) @ columns[:, 3:]
        algebraic = np.square(np.einsum("pak,pak->pk", columns[:, 3:], line2))
        spread = np.square(line1[:, :2]).sum(axis=1) + np.square(line2[:, :2]).sum(axis=1)
        if on_sphere:
            spread += np.square(line1[:, 2]) + np.square(line2[:, 2]) - 2.0 * algebraic
        squared[block.pieces], variance[block.pieces] = algebraic, spread
    return squared, variance
