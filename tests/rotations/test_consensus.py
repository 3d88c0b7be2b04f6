"""Consensus rotations: right where most matches are, a rival named where they are not clear, precise at the end."""

import numpy as np
import pytest
from scipy.optimize import isotonic_regression

from colmap_vg.geometry import so3
from colmap_vg.rotations.consensus import _never_falling, _Search, average_rotations_by_consensus, learned_log_odds
from colmap_vg.rotations.robust import average_rotations_robust
from colmap_vg.simulation.objects import ObjectNoise, object_scene, symmetric_object_scene
from colmap_vg.simulation.ring_scenes import ring_scene

CLEAR_LEAD = 1.0 / 3.0


def _solve(scene, seed=0):
    graph = scene.graph
    precision = 1.0 / np.trace(np.linalg.inv(graph.edge_information)[:, :3, :3], axis1=1, axis2=2)
    relative = graph.cam2_from_cam1_rotations
    return average_rotations_by_consensus(graph.num_images, graph.edges, relative, graph.num_inliers, precision, seed)


def _errors_deg(R, truth):
    turns = np.swapaxes(truth, 1, 2) @ R
    angles = np.degrees(so3.angle(np.swapaxes(turns[:, None], 2, 3) @ turns[None]))
    return angles[np.argmin(np.median(angles, axis=1))]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("coherent_share", [0.2, 0.5])
def test_objects_with_half_of_their_pairs_false(seed, coherent_share):
    noise = ObjectNoise(hardness=0.5 + 0.1 * seed, coherent_share=coherent_share, focal_error=0.02 * (seed % 2))
    scene = object_scene(60 + 10 * seed, 1500 + 200 * seed, noise, seed)
    assert 0.3 < scene.outlier.mean() < 0.6
    found = _solve(scene)
    right = _errors_deg(found.cam_from_world_rotations, scene.cam_from_world_rotations).max() <= 3.0
    assert right or found.lead < CLEAR_LEAD


def test_averaging_alone_is_folded_there():
    # What the search is for: without it, this scene ends wrong by up to half a turn.
    scene = object_scene(100, 2200, ObjectNoise(hardness=1.0, coherent_share=0.2), 4)
    graph = scene.graph
    weights = np.sqrt(graph.num_inliers)
    alone = average_rotations_robust(graph.num_images, graph.edges, graph.cam2_from_cam1_rotations, weights)
    assert (_errors_deg(alone.cam_from_world_rotations, scene.cam_from_world_rotations) > 15.0).mean() > 0.3
    assert _errors_deg(_solve(scene).cam_from_world_rotations, scene.cam_from_world_rotations).max() < 3.0


def test_an_object_that_repeats_itself_has_a_rival():
    # Coherent false pairs outweigh true ones: no graph tells, and the lead says so.
    found = [_solve(object_scene(80, 1100, ObjectNoise(hardness=1.0, coherent_share=0.9), seed)) for seed in range(4)]
    assert sum(f.lead < CLEAR_LEAD for f in found) >= 2
    assert all(f.rival_images.any() for f in found if f.lead < 1.0)


def test_clean_graphs_are_as_averaging_leaves_them():
    scene = ring_scene(40, rotation_sigma=0.01, seed=2)
    graph, ones = scene.graph, np.ones(scene.graph.num_edges)
    found = average_rotations_by_consensus(40, graph.edges, graph.cam2_from_cam1_rotations, ones, ones)
    alone = average_rotations_robust(40, graph.edges, graph.cam2_from_cam1_rotations)
    assert _errors_deg(found.cam_from_world_rotations, alone.cam_from_world_rotations).max() < 0.05
    assert found.lead == 1.0
    assert not found.rival_images.any()


def test_same_seed_same_bits():
    scene = object_scene(60, 1500, ObjectNoise(hardness=1.0), 1)
    one, other = _solve(scene, 3), _solve(scene, 3)
    assert one.cam_from_world_rotations.tobytes() == other.cam_from_world_rotations.tobytes()


@pytest.mark.parametrize("num_images", [16, 24, 40])
@pytest.mark.parametrize("num_sides", [2, 3, 4])
def test_folds_of_objects_with_equal_sides_never_lead_clearly(num_images, num_sides):
    for seed in range(2):
        found = _solve(symmetric_object_scene(num_images, num_sides, 0.3, seed=seed))
        assert found.lead < CLEAR_LEAD


def test_heaviest_edges_decide_where_likelihoods_tell_much():
    # By all edges the object's other side, which makes more pairs but weaker ones, wins.
    noise = ObjectNoise(hardness=0.5, coherent_share=0.9)
    scene = object_scene(149, 2524, noise, 510)
    found = _solve(scene)
    assert _errors_deg(found.cam_from_world_rotations, scene.cam_from_world_rotations).max() < 3.0


def test_odds_are_learned_by_likelihood_and_never_fall():
    rng = np.random.default_rng(0)
    likelihoods = rng.uniform(0.0, 1.0, 2000)
    odds = learned_log_odds(likelihoods, rng.random(2000) < 0.2 + 0.75 * likelihoods)
    order = np.argsort(likelihoods)
    assert (np.diff(odds[order]) >= 0).all()
    assert odds[order[0]] == 0.0
    assert abs(odds[order[-1]] - np.log(0.91 / 0.09)) < 0.6
    assert np.ptp(learned_log_odds(np.ones(50), rng.random(50) < 0.8)) == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_values_that_never_fall_are_the_closest(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values, weights = rng.integers(0, 6, 10) / 6.0 + 0.05 * np.arange(10), rng.uniform(0.1, 3.0, 10)
    np.testing.assert_allclose(_never_falling(values, weights), isotonic_regression(values, weights=weights).x)


def test_edges_agree_within_the_threshold() -> None:
    rng = np.random.default_rng(0)
    R = so3.exp(rng.standard_normal((30, 3)))
    edges = np.array([(i, j) for i in range(30) for j in range(i)])
    axes = rng.standard_normal((len(edges), 3))
    angles = np.radians(rng.uniform(0.0, 10.0, len(edges)))
    turns = so3.exp(angles[:, None] * axes / np.linalg.norm(axes, axis=1, keepdims=True))
    search = _Search(30, edges, turns @ R[edges[:, 1]] @ np.swapaxes(R[edges[:, 0]], 1, 2), np.ones(len(edges)))
    search.add(R)
    np.testing.assert_array_equal(search._agree[0], angles <= np.radians(5.0))
