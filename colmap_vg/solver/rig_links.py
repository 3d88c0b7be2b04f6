"""Link components of a solution whose images are taken at once by a calibrated rig, though no pair matches them.

Images a and b of one frame, in components with frames of their own, have ``R_b = S_b S_a^T R_a W`` with one rotation W
between the components, and centres ``s W C_b + t - m F^T (c_b - c_a) = C_a``: linear in the scale s, the translation t
and the factor m on the rig's baselines, with ``F = S_a^T R_a``.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.geometry.similarity import Similarity
from colmap_vg.scene.rigs import Rigs

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

MIN_FRAMES = 3
"""Minimum number of common frames that link two components."""
MAX_ROTATION_DEG, MAX_SHIFT = 5.0, 0.1
"""Largest deviation at which a frame agrees with a link: rotation in degrees, and position as a share of the extent."""
MIN_SHARE_AGREEING = 0.6
"""Minimum share of the common frames that agree."""
NUM_REWEIGHTED = 20


def link_components(rigs: Rigs, rotations: Array, centers: Array, component: IntArray) -> IntArray:
    """Move components that share frames with a larger one into its frame, in place; return the new components.

    Parameters
    ----------
    rigs : Rigs
    rotations : (n, 3, 3) array
        cam_from_world; changed in place.
    centers : (n, 3) array
        Projection centres; changed in place.
    component : (n,) int64 array
        Component of each image; -1 if unsolved.

    Returns
    -------
    (n,) int64 array
        Linked components have the number of the one they were moved to; numbers may be missing.
    """
    component = component.copy()
    sizes = np.bincount(component[component >= 0])
    order = np.argsort(-sizes, kind="stable").tolist()
    for place, base in enumerate(order):
        linked = True
        while linked:
            linked = False
            for other in order[place + 1 :]:
                own, theirs = np.flatnonzero(component == base), np.flatnonzero(component == other)
                move = _link(rigs, rotations, centers, own, theirs) if len(theirs) and len(own) else None
                if move is not None:
                    rotations[theirs] = rotations[theirs] @ move.rotation.T
                    centers[theirs] = move.apply(centers[theirs])
                    component[theirs], linked = base, True
    return component


def _link(rigs: Rigs, rotations: Array, centers: Array, own: IntArray, theirs: IntArray) -> Similarity | None:
    """Similarity from the frame of some images to that of others; None where too few common frames agree on one."""
    placed = rigs.known
    a, b = _common(rigs, own[placed[rigs.sensor_idx[own]]], theirs[placed[rigs.sensor_idx[theirs]]])
    if len(np.unique(rigs.frame_idx[a])) < MIN_FRAMES:
        return None
    S_a, S_b = rigs.rotations[rigs.sensor_idx[a]], rigs.rotations[rigs.sensor_idx[b]]
    F = np.swapaxes(S_a, 1, 2) @ rotations[a]
    # Each frame's own rotation from the other component's frame to this one.
    turns = np.swapaxes(S_b @ F, 1, 2) @ rotations[b]
    turn = _median(turns)
    offset = np.einsum("kba,kb->ka", F, (rigs.centers[rigs.sensor_idx[b]] - rigs.centers[rigs.sensor_idx[a]]))
    scale, shift, residuals = _scale_and_shift(centers[b] @ turn.T, offset, centers[a])
    extent = np.linalg.norm(centers[own] - centers[own].mean(axis=0), axis=1).max()
    agree = so3.angle(np.swapaxes(turns, 1, 2) @ turn) <= np.radians(MAX_ROTATION_DEG)
    agree &= residuals <= MAX_SHIFT * extent
    if scale <= 0.0 or agree.mean() < MIN_SHARE_AGREEING or len(np.unique(rigs.frame_idx[a[agree]])) < MIN_FRAMES:
        return None
    return Similarity(scale, turn, shift)


def _common(rigs: Rigs, own: IntArray, theirs: IntArray) -> tuple[IntArray, IntArray]:
    """Rows of all pairs of images, one of either set, that share a frame."""
    same = rigs.frame_idx[own][:, None] == rigs.frame_idx[theirs]
    a, b = np.nonzero(same)
    return own[a], theirs[b]


def _median(turns: Array) -> Array:
    """Geometric median of rotations, by chords."""
    weights = np.ones(len(turns))
    for _ in range(NUM_REWEIGHTED):
        found = so3.project(np.einsum("k,kab->ab", weights, turns)[None])[0]
        weights = 1.0 / np.maximum(np.linalg.norm(turns - found, axis=(1, 2)), 1e-9)
    return np.asarray(found)


def _scale_and_shift(turned: Array, offset: Array, target: Array) -> tuple[float, Array, Array]:
    """Scale, translation and residuals (k,) of ``s turned + t - m offset = target``, by least absolute residuals."""
    k = len(turned)
    A = np.concatenate([turned[:, :, None], np.broadcast_to(np.eye(3), (k, 3, 3)), -offset[:, :, None]], axis=2)
    weights = np.ones(k)
    for _ in range(NUM_REWEIGHTED):
        root = np.repeat(np.sqrt(weights), 3)
        solution = np.linalg.lstsq(root[:, None] * A.reshape(-1, 5), root * target.ravel(), rcond=1e-10)[0]
        residuals = np.linalg.norm(A @ solution - target, axis=1)
        weights = 1.0 / np.maximum(residuals, 1e-9 * max(float(np.abs(target).max()), 1e-300))
    return float(solution[0]), np.asarray(solution[1:4]), np.asarray(residuals)
