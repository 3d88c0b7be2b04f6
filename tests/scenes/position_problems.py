"""Small translation-averaging problems whose truth is known."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.simulation.ring_scenes import ring_scene


@dataclass(frozen=True, eq=False)
class PositionProblem:
    """Directions in the world frame, and the positions that they were taken from."""

    num_images: int
    edges: NDArray[np.int64]
    directions: NDArray[np.float64]
    centers: NDArray[np.float64]
    outlier: NDArray[np.bool_]

    @property
    def measured(self):
        return self.num_images, self.edges, self.directions


def ring_problem(num_images, num_neighbors=6, *, direction_sigma=0.0, outlier_share=0.0, seed=0):
    scene = ring_scene(
        num_images, num_neighbors, direction_sigma=direction_sigma, outlier_share=outlier_share, seed=seed
    )
    edges = scene.graph.edges
    camera_to_world = np.swapaxes(scene.cam_from_world_rotations[edges[:, 0]], 1, 2)
    directions = np.einsum("kab,kb->ka", camera_to_world, scene.graph.cam2_in_cam1_directions)
    return PositionProblem(num_images, edges, directions, scene.projection_centers, scene.outlier)
