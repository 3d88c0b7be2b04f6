"""Noise of edges without truth, against simulated edges whose noise is known."""

from dataclasses import replace

import numpy as np
import pytest
from paper.noise_ratios import NOISE_RATIOS, contest_winners, ratio_table, real_edges_text, ring_edges
from paper.real_edges import EdgeNoise, edge_noise, edge_residuals, noise_per_axis

from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.scene.verdicts import EdgeVerdict
from colmap_vg.simulation.topology import TopologyNoise, scene_on_topology
from colmap_vg.solver.solve import solve_view_graph


def _ring(rotation_deg, direction_deg, outlier_share=0.0):
    noise = TopologyNoise(rotation_deg, direction_deg, 0.0, match_spread=0.0, outlier_share=outlier_share)
    return scene_on_topology(40, ring_edges(40, 12), layout="ring", noise=noise, seed=1)


@pytest.mark.parametrize("num_axes", [2, 3])
def test_noise_is_that_of_each_axis_whatever_a_few_outliers_are(num_axes):
    rng = np.random.default_rng(0)
    angles = np.linalg.norm(0.02 * rng.standard_normal((20_000, num_axes)), axis=1)
    assert noise_per_axis(angles, num_axes) == pytest.approx(0.02, rel=0.02)
    angles[:400] = 3.0
    assert noise_per_axis(angles, num_axes) == pytest.approx(0.02, rel=0.04)


@pytest.mark.parametrize(("rotation_deg", "direction_deg"), [(1.0, 0.5), (1.0, 2.0), (0.5, 2.0)])
@pytest.mark.parametrize("outlier_share", [0.0, 0.2])
def test_noise_of_simulated_edges_is_found_a_little_below_theirs(rotation_deg, direction_deg, outlier_share):
    scene = _ring(rotation_deg, direction_deg, outlier_share)
    noise = edge_noise("ring", scene.graph)
    assert noise.num_edges == 480
    assert noise.num_kept <= 480 * (1.0 - 0.9 * outlier_share)
    assert 0.8 * rotation_deg < noise.rotation_deg < rotation_deg
    assert 0.8 * direction_deg < noise.direction_deg < direction_deg
    assert noise.ratio == pytest.approx(direction_deg / rotation_deg, rel=0.15)


def test_residuals_are_of_kept_edges_only_and_in_radians():
    scene = _ring(0.0, 0.0)
    graph = scene.graph
    solution = solve_view_graph(graph)
    assert solution.edge_kept.all()
    turned = so3.exp(np.array([[0.0, 0.1, 0.0]])) @ graph.cam2_from_cam1_rotations
    kept = np.arange(graph.num_edges) < 5
    measured = replace(graph, cam2_from_cam1_rotations=turned)
    rotation, direction = edge_residuals(measured, replace(solution, edge_kept=kept))
    np.testing.assert_allclose(rotation, np.full(5, 0.1), atol=1e-5)
    np.testing.assert_allclose(direction, np.zeros(5), atol=1e-5)


def test_graphs_without_a_solution_have_no_noise():
    graph = _ring(1.0, 1.0).graph
    unread = np.full(graph.num_edges, EdgeVerdict.FEW_INLIERS)
    with pytest.raises(GraphError, match="kept no edge"):
        edge_noise("ring", replace(graph, read_verdicts=unread))


def test_the_contest_is_among_the_papers_methods_and_lud():
    k = len(NOISE_RATIOS)
    errors = {"cross": np.full(k, 0.01), "1C": np.full(k, 0.3), "2O": np.linspace(0.1, 0.6, k), "lud": np.full(k, 0.4)}
    wanted = ["2O", "2O", *["1C"] * (k - 2)]
    errors["2O"][2] = 0.35
    assert contest_winners(errors) == wanted
    text = ratio_table(errors)
    assert "| cross | **1** |" in text
    assert "Least error among 1C, 2O, lud: 2O at 0.25, 2O at 0.5, 1C at 1, 1C at 2, 1C at 4, 1C at 8." in text
    assert contest_winners({"cross": errors["cross"]}) == []


def test_real_edges_are_compared_at_the_nearest_ratio():
    k = len(NOISE_RATIOS)
    errors = {"1C": np.arange(k, 0.0, -1.0), "2O": np.full(k, 3.5)}
    noises = [EdgeNoise("madrid_m", 100, 60, 1.0, 1.45), EdgeNoise("alamo", 10, 6, 2.0, 1.0)]
    text = real_edges_text(errors, noises)
    assert "| madrid m | 100 | 60 | 1° | 1.45° | 1.45 |" in text
    assert "At 2, the ratio above that is nearest to madrid m's, the least error among 1C, 2O is that of 1C." in text
    assert "At 0.5, the ratio above that is nearest to alamo's, the least error among 1C, 2O is that of 2O." in text
