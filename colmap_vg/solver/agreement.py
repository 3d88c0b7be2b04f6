"""Agreement of a graph's pairs, and of their matches, with solved cameras."""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry.directions import normalized
from colmap_vg.scene.edge_residuals import rotation_residuals
from colmap_vg.scene.solution import Agreement
from colmap_vg.scene.view_graph import ViewGraph

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

MAX_ROTATION_DEG = 5.0
"""Largest angle between the rotation of a pair that agrees and that of the cameras, degrees."""
MAX_DIRECTION_SIGMAS, MODEL_SIGMA_DEG, UNKNOWN_SIGMA_DEG = 3.0, 1.0, 3.0
"""Largest direction error of a pair that agrees, in standard deviations; the part of the standard deviation due to the
lens model, degrees; and the standard deviation if the graph has no information, degrees."""


def pair_agreement(graph: ViewGraph, rotations: Array, centers: Array, component: IntArray) -> tuple[Agreement, ...]:
    """Compute the agreement of each component with its pairs.

    Parameters
    ----------
    graph : ViewGraph
    rotations : (n, 3, 3) array
        cam_from_world rotations.
    centers : (n, 3) array
        Projection centres, frame of their component.
    component : (n,) int array
        Component of each image, from 0; -1 if unsolved.

    Returns
    -------
    tuple of Agreement
        One per component, in order. All pairs with a known relative pose count, also those dropped as outliers.
    """
    rotation, direction = pose_errors_deg(graph, rotations, centers, component)
    inliers = np.ones(graph.num_edges) if graph.num_inliers is None else graph.num_inliers.astype(np.float64)
    sigma = np.full(graph.num_edges, UNKNOWN_SIGMA_DEG)
    if graph.edge_information is not None:
        # Directions that no match constrains get a standard deviation of a radian instead of an infinite one.
        covariance = np.linalg.inv(graph.edge_information + np.eye(5))[:, 3:, 3:]
        sigma = np.degrees(np.sqrt(np.linalg.eigvalsh(covariance)[:, -1]))
    turned = rotation <= MAX_ROTATION_DEG
    pointing = direction <= MAX_DIRECTION_SIGMAS * np.hypot(sigma, MODEL_SIGMA_DEG)
    found = []
    for index in range(int(component.max(initial=-1)) + 1):
        inside = component[graph.edges[:, 0]] == index
        with_rotation, with_direction = inside & np.isfinite(rotation), inside & np.isfinite(direction)
        found.append(
            Agreement(
                inliers=_share(inliers, turned, with_rotation),
                pairs=_share(np.ones(graph.num_edges), turned, with_rotation),
                directions=_share(inliers, pointing, with_direction),
                num_pairs=int(with_rotation.sum()),
            )
        )
    return tuple(found)


def _share(weights: Array, agree: NDArray[np.bool_], among: NDArray[np.bool_]) -> float:
    total = float(weights[among].sum())
    return float(weights[among & agree].sum()) / total if total > 0 else 1.0


def pose_errors_deg(graph: ViewGraph, rotations: Array, centers: Array, component: IntArray) -> tuple[Array, Array]:
    """Angles between the relative rotations and directions of edges and those of solved cameras.

    Parameters
    ----------
    graph : ViewGraph
    rotations : (n, 3, 3) array
        cam_from_world rotations.
    centers : (n, 3) array
        Projection centres, frame of their component.
    component : (n,) int array
        Component of each image, from 0; -1 if unsolved.

    Returns
    -------
    rotation, direction : (m,) array
        Degrees; NaN if the images are in no common component, or the edge has no rotation or direction.
    """
    i, j = graph.edges.T
    same = (component[i] >= 0) & (component[i] == component[j])
    rotation, direction = np.full((2, graph.num_edges), np.nan)
    known = same & graph.has_rotation
    residuals = rotation_residuals(graph.edges[known], graph.cam2_from_cam1_rotations[known], rotations)
    rotation[known] = np.degrees(residuals)
    known = same & graph.has_direction
    solved = normalized(np.einsum("kab,kb->ka", rotations[i[known]], centers[j[known]] - centers[i[known]]))
    chord = np.linalg.norm(solved - graph.cam2_in_cam1_directions[known], axis=1)
    direction[known] = np.degrees(2.0 * np.arcsin(np.clip(chord / 2.0, 0.0, 1.0)))
    return rotation, direction
