"""Times of single steps: ``pytest tests/benchmarks --benchmark-only -n 0``; plain pytest skips them.

Problems are of fixed size and seed, so that two runs on one machine compare. Ratios between releases are what counts.
"""

import numpy as np
import pytest
from epipolar_scenes import pixel_scene

from colmap_vg import read_view_graph, solve_view_graph
from colmap_vg.calibration.self_calibration import estimate_focal_lengths
from colmap_vg.epipolar.adjustment import adjust_epipolar, cost_and_gradient
from colmap_vg.epipolar.cameras import Cameras, gauged
from colmap_vg.epipolar.problem import EpipolarProblem, Lenses
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.pose_graph.alternation import solve_joint
from colmap_vg.positions.cls import solve_cls
from colmap_vg.rotations.robust import average_rotations_robust
from colmap_vg.simulation.database import write_synthetic_database
from colmap_vg.simulation.ring_scenes import ring_scene
from colmap_vg.simulation.views import synthetic_views
from colmap_vg.two_view.edge_information import refine_relative_poses

NUM_CAMERAS, NUM_MATCHES = 1000, 300_000


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    path = tmp_path_factory.mktemp("street") / "database.db"
    write_synthetic_database(path, synthetic_views("street", 100))
    return path


@pytest.fixture(scope="module")
def ring():
    return ring_scene(NUM_CAMERAS, 12, rotation_sigma=0.01, direction_sigma=0.02, outlier_share=0.05)


@pytest.fixture(scope="module")
def matched_ring():
    """300 edges of 1,000 matches each, and cameras near the truth."""
    scene, rng = ring_scene(50, 8), np.random.default_rng(0)
    R, p, edges = scene.cam_from_world_rotations, gauged(scene.projection_centers), scene.graph.edges
    edges = edges[np.arange(300) % len(edges)]
    per_edge = NUM_MATCHES // len(edges)
    edge = np.repeat(np.arange(len(edges)), per_edge)
    points, rays = rng.uniform(-0.2, 0.2, (NUM_MATCHES, 3)), []
    for side in edges[edge].T:
        local = np.einsum("kab,kb->ka", R[side], points - p[side])
        local[:, :2] += 5e-4 * local[:, 2:] * rng.standard_normal((NUM_MATCHES, 2))
        rays.append(normalized(local))
    problem = EpipolarProblem(
        50,
        edges,
        per_edge * np.arange(len(edges) + 1),
        *rays,
        np.zeros(50, dtype=int),
        np.array([1000.0]),
        np.zeros(1, dtype=bool),
    )
    return problem, Cameras(so3.exp(1e-3 * rng.standard_normal((50, 3))) @ R, p, Lenses(np.zeros(1)))


def test_reading_a_database(benchmark, street):
    graph = benchmark(read_view_graph, street)
    assert graph.num_images == 100


def test_solving_a_database(benchmark, street):
    graph = read_view_graph(street)
    solution = benchmark(solve_view_graph, graph)
    assert solution.registered.all()


def test_votes_of_focal_lengths(benchmark):
    scene = pixel_scene(0, [900.0, 1100.0], num_images=40, num_matches=200)
    found = benchmark(
        estimate_focal_lengths,
        scene.edges,
        scene.camera_idx,
        scene.offsets,
        scene.points1,
        scene.points2,
        np.full(2, 1200.0),
        scene.principal_points,
        scene.image_sizes,
    )
    np.testing.assert_allclose(found.focal_lengths, scene.focal_lengths, rtol=0.05)


def test_robust_rotation_averaging(benchmark, ring):
    graph = ring.graph
    found = benchmark(average_rotations_robust, NUM_CAMERAS, graph.edges, graph.cam2_from_cam1_rotations)
    true = ring.cam_from_world_rotations
    turned = found.cam_from_world_rotations @ (found.cam_from_world_rotations[0].T @ true[0])
    assert np.median(so3.angle(turned @ np.swapaxes(true, 1, 2))) < 0.02


def _world_directions(ring):
    back = np.swapaxes(ring.cam_from_world_rotations[ring.graph.edges[:, 0]], 1, 2)
    return np.einsum("kab,kb->ka", back, ring.graph.cam2_in_cam1_directions)


def test_cls(benchmark, ring):
    assert benchmark(solve_cls, NUM_CAMERAS, ring.graph.edges, _world_directions(ring)).converged


def test_2c(benchmark, ring):
    graph = ring.graph
    start = solve_cls(NUM_CAMERAS, graph.edges, _world_directions(ring)).projection_centers
    found = benchmark(
        solve_joint,
        NUM_CAMERAS,
        graph.edges,
        graph.cam2_from_cam1_rotations,
        graph.cam2_in_cam1_directions,
        ring.cam_from_world_rotations,
        start,
        "C",
    )
    assert np.isfinite(found.projection_centers).all()


def test_derivatives_of_300_000_matches(benchmark, matched_ring):
    """All of an epipolar iteration but its sparse solve, which fifty cameras hardly notice."""
    problem, cameras = matched_ring
    cost, gradient = benchmark(cost_and_gradient, problem, cameras, 2.0)
    assert cost > 0
    assert gradient.shape == (300,)


def test_epipolar_adjustment_of_300_000_matches(benchmark, matched_ring):
    problem, cameras = matched_ring
    directions = cameras.relative(problem.edges)[1]
    found = benchmark(adjust_epipolar, problem, cameras.rotations, cameras.centers, directions)
    assert found.converged


def test_edge_information_of_300_000_matches(benchmark, matched_ring):
    problem, cameras = matched_ring
    R, d, _ = cameras.relative(problem.edges)
    focal = np.full(len(R), 1000.0)
    refined = benchmark(
        refine_relative_poses, problem.offsets, problem.bearings1, problem.bearings2, R, d, focal, focal
    )
    assert np.isfinite(refined.information).all()
