"""Errors of estimated poses with respect to true ones, after removing the gauge.

Positions are compared after the best similarity over all cameras (eq. rts of Nasiri et al.), rotations after the best
rotation of the world. Relative poses need no alignment: their only gauge is the scale, and their translations are
compared by direction.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import angle_between
from colmap_vg.geometry.similarity import Similarity, align_positions

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

AUC_THRESHOLDS_DEG = (0.5, 1.0, 5.0, 10.0)
"""Default thresholds of the area under the curve, degrees."""
FAILED_DEG = 180.0
"""Error of a pair with an image that is not registered, degrees, as in COLMAP's benchmark."""
PAIRS_AT_ONCE = 500_000
"""Number of ordered pairs compared in one batch, which takes about 200 MB."""


@dataclass(frozen=True, eq=False)
class PositionErrors:
    """Distances to the true positions after the best similarity, in the unit of the true positions.

    Attributes
    ----------
    rms, mean, median : float
        Over cameras. (The paper divides by "the number of edges" m in the RMS, but sums over cameras.)
    distances : (n,) array
    similarity : Similarity
        ``truth ≈ similarity(estimated)``.
    """

    rms: float
    mean: float
    median: float
    distances: Array
    similarity: Similarity


@dataclass(frozen=True, eq=False)
class RotationErrors:
    """Angles to the true rotations after the best rotation of the world, degrees.

    Attributes
    ----------
    rms_deg, mean_deg, median_deg : float
    angles_deg : (n,) array
    world_rotation : (3, 3) array
        ``truth ≈ estimated @ world_rotation``.
    """

    rms_deg: float
    mean_deg: float
    median_deg: float
    angles_deg: Array
    world_rotation: Array


def position_errors(estimated: Array, truth: Array) -> PositionErrors:
    """Compute errors of positions after the best similarity (eq. RMSE of Nasiri et al.).

    Parameters
    ----------
    estimated, truth : (n, 3) array
        Camera centres in the same order, n >= 1.

    Returns
    -------
    PositionErrors

    Raises
    ------
    GraphError
        Shapes differ, n is zero, or a value is not finite.
    """
    distances, similarity = align_positions(estimated, truth)
    return PositionErrors(*_summary(distances), distances, similarity)


def rotation_errors(estimated: Array, truth: Array) -> RotationErrors:
    """Compute errors of rotations after the rotation of the world with the least chordal distance.

    Parameters
    ----------
    estimated, truth : (n, 3, 3) array
        cam_from_world in the same order, n >= 1.

    Returns
    -------
    RotationErrors

    Raises
    ------
    GraphError
        Shapes differ, n is zero, or a value is not finite.
    """
    estimated, truth = _checked(estimated, truth, (3, 3), "rotation_errors")
    # min over S of sum ||R_i S - T_i||_F^2: the rotation nearest to sum R_i^T T_i.
    world = so3.project(np.einsum("kba,kbc->ac", estimated, truth))
    angles = np.degrees(so3.angle(np.einsum("kab,bc,kdc->kad", estimated, world, truth)))
    return RotationErrors(*_summary(angles), angles, world)


def relative_pose_errors(
    estimated_rotations: Array,
    estimated_centers: Array,
    true_rotations: Array,
    true_centers: Array,
    *,
    registered: BoolArray | None = None,
    min_baseline: float = 0.0,
) -> Array:
    """Compute angular errors of the relative poses of all ordered pairs of images, degrees.

    An error is the larger of the angle between the relative rotations and the angle between the directions of the
    relative translations, as in COLMAP's benchmark. Both orders of a pair count, since the direction is expressed in
    the second camera's frame and contains the error of its rotation.

    Parameters
    ----------
    estimated_rotations, true_rotations : (n, 3, 3) array
        cam_from_world.
    estimated_centers, true_centers : (n, 3) array
        Any world frames and scales.
    registered : (n,) bool array, optional
        Pairs with an image that is not registered have an error of 180 degrees. Default: images with finite positions.
    min_baseline : float
        True distance below which only rotations are compared, in the unit of the true positions.

    Returns
    -------
    (n (n - 1),) array
        Errors of pairs (i, j), i != j, ordered by i and then j.

    Raises
    ------
    GraphError
        Shapes differ, n is below 2, or a value of the truth or of a registered image is not finite.
    """
    p = np.asarray(estimated_centers, dtype=float)
    known = np.isfinite(p).all(axis=-1) if registered is None else np.asarray(registered, dtype=bool)
    n = len(known)
    if n < 2 or known.shape != (n,) or len(np.asarray(estimated_rotations)) != n or len(p) != n:
        raise GraphError("relative_pose_errors needs poses of at least two images and one registered flag for each")
    eye, zero = np.eye(3), np.zeros(3)
    R = np.where(known[:, None, None], estimated_rotations, eye)
    R, T = _checked(R, true_rotations, (3, 3), "relative_pose_errors")
    p, q = _checked(np.where(known[:, None], p, zero), true_centers, (3,), "relative_pose_errors")
    errors = np.empty(n * (n - 1))
    for at, i, j in _ordered_pairs(n):
        turned = np.einsum("kba,kbc->kac", R[j] @ np.swapaxes(R[i], 1, 2), T[j] @ np.swapaxes(T[i], 1, 2))
        estimated = np.einsum("kab,kb->ka", R[j], p[j] - p[i])
        true = np.einsum("kab,kb->ka", T[j], q[j] - q[i])
        baseline = np.linalg.norm(true, axis=1)
        direction = angle_between(estimated, true)
        # Cameras at the same position have no direction; the error is 90 degrees, as in the benchmark.
        direction = np.where(baseline * np.linalg.norm(estimated, axis=1) > 0.0, direction, 0.5 * np.pi)
        direction = np.where(baseline < min_baseline, 0.0, direction)
        worst = np.degrees(np.maximum(so3.angle(turned), direction))
        errors[at] = np.where(known[i] & known[j], worst, FAILED_DEG)
    return errors


def area_under_curve(errors: Array, thresholds: Sequence[float] = AUC_THRESHOLDS_DEG) -> Array:
    """Compute the area under the recall curve up to each error threshold, as a share of the threshold, 0 to 1.

    The recall is linear between errors and constant from the last one to the threshold, as in COLMAP's benchmark
    (which gives percent).

    Parameters
    ----------
    errors : (k,) array
        k >= 1; infinite errors are never recalled.
    thresholds : sequence of float
        Positive, in the unit of the errors.

    Returns
    -------
    (len(thresholds),) array

    Raises
    ------
    GraphError
        There are no errors, one is NaN or negative, or a threshold is not positive.
    """
    ordered = np.sort(np.asarray(errors, dtype=float).ravel())
    limits = np.asarray(thresholds, dtype=float)
    if len(ordered) == 0 or not (ordered >= 0.0).all() or not (limits > 0.0).all():
        raise GraphError("area_under_curve needs at least one error, none of them NaN or negative, and thresholds > 0")
    e = np.concatenate([[0.0], ordered])
    recall = np.arange(len(e)) / len(ordered)
    last = np.searchsorted(e, limits, side="right") - 1
    finite = np.where(np.isfinite(e), e, 0.0)
    area = np.concatenate([[0.0], np.cumsum(np.diff(finite) * 0.5 * (recall[1:] + recall[:-1]))])
    return np.asarray((area[last] + (limits - e[last]) * recall[last]) / limits)


def _summary(errors: Array) -> tuple[float, float, float]:
    return float(np.sqrt(np.mean(errors**2))), float(errors.mean()), float(np.median(errors))


def _checked(estimated: Array, truth: Array, shape: tuple[int, ...], where: str) -> tuple[Array, Array]:
    estimated, truth = np.asarray(estimated, dtype=float), np.asarray(truth, dtype=float)
    if estimated.shape != truth.shape or estimated.shape[1:] != shape or len(truth) == 0:
        raise GraphError(
            f"{where} needs arrays (n, {', '.join(map(str, shape))}), n >= 1, found {estimated.shape}, {truth.shape}"
        )
    if not (np.isfinite(estimated).all() and np.isfinite(truth).all()):
        raise GraphError(f"{where}: poses contain NaN or infinite values; remove unregistered images first")
    return estimated, truth


def _ordered_pairs(n: int) -> Iterator[tuple[slice, NDArray[np.int64], NDArray[np.int64]]]:
    """Yield all (i, j), i != j, ordered by i and then j, in batches: slice of the result, i (k,), j (k,)."""
    total = n * (n - 1)
    for start in range(0, total, PAIRS_AT_ONCE):
        at = np.arange(start, min(start + PAIRS_AT_ONCE, total))
        i, rest = np.divmod(at, n - 1)
        yield slice(start, start + len(at)), i, rest + (rest >= i)
