"""Intermediate poses of a part of a graph, passed between the stages of the solver."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.scene.subgraph import Subgraph
from colmap_vg.scene.view_graph import ViewGraph

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PartPoses:
    """Poses of a part of a graph.

    Attributes
    ----------
    rotations : (k, 3, 3) array
        cam_from_world rotations.
    centers : (k, 3) array
        Projection centres.
    focal_scales : (c,) array
        Factors on the focal lengths of the graph's cameras.
    converged : bool
    covariances : tuple of two (k, 3, 3) arrays, optional
        Of the centres and of the rotations.
    radial_terms : (c,) array, optional
        Radial terms of the graph's cameras.
    """

    rotations: Array
    centers: Array
    focal_scales: Array
    converged: bool = True
    covariances: tuple[Array, Array] | None = None
    radial_terms: Array | None = None


def world_directions(graph: ViewGraph, part: Subgraph, rotations: Array) -> Array:
    """Directions in the world frame, ``gamma_ij = R_i gamma^l_ij`` with R_i camera to world: (e, 3)."""
    local = graph.cam2_in_cam1_directions[part.edge_rows]
    return np.asarray(np.einsum("kba,kb->ka", rotations[part.edges[:, 0]], local))
