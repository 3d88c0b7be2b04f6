"""Residuals of edges in standard deviations."""

import numpy as np

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import tangent_basis
from colmap_vg.scene.edge_residuals import edge_residual_sigmas
from colmap_vg.simulation.ring_scenes import ring_scene


def test_differences_count_in_their_own_deviations():
    scene, rng = ring_scene(12, 6, seed=1), np.random.default_rng(2)
    g, m = scene.graph, scene.graph.num_edges
    A = 0.0005 * (np.eye(5) + 0.3 * rng.standard_normal((m, 5, 5)))
    covariance = A @ np.swapaxes(A, 1, 2)
    step = np.einsum("kab,kb->ka", A, rng.standard_normal((m, 5)))
    R = so3.exp(-step[:, :3]) @ g.cam2_from_cam1_rotations
    B, d = tangent_basis(g.cam2_in_cam1_directions), g.cam2_in_cam1_directions
    tilt = np.einsum("kab,kb->ka", B, step[:, 3:])
    measured = np.einsum("kab,kb->ka", so3.exp(np.cross(d, -tilt)), d)
    arguments = (np.linalg.inv(covariance), scene.cam_from_world_rotations, scene.projection_centers)
    found = edge_residual_sigmas(g.edges, R, measured, *arguments)
    expected = np.sqrt(np.einsum("ka,kab,kb->k", step, np.linalg.inv(covariance), step) / 5)
    # The tangent basis of the measured direction is turned against that of the true one by as little as it moved.
    np.testing.assert_allclose(found, expected, rtol=0.03)
    assert 0.8 < np.sqrt(np.mean(found**2)) < 1.2
    exact = edge_residual_sigmas(g.edges, g.cam2_from_cam1_rotations, d, *arguments)
    assert exact.max() < 1e-6
