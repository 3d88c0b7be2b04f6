"""Noise of the edges of real photo collections, of which no truth is known: from the residuals of a solution.

The angle between a measured and the true rotation, over the noise in each axis, is the length of a normal vector with
three independent axes, that of a direction has two. Its median is that of a chi distribution, so that

    sigma = median(angle) / sqrt(chi2.ppf(0.5, k)),  k = 3 or 2,

whatever the angles of up to half of the edges are. Instead of the true poses stand the solved ones, which fit the edges
better than the truth does: residuals underestimate the noise a little, by the share of unknowns in the measurements.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import angle_between
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.solver.solve import solve_view_graph
from paper.markdown import markdown_table

Array = NDArray[np.float64]

ROTATION_AXES, DIRECTION_AXES = 3, 2


@dataclass(frozen=True)
class EdgeNoise:
    """Noise of the kept edges of a graph.

    Attributes
    ----------
    name : str
    num_edges, num_kept : int
        Of the graph, and of those that the noise is from.
    rotation_deg, direction_deg : float
        Standard deviation in each axis, degrees.
    """

    name: str
    num_edges: int
    num_kept: int
    rotation_deg: float
    direction_deg: float

    @property
    def ratio(self) -> float:
        """Noise of directions over that of rotations."""
        return self.direction_deg / self.rotation_deg


def edge_noise(name: str, graph: ViewGraph) -> EdgeNoise:
    """Solve a graph by the default options, and estimate the noise of the edges that the solution kept.

    Raises
    ------
    GraphError
        The solution kept no edge.
    """
    rotation, direction = edge_residuals(graph, solve_view_graph(graph))
    if len(rotation) == 0:
        raise GraphError(f"{name}: the solution kept no edge, from which noise could be estimated")
    return EdgeNoise(
        name,
        graph.num_edges,
        len(rotation),
        float(np.degrees(noise_per_axis(rotation, ROTATION_AXES))),
        float(np.degrees(noise_per_axis(direction, DIRECTION_AXES))),
    )


def edge_residuals(graph: ViewGraph, solution: PoseSolution) -> tuple[Array, Array]:
    """Angles of measured to solved relative rotations and directions of the edges that a solution kept, radians.

    Returns
    -------
    rotation, direction : (k,) array
        Of kept edges between two images of one component.
    """
    component = solution.component[graph.edges]
    kept = solution.edge_kept & (component[:, 0] == component[:, 1]) & (component[:, 0] >= 0)
    i, j = graph.edges[kept].T
    R, p = solution.cam_from_world_rotations, solution.projection_centers
    turn = np.einsum("kba,kbc->kac", graph.cam2_from_cam1_rotations[kept], R[j]) @ np.swapaxes(R[i], 1, 2)
    solved = np.einsum("kab,kb->ka", R[i], p[j] - p[i])
    return so3.angle(turn), angle_between(graph.cam2_in_cam1_directions[kept], solved)


def noise_per_axis(angles: Array, num_axes: int) -> float:
    """Standard deviation in each of some independent axes, from the median of angles, in their unit."""
    return float(np.median(angles) / np.sqrt(chi2.ppf(0.5, num_axes)))


def noise_table(noises: Sequence[EdgeNoise]) -> str:
    """Markdown: a line for each graph."""
    table = [
        [
            noise.name.replace("_", " "),
            str(noise.num_edges),
            str(noise.num_kept),
            f"{noise.rotation_deg:.3g}°",
            f"{noise.direction_deg:.3g}°",
            f"{noise.ratio:.3g}",
        ]
        for noise in noises
    ]
    return markdown_table(["real edges", "m", "kept", "rotations", "directions", "ratio"], table)
