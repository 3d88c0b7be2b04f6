"""Essential and fundamental matrices of all edges: conversion, and relative poses by cheirality.

With ``cam2_from_cam1 = (R, t)`` a match satisfies ``x2^T E x1 = 0``, ``E = [t]_x R = -R [d]_x``, where
``d = -R^T t`` is the direction of camera 2's centre in camera 1's frame (Hartley & Zisserman, Multiple View Geometry,
§9.6).
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import angle_between
from colmap_vg.two_view.segments import (
    products_of_segments,
    segment_of_rows,
    segment_quantiles,
    segment_subset,
    segment_sums,
)

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class RelativePoses:
    """Relative poses of m edges, with cheirality counts and triangulation angles.

    Attributes
    ----------
    rotations : (m, 3, 3) array
        cam2_from_cam1 rotations.
    directions : (m, 3) array
        Unit directions of camera 2's centre in camera 1's frame.
    num_in_front : (m,) int64 array
        Number of matches whose rays meet in front of both cameras.
    share_in_front : (m,) array
        Their share of all matches of the edge; 0 for edges without matches.
    median_angles : (m,) array
        Median angle between the two rays of the matches in front, radians; 0 where there are none.
    """

    rotations: Array
    directions: Array
    num_in_front: IntArray
    share_in_front: Array
    median_angles: Array

    def of(self, edges: IntArray) -> "RelativePoses":
        """Relative poses of the given edges, in the given order."""
        return RelativePoses(*(getattr(self, f.name)[edges] for f in fields(self)))

    def replaced(self, edges: IntArray, others: "RelativePoses") -> "RelativePoses":
        """Copy with the poses of the given edges (e,) replaced."""
        columns = [getattr(self, f.name).copy() for f in fields(self)]
        for column, f in zip(columns, fields(self), strict=True):
            column[edges] = getattr(others, f.name)
        return RelativePoses(*columns)


def essential_from_pose(rotations: Array, directions: Array) -> Array:
    """Essential matrices ``E = -R [d]_x``, singular values (1, 1, 0), of rotations (m, 3, 3) and directions (m, 3)."""
    return np.asarray(-rotations @ so3.hat(directions))


def essential_from_fundamental(F: Array, K1: Array, K2: Array) -> Array:
    """Matrices ``E = K2^T F K1`` of unit Frobenius norm; the singular values are not equalised.

    Parameters
    ----------
    F : (m, 3, 3) array
        Fundamental matrices on pixels, ``x2^T F x1 = 0``.
    K1, K2 : (m, 3, 3) or (3, 3) array
        Calibration matrices.

    Returns
    -------
    (m, 3, 3) array
    """
    E = np.swapaxes(K2, -1, -2) @ F @ K1
    norm = np.linalg.norm(E, axis=(-2, -1), keepdims=True)
    return np.asarray(E / np.where(norm > 0, norm, 1.0))


def nearest_essential(M: Array) -> Array:
    """Nearest essential matrices with singular values (1, 1, 0), in the Frobenius norm up to scale: (m, 3, 3)."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U[..., :, :2] @ Vt[..., :2, :])


def in_front_of_both(
    rotations: Array, directions: Array, offsets: IntArray, bearings1: Array, bearings2: Array
) -> BoolArray:
    """Mask (k,) of the matches whose rays meet (in least squares) in front of both cameras.

    The depths that minimise ``|l1 R x1 + t - l2 x2|`` have the signs of ``c (b.t) - a.t`` and ``b.t - c (a.t)``, with
    ``a = R x1``, ``b = x2``, ``c = a.b``.
    """
    edge = segment_of_rows(offsets)
    a = products_of_segments(rotations, offsets, bearings1)
    t = -np.einsum("mij,mj->mi", rotations, directions)[edge]
    along1, along2 = np.einsum("ki,ki->k", a, t), np.einsum("ki,ki->k", bearings2, t)
    cosine = np.einsum("ki,ki->k", a, bearings2)
    return np.asarray((cosine * along2 > along1) & (along2 > cosine * along1))


def check_cheirality(
    rotations: Array, directions: Array, offsets: IntArray, bearings1: Array, bearings2: Array
) -> RelativePoses:
    """Count the matches in front of both cameras, and their triangulation angles, for poses (m, 3, 3), (m, 3)."""
    front = in_front_of_both(rotations, directions, offsets, bearings1, bearings2)
    num = segment_sums(offsets, front.astype(np.float64)).astype(np.int64)
    of_front = segment_subset(offsets, front)
    turned = products_of_segments(rotations, of_front, bearings1[front])
    angles = segment_quantiles(of_front, angle_between(turned, bearings2[front]))
    share = num / np.maximum(np.diff(offsets), 1)
    return RelativePoses(rotations, directions, num, share, np.where(num > 0, np.nan_to_num(angles), 0.0))


def poses_from_essential(E: Array, offsets: IntArray, bearings1: Array, bearings2: Array) -> RelativePoses:
    """Decompose essential matrices into the one of four relative poses with most matches in front of both cameras.

    Hartley & Zisserman §9.6.2. Ties, including edges without matches, go to the first candidate.

    Parameters
    ----------
    E : (m, 3, 3) array
        Essential matrices of any scale and sign; unequal singular values are equalised.
    offsets : (m + 1,) int array
        Matches of edge k are rows ``offsets[k]:offsets[k + 1]``.
    bearings1, bearings2 : (k, 3) array
        Unit rays of the matches.

    Returns
    -------
    RelativePoses
    """
    U, _, Vt = np.linalg.svd(E)
    U = U * np.sign(np.linalg.det(U))[:, None, None]
    Vt = Vt * np.sign(np.linalg.det(Vt))[:, None, None]
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    # E does not determine the sign of t, and its null vector is the direction for both rotations.
    rotation_pair = (U @ quarter @ Vt, U @ quarter.T @ Vt)
    direction = Vt[:, 2, :]
    candidates = [(R, s * direction) for R in rotation_pair for s in (1.0, -1.0)]
    votes = np.stack(
        [
            segment_sums(offsets, in_front_of_both(R, d, offsets, bearings1, bearings2).astype(np.float64))
            for R, d in candidates
        ]
    )
    best, rows = np.argmax(votes, axis=0), np.arange(len(E))
    R = np.stack([c[0] for c in candidates])[best, rows]
    d = np.stack([c[1] for c in candidates])[best, rows]
    return check_cheirality(R, d, offsets, bearings1, bearings2)
