"""Residuals of the relative poses of edges at solved cameras, in radians and in standard deviations."""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized, tangent_basis
from colmap_vg.scene.view_graph import ViewGraph

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


def rotation_residuals(edges: IntArray, cam2_from_cam1_rotations: Array, cam_from_world_rotations: Array) -> Array:
    """Angles between measured and solved relative rotations.

    Parameters
    ----------
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
    cam_from_world_rotations : (n, 3, 3) array

    Returns
    -------
    (m,) array
        ``angle(R_ij^T R_j R_i^T)``, radians in [0, pi].
    """
    R = cam_from_world_rotations
    i, j = edges[:, 0], edges[:, 1]
    return so3.angle(np.swapaxes(R[j], 1, 2) @ cam2_from_cam1_rotations @ R[i])


def edge_residual_sigmas(
    edges: IntArray,
    cam2_from_cam1_rotations: Array,
    cam2_in_cam1_directions: Array,
    information: Array,
    cam_from_world_rotations: Array,
    projection_centers: Array,
) -> Array:
    """Root mean square of the five residuals of each edge's relative pose, whitened by its information.

    Parameters
    ----------
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
    cam2_in_cam1_directions : (m, 3) array
        Unit vectors.
    information : (m, 5, 5) array
        Inverse covariances, as in `ViewGraph.edge_information`.
    cam_from_world_rotations : (n, 3, 3) array
    projection_centers : (n, 3) array

    Returns
    -------
    (m,) array
        About 1 if the noise of the edge's matches is the only error; more if the camera model is not exact.
    """
    i, j = edges.T
    R, p = cam_from_world_rotations, projection_centers
    turn = so3.log(R[j] @ np.swapaxes(R[i], 1, 2) @ np.swapaxes(cam2_from_cam1_rotations, 1, 2))
    solved = normalized(np.einsum("kab,kb->ka", R[i], p[j] - p[i]))
    across = np.einsum("kab,ka->kb", tangent_basis(cam2_in_cam1_directions), solved)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, np.einsum("ka,ka->k", solved, cam2_in_cam1_directions))
    tilt = across * (angle / np.maximum(sine, np.finfo(float).tiny))[:, None]
    residual = np.concatenate([turn, tilt], axis=1)
    return np.asarray(np.sqrt(np.einsum("ka,kab,kb->k", residual, information, residual) / 5.0))


def graph_residual_sigmas(graph: ViewGraph, rotations: Array, centers: Array, component: IntArray) -> Array | None:
    """Residuals of all edges of a graph at solved poses, computed by :func:`edge_residual_sigmas`.

    Parameters
    ----------
    graph : ViewGraph
    rotations : (n, 3, 3) array
        cam_from_world rotations.
    centers : (n, 3) array
        Projection centres, frame of their component.
    component : (n,) int array
        Number of each image's frame; -1 if unsolved.

    Returns
    -------
    (m,) array or None
        NaN for edges between frames and for those without a direction; None for graphs without information.
    """
    if graph.edge_information is None:
        return None
    ends = component[graph.edges]
    rows = np.flatnonzero((ends[:, 0] >= 0) & (ends[:, 0] == ends[:, 1]) & graph.has_direction)
    sigmas = np.full(graph.num_edges, np.nan)
    sigmas[rows] = edge_residual_sigmas(
        graph.edges[rows],
        graph.cam2_from_cam1_rotations[rows],
        graph.cam2_in_cam1_directions[rows],
        graph.edge_information[rows],
        rotations,
        centers,
    )
    return sigmas
