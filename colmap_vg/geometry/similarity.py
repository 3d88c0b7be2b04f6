"""Similarity transformations, and least-squares alignment of positions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import GraphError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Similarity:
    """Similarity transformation ``x -> scale * rotation @ x + translation``.

    Attributes
    ----------
    scale : float
    rotation : (3, 3) array
    translation : (3,) array
    """

    scale: float
    rotation: Array
    translation: Array

    def apply(self, points: Array) -> Array:
        """Transform points (n, 3)."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    def inverse(self) -> "Similarity":
        """Inverse similarity."""
        back = self.rotation.T / self.scale
        return Similarity(1.0 / self.scale, self.rotation.T, -back @ self.translation)


def align_positions(estimated: Array, truth: Array) -> tuple[Array, Similarity]:
    """Align estimated to true positions by the best similarity, and return the remaining distances.

    Minimises ``sum_i ||s R p_i + t - q_i||^2`` (eq. rts of Nasiri et al.) in closed form (Umeyama, PAMI 1991).

    Parameters
    ----------
    estimated, truth : (n, 3) array
        Positions in the same order, any unit; n >= 1.

    Returns
    -------
    errors : (n,) array
        Distances after alignment, in the unit of `truth`.
    similarity : Similarity
        ``truth ≈ scale rotation estimated + translation``.

    Raises
    ------
    GraphError
        The shapes differ or are not (n, 3), n is zero, or a value is not finite.
    """
    estimated, truth = np.asarray(estimated, dtype=float), np.asarray(truth, dtype=float)
    if estimated.shape != truth.shape or estimated.ndim != 2 or estimated.shape[1:] != (3,) or len(truth) == 0:
        raise GraphError(
            f"align_positions needs two (n, 3) arrays with n >= 1, found {estimated.shape} and {truth.shape}"
        )
    if not (np.isfinite(estimated).all() and np.isfinite(truth).all()):
        raise GraphError("align_positions: positions have NaN or infinite values; remove unregistered images first")
    scales, rotations, translations = best_similarities(estimated[None], truth[None])
    if not np.isfinite(scales[0]):  # one position, or all equal
        similarity = Similarity(1.0, rotations[0], truth.mean(axis=0) - rotations[0] @ estimated.mean(axis=0))
    else:
        similarity = Similarity(float(scales[0]), rotations[0], translations[0])
    return np.linalg.norm(similarity.apply(estimated) - truth, axis=1), similarity


def best_similarities(estimated: Array, truth: Array) -> tuple[Array, Array, Array]:
    """Least-squares similarities of many sets of positions at once (Umeyama, PAMI 1991).

    Parameters
    ----------
    estimated, truth : (h, n, 3) array

    Returns
    -------
    scales : (h,) array
        NaN where all estimated positions of a set are equal.
    rotations : (h, 3, 3) array
    translations : (h, 3) array
        ``truth ≈ scale rotation estimated + translation``.
    """
    mean_p, mean_q = estimated.mean(axis=1), truth.mean(axis=1)
    P, Q = estimated - mean_p[:, None], truth - mean_q[:, None]
    U, S, Vt = np.linalg.svd(np.swapaxes(Q, 1, 2) @ P)
    signs = np.ones_like(S)
    signs[:, 2] = np.sign(np.linalg.det(U @ Vt))
    rotations = (U * signs[:, None]) @ Vt
    spread = np.sum(P * P, axis=(1, 2))
    scales = np.sum(S * signs, axis=1) / np.where(spread > 0, spread, np.nan)
    return scales, rotations, mean_q - scales[:, None] * np.einsum("hab,hb->ha", rotations, mean_p)
