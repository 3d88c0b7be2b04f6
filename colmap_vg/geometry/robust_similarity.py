"""Robust alignment of positions to measured ones of which some are wrong, such as those of a GPS receiver."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.geometry.similarity import Similarity, align_positions, best_similarities

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

NUM_TRIALS = 1000
"""Number of random triples of positions. One of them has no wrong position in all but one of 1e6 runs where three
quarters of the positions are right, and one in 4e57 where nine tenths are."""
MAX_SIGMAS = 4.5
"""Residual, in standard deviations, above which a measured position is wrong; one in 6,000 right ones is above it."""
MIN_FOR_VERTICAL = 10
"""Minimum number of right positions from which the vertical standard deviation is estimated apart."""
MAX_NUM_REFITS = 20
MEDIAN_OF_CHI = 1.5382
"""Median of the norm of three standard normal variables."""
SMALLEST_SHARE = 1e-9
"""Smallest standard deviation, as a share of the extent of the measured positions."""


@dataclass(frozen=True, eq=False)
class AlignedPositions:
    """Similarity from estimated to measured positions, and what the residuals tell of the measurements.

    Attributes
    ----------
    similarity : Similarity
        ``measured ≈ scale rotation estimated + translation``.
    residuals : (n, 3) array
        ``measured - aligned``, in the unit of `measured`.
    right : (n,) bool array
        Measurements within `MAX_SIGMAS` standard deviations.
    covariances : (n, 3, 3) array
        Of the measured positions: the given ones, multiplied by one factor if the residuals exceed them, or estimated.
    roll_is_free : bool
        Whether the positions lie on a line, so that they do not determine the rotation about it.
    scale_uncertainty : float
        Standard deviation of the logarithm of the scale.
    """

    similarity: Similarity
    residuals: Array
    right: BoolArray
    covariances: Array
    roll_is_free: bool
    scale_uncertainty: float


def align_robustly(
    estimated: Array, measured: Array, covariances: Array | None = None, seed: int = 0
) -> AlignedPositions:
    """Align estimated to measured positions, some of which are wrong by any amount.

    A search by random triples for the smallest median residual (Rousseeuw, JASA 1984) is followed by weighted least
    squares of the measurements that agree, until these do not change.

    Parameters
    ----------
    estimated : (n, 3) array
        Positions in any frame and scale, more precise than the measurements; n >= 3.
    measured : (n, 3) array
        More than half of them are right. The third axis is vertical: where no covariances are given, its standard
        deviation is estimated apart from that of the other two.
    covariances : (n, 3, 3) array, optional
        Of the measured positions; where one is NaN, all are estimated.
    seed : int
        Of the random triples.

    Returns
    -------
    AlignedPositions

    Raises
    ------
    GraphError
        The shapes differ, there are fewer than three positions, or a value is not finite.
    """
    estimated, measured = np.asarray(estimated, dtype=float), np.asarray(measured, dtype=float)
    if estimated.shape != measured.shape or estimated.shape[1:] != (3,) or len(measured) < 3:
        raise GraphError(f"align_robustly needs two (n, 3) arrays with n >= 3: {estimated.shape} and {measured.shape}")
    if not (np.isfinite(estimated).all() and np.isfinite(measured).all()):
        raise GraphError("align_robustly: positions have NaN or infinite values; remove these first")
    given = covariances if covariances is not None and np.isfinite(covariances).all() else None
    similarity = _smallest_median(estimated, measured, given, seed)
    right = np.zeros(len(measured), dtype=bool)
    for _ in range(MAX_NUM_REFITS):
        residuals = measured - similarity.apply(estimated)
        known = _covariances(residuals, right, measured, given)
        before, right = right, _norms(residuals, known) <= MAX_SIGMAS * _surplus(len(measured))
        if (right == before).all() or right.sum() < 3:
            break
        similarity = _least_squares(estimated, measured, known, right)
    residuals = measured - similarity.apply(estimated)
    return AlignedPositions(
        similarity,
        residuals,
        np.asarray(right),
        known,
        *_what_is_determined(similarity, estimated[right], known[right]),
    )


def _smallest_median(estimated: Array, measured: Array, given: Array | None, seed: int) -> Similarity:
    """Similarity of the triple, or of all positions, with the smallest median residual."""
    n = len(measured)
    triples = np.argsort(np.random.default_rng(seed).random((NUM_TRIALS, n)), axis=1)[:, :3]
    scales, rotations, translations = best_similarities(estimated[triples], measured[triples])
    usable = np.isfinite(scales) & (scales > 0)
    _, best = align_positions(estimated, measured)
    least = float(np.median(_norms(measured - best.apply(estimated), given)))
    for scale, rotation, translation in zip(scales[usable], rotations[usable], translations[usable], strict=True):
        trial = Similarity(float(scale), rotation, translation)
        median = float(np.median(_norms(measured - trial.apply(estimated), given)))
        if median < least:
            best, least = trial, median
    return best


def _norms(residuals: Array, covariances: Array | None) -> Array:
    """Lengths (n,) of residuals, in standard deviations where covariances are known."""
    if covariances is None:
        return np.asarray(np.linalg.norm(residuals, axis=1))
    whitened = np.linalg.solve(np.linalg.cholesky(covariances), residuals[:, :, None])
    return np.asarray(np.linalg.norm(whitened[:, :, 0], axis=1))


def _covariances(residuals: Array, right: BoolArray, measured: Array, given: Array | None) -> Array:
    """Covariances (n, 3, 3) of the measurements, by the residuals of the right ones; at first by the median."""
    first, n = not right.any(), len(residuals)
    few = _surplus(n)
    # The fit takes seven unknowns.
    lost = 1.0 if first else max(right.sum() - 7 / 3, 1.0) / right.sum()
    if given is not None:
        norms = _norms(residuals, given)
        factor = (few * np.median(norms) / MEDIAN_OF_CHI) ** 2 if first else np.mean(norms[right] ** 2) / 3.0 / lost
        return np.asarray(given * max(float(factor), 1.0))
    if first:
        sigma = few * np.median(np.linalg.norm(residuals, axis=1)) / MEDIAN_OF_CHI
        variances = np.full(3, sigma**2)
    else:
        squared = np.mean(np.square(residuals[right]), axis=0) / lost
        apart = right.sum() >= MIN_FOR_VERTICAL
        variances = np.array([*[squared[:2].mean()] * 2, squared[2]]) if apart else np.full(3, squared.mean())
    extent = np.abs(measured - np.median(measured, axis=0)).max(initial=0.0)
    variances = np.maximum(variances, max(SMALLEST_SHARE * extent, 1e-12) ** 2)
    return np.broadcast_to(np.diag(variances), (n, 3, 3)).copy()


def _surplus(n: int) -> float:
    """Factor on the tolerance for few positions: a triple fits its own three (Rousseeuw, Leroy, 1987, sec. 5.1)."""
    return 1.0 + 5.0 / max(n - 3, 1)


def _least_squares(estimated: Array, measured: Array, covariances: Array, right: BoolArray) -> Similarity:
    """Weighted least squares by Gauss-Newton steps from the unweighted solution."""
    middle = estimated[right].mean(axis=0)
    centered = estimated[right] - middle  # so that the translation does not correlate with rotation and scale
    _, found = align_positions(centered, measured[right])
    for _ in range(10):
        J, r = _linearised(found, centered, covariances[right], measured[right])
        step = np.asarray(np.linalg.lstsq(J, r, rcond=1e-9)[0], dtype=np.float64)
        turn = so3.exp(step[None, :3])[0]
        found = Similarity(found.scale * float(np.exp(step[3])), turn @ found.rotation, found.translation + step[4:])
        if np.abs(step[:4]).max() < 1e-12:
            break
    shift = found.scale * found.rotation @ middle
    return Similarity(found.scale, so3.project(found.rotation[None])[0], found.translation - shift)


def _linearised(found: Similarity, estimated: Array, covariances: Array, measured: Array) -> tuple[Array, Array]:
    """Whitened derivatives (3 n, 7) by rotation, log scale and translation, and residuals (3 n,)."""
    turned = found.scale * estimated @ found.rotation.T
    J = np.zeros((len(turned), 3, 7))
    J[:, :, :3], J[:, :, 3], J[:, :, 4:] = -so3.hat(turned), turned, np.eye(3)
    r = measured - turned - found.translation
    root = np.linalg.cholesky(covariances)
    return np.linalg.solve(root, J).reshape(-1, 7), np.linalg.solve(root, r[:, :, None]).ravel()


def _what_is_determined(found: Similarity, estimated: Array, covariances: Array) -> tuple[bool, float]:
    """Whether the rotation about a line is free, and the standard deviation of the logarithm of the scale."""
    if len(estimated) < 3:
        return True, np.inf
    centered = estimated - estimated.mean(axis=0)
    spread = found.scale * np.linalg.svd(centered, compute_uv=False)
    sigma = float(np.sqrt(np.mean(np.trace(covariances, axis1=1, axis2=2)) / 3.0))
    # The rotation about the line is uncertain by sigma over the root sum of squared distances from it.
    free = bool(spread[1] <= 0.0 or sigma / spread[1] > MAX_ROLL_SIGMA)
    return free, sigma / max(float(np.linalg.norm(spread)), 1e-300)


MAX_ROLL_SIGMA = 0.1
"""Standard deviation of the rotation about the main axis of the positions above which it is not determined, radians."""
