"""What a solve records of its parts, in the unit of the component's poses."""

import numpy as np

from colmap_vg.scene.subgraph import Subgraph
from colmap_vg.simulation.ring_scenes import ring_scene
from colmap_vg.solver.state import SolverState


def test_covariances_are_scaled_with_the_positions() -> None:
    scene = ring_scene(12, 4, seed=1)
    state = SolverState(scene.graph)
    everything = np.ones(12, dtype=bool), np.ones(scene.graph.num_edges, dtype=bool)
    part = Subgraph.of(scene.graph.edges, *everything)
    centers = 3.0 * scene.projection_centers
    of_centers, of_rotations = (np.arange(1.0, 13.0)[:, None, None] * a * np.eye(3) for a in (1.0, 0.1))
    covariances = of_centers, of_rotations
    state.record_poses(part, scene.cam_from_world_rotations, centers, np.ones(0), True, covariances)
    solution = state.solution()
    pairs = np.linalg.norm(solution.projection_centers[1:] - solution.projection_centers[0], axis=1)
    factor = pairs / np.linalg.norm(centers[1:] - centers[0], axis=1)
    assert np.ptp(factor) < 1e-12
    np.testing.assert_allclose(solution.position_covariances, factor[0] ** 2 * of_centers, rtol=1e-9)
    np.testing.assert_array_equal(solution.rotation_covariances, of_rotations)
