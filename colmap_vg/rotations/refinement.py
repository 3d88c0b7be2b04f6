"""Final phase of rotation averaging: refinement by precision that keeps the consensus of edges."""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.rotations.robust import average_rotations_robust
from colmap_vg.scene.edge_residuals import rotation_residuals
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

AGREEMENT_DEG = 5.0
"""Largest rotation residual at which an edge agrees with averaged rotations, degrees."""
MAX_WEIGHT = 10.0
"""Upper limit of an edge's likelihood over the median, dimensionless, so that no single edge outvotes a group."""
MAX_LOSS = 0.002
"""Largest share of the consensus that refinement may lose: a few edges at the threshold of agreement."""


def capped_likelihoods(likelihoods: Array) -> Array:
    """Likelihoods divided by their median, at most `MAX_WEIGHT`."""
    return np.asarray(np.minimum(likelihoods / np.median(likelihoods), MAX_WEIGHT))


def consensus_of(edges: IntArray, cam2_from_cam1_rotations: Array, capped: Array, rotations: Array) -> float:
    """Share of the edges' weights `capped` (m,) that agrees with cam_from_world rotations (n, 3, 3)."""
    agree = rotation_residuals(edges, cam2_from_cam1_rotations, rotations) <= np.radians(AGREEMENT_DEG)
    return float(capped @ agree / capped.sum())


def refine_rotations(
    num_images: int,
    edges: IntArray,
    cam2_from_cam1_rotations: Array,
    likelihoods: Array,
    weights: Array,
    rotations: Array,
) -> tuple[Array, tuple[LogEntry, ...]]:
    """Refine rotations by precision-weighted averaging over the edges that agree with them.

    The scale of the loss adapts to the noise. If that loses consensus (a slightly wrong focal length opens rings of
    images), the scale is fixed at `AGREEMENT_DEG`; if that loses consensus, too, the rotations are returned unchanged.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        The graph must be connected.
    cam2_from_cam1_rotations : (m, 3, 3) array
    likelihoods : (m,) array
        Evidence that each edge is correct, by which the consensus is weighted.
    weights : (m,) array
        Precisions of the edges' rotations.
    rotations : (n, 3, 3) array
        Initial cam_from_world rotations.

    Returns
    -------
    rotations : (n, 3, 3) array
        cam_from_world rotations.
    log : tuple of LogEntry
        Log of the last averaging.
    """
    capped = capped_likelihoods(likelihoods)
    least = consensus_of(edges, cam2_from_cam1_rotations, capped, rotations) - MAX_LOSS
    residuals = rotation_residuals(edges, cam2_from_cam1_rotations, rotations)
    # The other edges keep a negligible weight so that the graph stays connected.
    inside = np.where(residuals <= np.radians(2.0 * AGREEMENT_DEG), weights, 1e-6 * np.median(weights))
    for adapt_sigma in (True, False):
        result = average_rotations_robust(
            num_images,
            edges,
            cam2_from_cam1_rotations,
            inside,
            rotations,
            sigma_deg=AGREEMENT_DEG,
            adapt_sigma=adapt_sigma,
            max_num_l1_iterations=0,
        )
        if consensus_of(edges, cam2_from_cam1_rotations, capped, result.cam_from_world_rotations) >= least:
            return result.cam_from_world_rotations, result.log
    return rotations, result.log
