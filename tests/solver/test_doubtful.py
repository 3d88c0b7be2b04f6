"""Graphs of objects that repeat themselves: right, or said to be in doubt; never folded and called solved."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_vg import SolutionStatus, solve_view_graph
from colmap_vg.geometry import so3
from colmap_vg.simulation.objects import ObjectNoise, object_scene, symmetric_object_scene
from colmap_vg.simulation.ring_scenes import ring_scene


def _num_folded(solution, scene):
    """Images of the largest model that stand turned by more than 15 degrees against most of it."""
    rows = np.flatnonzero(solution.registered)
    turns = np.swapaxes(scene.cam_from_world_rotations[rows], 1, 2) @ solution.cam_from_world_rotations[rows]
    angles = np.degrees(so3.angle(np.swapaxes(turns[:, None], 2, 3) @ turns[None]))
    return int((angles[np.argmin(np.median(angles, axis=1))] > 15.0).sum())


@pytest.mark.parametrize("coherent_share", [0.2, 0.5, 0.9])
@pytest.mark.parametrize("seed", [0, 1])
def test_objects_are_right_or_doubtful(coherent_share, seed):
    scene = object_scene(50, 1000, ObjectNoise(hardness=0.9, coherent_share=coherent_share), seed)
    solution = solve_view_graph(scene.graph)
    assert _num_folded(solution, scene) == 0 or solution.status == SolutionStatus.DOUBTFUL


@pytest.mark.parametrize("num_sides", [2, 4])
@pytest.mark.parametrize("unique_share", [0.0, 0.3])
def test_an_object_with_equal_sides_is_doubtful(num_sides, unique_share):
    scene = symmetric_object_scene(24, num_sides, unique_share, seed=1)
    assert scene.outlier.mean() > 0.4
    solution = solve_view_graph(scene.graph)
    assert _num_folded(solution, scene) > 0
    assert solution.status == SolutionStatus.DOUBTFUL
    assert "another arrangement" in solution.message
    assert solution.in_doubt.any()
    (told,) = [caveat for caveat in solution.caveats if "Another arrangement" in caveat]
    named = str(scene.graph.image_ids[np.flatnonzero(solution.in_doubt)[0]])
    assert f"({named}, " in told


def test_a_model_that_most_matches_contradict_is_doubtful():
    scene = ring_scene(40, 16, seed=2)
    rng = np.random.default_rng(0)
    graph, relative = scene.graph, scene.graph.cam2_from_cam1_rotations.copy()
    false = rng.permutation(graph.num_edges)[: round(0.45 * graph.num_edges)]
    relative[false] = so3.random(len(false), rng)
    solution = solve_view_graph(replace(graph, cam2_from_cam1_rotations=relative))
    assert solution.agreement[0].inliers < 0.65
    assert solution.status == SolutionStatus.DOUBTFUL
    assert "too many pairs contradict it" in solution.message


def test_clean_graphs_are_not_doubted():
    solution = solve_view_graph(ring_scene(30, 6, rotation_sigma=0.005, direction_sigma=0.01, seed=3).graph)
    assert solution.status == SolutionStatus.SOLVED
    assert solution.in_doubt is None
    assert solution.agreement[0].inliers > 0.99
