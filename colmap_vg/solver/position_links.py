"""Link components of a solution that a pair and measured positions relate.

Where a chain of photographs has no point that three of them see, one pair tells the rotation and the direction from one
side to the other, but no scale. Measured positions do: with the rotation W between the components, the direction
``gamma`` of the pair (a, b) in the first one's frame, and the measured positions ``h`` in that frame, the centres C of
the second component fulfil

    C_a + l gamma + s W (C_i - C_b) = h_i,

linear in the length l of the pair's baseline and the scale s. The positions also test the pair: they contradict a false
one, whose rotation or direction moves the second component away from them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry.robust_similarity import align_robustly
from colmap_vg.geometry.similarity import Similarity
from colmap_vg.scene.pose_priors import PosePriors
from colmap_vg.scene.view_graph import ViewGraph

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MIN_POSITIONS = 3
"""Minimum number of measured positions of each component."""
MAX_SCALE_SIGMA = 0.15
"""Largest standard deviation of the logarithm of a scale, the component's own or that of the linked one."""
MAX_SIGMAS, MIN_SHARE_AGREEING = 4.5, 0.6
"""Largest residual of a position that agrees with a link, in standard deviations; minimum share of those that agree."""
NUM_REWEIGHTED = 20


@dataclass(frozen=True, eq=False)
class _Measured:
    """Measured positions of a component's images in the component's frame.

    Attributes
    ----------
    similarity : Similarity
        From the frame of the measurements to that of the component.
    sigma : float
        Standard deviation of a coordinate, in the component's unit.
    """

    similarity: Similarity
    sigma: float


def link_by_positions(
    graph: ViewGraph, usable: BoolArray, rotations: Array, centers: Array, component: IntArray
) -> IntArray:
    """Move components that pairs and measured positions link to a larger one into its frame, in place.

    Parameters
    ----------
    graph : ViewGraph
        With measured positions.
    usable : (m,) bool array
        Pairs whose rotation and direction may link components.
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
    priors, component = graph.priors, component.copy()
    if priors is None:
        return component
    order = np.argsort(-np.bincount(component[component >= 0]), kind="stable").tolist()
    for base in order:
        refused: set[int] = set()
        measured = _measured(priors, centers, component == base)
        while measured is not None:
            pair, other = _strongest_pair(graph, usable, component, base, refused)
            if pair is None:
                break
            theirs = component == other
            move = _link(graph, priors, measured, pair, rotations, centers, theirs)
            if move is None:
                refused.add(other)
                continue
            rotations[theirs] = rotations[theirs] @ move.rotation.T
            centers[theirs] = move.apply(centers[theirs])
            component[theirs] = base
            refused.clear()
            measured = _measured(priors, centers, component == base)
    return component


def _measured(priors: PosePriors, centers: Array, inside: BoolArray) -> _Measured | None:
    """Measured positions in a component's frame; None where they do not determine its scale."""
    rows = np.flatnonzero(inside & priors.has_position)
    if len(rows) < MIN_POSITIONS:
        return None
    covariances = priors.covariances[rows]
    given = covariances if np.isfinite(covariances).all() else None
    aligned = align_robustly(centers[rows], priors.positions[rows], given)
    if aligned.right.mean() < MIN_SHARE_AGREEING or not aligned.scale_uncertainty <= MAX_SCALE_SIGMA:
        return None
    variance = np.trace(aligned.covariances[aligned.right].mean(axis=0)) / 3.0
    return _Measured(aligned.similarity.inverse(), float(np.sqrt(variance)) / aligned.similarity.scale)


def _strongest_pair(
    graph: ViewGraph, usable: BoolArray, component: IntArray, base: int, refused: set[int]
) -> tuple[tuple[int, int, int] | None, int]:
    """Edge from a component to another one with most matches, as (row, image inside, image outside), and the other."""
    ends = component[graph.edges]
    crossing = usable & (ends >= 0).all(axis=1) & ((ends == base).sum(axis=1) == 1)
    crossing &= ~np.isin(ends, list(refused)).any(axis=1)
    if not crossing.any():
        return None, -1
    rows = np.flatnonzero(crossing)
    row = int(rows[0] if graph.num_inliers is None else rows[np.argmax(graph.num_inliers[rows])])
    i, j = graph.edges[row].tolist()
    a, b = (i, j) if component[i] == base else (j, i)
    return (row, a, b), int(component[b])


def _link(
    graph: ViewGraph,
    priors: PosePriors,
    measured: _Measured,
    pair: tuple[int, int, int],
    rotations: Array,
    centers: Array,
    theirs: BoolArray,
) -> Similarity | None:
    """Similarity from another component's frame to that of the measured one; None where the positions contradict it."""
    row, a, b = pair
    R, d = graph.cam2_from_cam1_rotations[row], graph.cam2_in_cam1_directions[row]
    if graph.edges[row, 0] == a:
        turned, direction = R @ rotations[a], rotations[a].T @ d
    else:
        turned = R.T @ rotations[a]
        direction = -turned.T @ d
    turn = turned.T @ rotations[b]
    rows = np.flatnonzero(theirs & priors.has_position)
    if len(rows) < MIN_POSITIONS:
        return None
    relative = (centers[rows] - centers[b]) @ turn.T
    target = measured.similarity.apply(priors.positions[rows]) - centers[a]
    A = np.stack([np.broadcast_to(direction, relative.shape), relative], axis=2)
    (length, scale), residuals = _least_absolute(A, target)
    agree = residuals <= MAX_SIGMAS * measured.sigma
    if length <= 0.0 or scale <= 0.0 or agree.mean() < MIN_SHARE_AGREEING or agree.sum() < MIN_POSITIONS:
        return None
    spread = scale * float(np.sqrt(np.sum((relative[agree] - relative[agree].mean(axis=0)) ** 2)))
    if not measured.sigma <= MAX_SCALE_SIGMA * spread:
        return None
    return Similarity(scale, turn, centers[a] + length * direction - scale * turn @ centers[b])


def _least_absolute(A: Array, target: Array) -> tuple[tuple[float, float], Array]:
    """Two unknowns that minimise the sum of the norms of ``A x - target`` (k, 3, 2), (k, 3), and these norms."""
    weights, unit = np.ones(len(A)), max(float(np.abs(target).max()), 1e-300)
    for _ in range(NUM_REWEIGHTED):
        root = np.sqrt(weights)
        x = np.linalg.lstsq((root[:, None, None] * A).reshape(-1, 2), (root[:, None] * target).ravel(), rcond=1e-12)[0]
        residuals = np.linalg.norm(A @ x - target, axis=1)
        weights = 1.0 / np.maximum(residuals, 1e-9 * unit)
    return (float(x[0]), float(x[1])), np.asarray(residuals)
