"""Poses of a part of a graph on their way through the solver."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.scene.subgraph import Subgraph
from colmap_vg.scene.view_graph import ViewGraph

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PartPoses:
    """Poses of a part: cam_from_world (k, 3, 3), centres (k, 3), focal factors of the graph's cameras (c,)."""

    rotations: Array
    centers: Array
    focal_scales: Array
    converged: bool = True
    covariances: tuple[Array, Array] | None = None
    radial_terms: Array | None = None


def world_directions(graph: ViewGraph, part: Subgraph, rotations: Array) -> Array:
    """``gamma_ij = R_i gamma^l_ij`` with R_i camera to world, (e, 3)."""
    local = graph.cam2_in_cam1_directions[part.edge_rows]
    return np.asarray(np.einsum("kba,kb->ka", rotations[part.edges[:, 0]], local))
