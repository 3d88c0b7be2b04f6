"""The last phase of rotation averaging: precise inside the consensus that was found, and never at its cost."""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.rotations.robust import average_rotations_robust
from colmap_vg.scene.edge_residuals import rotation_residuals
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

AGREEMENT_DEG = 5.0
"""A pair within this of the averaged rotations agrees."""
MAX_WEIGHT = 10.0
"""Likelihood of one edge, over the median edge's, that counts at most: no single pair outvotes a group."""
MAX_LOSS = 0.002
"""Of the consensus, that refining may cost: a few pairs at the very bound of agreement."""


def capped_likelihoods(likelihoods: Array) -> Array:
    """Likelihoods over their median, up to `MAX_WEIGHT`."""
    return np.asarray(np.minimum(likelihoods / np.median(likelihoods), MAX_WEIGHT))


def consensus_of(edges: IntArray, cam2_from_cam1_rotations: Array, capped: Array, rotations: Array) -> float:
    """Share of the edges' weight (m,) that agrees with cam_from_world rotations (n, 3, 3)."""
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
    """Average again by precision, from given rotations and by the edges that agree with them.

    The scale of the loss adapts to the noise; where that tears the consensus apart (a focal length that is a little off
    opens rings of images), it stays at `AGREEMENT_DEG`, and where that does, too, the rotations stay.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
        Of a connected graph.
    cam2_from_cam1_rotations : (m, 3, 3) array
    likelihoods : (m,) array
        Evidence that edges are right: what the consensus is counted by.
    weights : (m,) array
        Precisions of the edges' rotations.
    rotations : (n, 3, 3) array
        cam_from_world.

    Returns
    -------
    rotations : (n, 3, 3) array
    log : tuple of LogEntry
        Of the last averaging.
    """
    capped = capped_likelihoods(likelihoods)
    least = consensus_of(edges, cam2_from_cam1_rotations, capped, rotations) - MAX_LOSS
    residuals = rotation_residuals(edges, cam2_from_cam1_rotations, rotations)
    # The others keep just enough to leave nothing unconnected.
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
