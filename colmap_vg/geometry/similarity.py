"""Similarity transformations and the best one between two sets of positions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.errors import GraphError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Similarity:
    """``x -> scale * rotation @ x + translation``.

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


def align_positions(estimated: Array, truth: Array) -> tuple[Array, Similarity]:
    """Distances left after the similarity that best maps estimated on true positions, over all cameras.

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
        raise GraphError("align_positions: positions hold NaN or infinite values; leave unregistered images out first")
    mean_p, mean_q = estimated.mean(axis=0), truth.mean(axis=0)
    P, Q = estimated - mean_p, truth - mean_q
    U, S, Vt = np.linalg.svd(Q.T @ P)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    rotation = (U * signs) @ Vt
    spread = np.sum(P * P)
    scale = float(np.sum(S * signs) / spread) if spread > 0 else 1.0
    similarity = Similarity(scale, rotation, mean_q - scale * rotation @ mean_p)
    return np.linalg.norm(similarity.apply(estimated) - truth, axis=1), similarity
