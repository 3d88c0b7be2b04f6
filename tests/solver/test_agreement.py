"""Shares of pairs and matches that agree with cameras, counted by hand."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_vg.geometry import so3
from colmap_vg.scene.verdicts import EdgeVerdict
from colmap_vg.simulation.ring_scenes import ring_scene
from colmap_vg.solver.agreement import MAX_ROTATION_DEG, pair_agreement


def _ring():
    scene = ring_scene(12, 4, seed=1)
    graph = replace(scene.graph, num_inliers=100 + np.arange(scene.graph.num_edges))
    return graph, scene.cam_from_world_rotations, scene.projection_centers


def test_exact_graphs_agree_in_full():
    graph, R, p = _ring()
    (found,) = pair_agreement(graph, R, p, np.zeros(12, dtype=int))
    assert (found.inliers, found.pairs, found.directions, found.num_pairs) == (1.0, 1.0, 1.0, graph.num_edges)


@pytest.mark.parametrize(("turn_deg", "agrees"), [(MAX_ROTATION_DEG - 0.1, True), (MAX_ROTATION_DEG + 0.1, False)])
def test_a_turned_pair_counts_by_its_matches(turn_deg, agrees):
    graph, R, p = _ring()
    relative = graph.cam2_from_cam1_rotations.copy()
    relative[3] = so3.exp(np.radians([[0.0, turn_deg, 0.0]]))[0] @ relative[3]
    (found,) = pair_agreement(replace(graph, cam2_from_cam1_rotations=relative), R, p, np.zeros(12, dtype=int))
    lost = 0.0 if agrees else 1.0
    assert found.pairs == pytest.approx(1.0 - lost / graph.num_edges)
    assert found.inliers == pytest.approx(1.0 - lost * 103 / graph.num_inliers.sum())
    assert found.directions == 1.0


def test_directions_are_judged_by_their_own_deviation():
    graph, R, p = _ring()
    directions = graph.cam2_in_cam1_directions.copy()
    i = graph.edges[3, 0]
    axis = R[i] @ np.array([0.0, 0.0, 1.0])
    directions[3] = so3.exp(np.radians(10.0) * axis[None])[0] @ directions[3]
    turned = np.degrees(np.arccos(directions[3] @ graph.cam2_in_cam1_directions[3]))
    assert turned > 5.0
    for sigma_deg, share in ((0.1, 1.0 - 103 / graph.num_inliers.sum()), (5.0, 1.0)):
        precision = np.tile(np.eye(5) / np.radians(sigma_deg) ** 2, (graph.num_edges, 1, 1))
        told = replace(graph, cam2_in_cam1_directions=directions, edge_information=precision)
        (found,) = pair_agreement(told, R, p, np.zeros(12, dtype=int))
        assert found.directions == pytest.approx(share)
        assert found.inliers == 1.0


def test_components_and_unknown_pairs_count_for_themselves():
    graph, R, p = _ring()
    verdicts = np.full(graph.num_edges, str(EdgeVerdict.KEPT), dtype="U20")
    verdicts[0] = EdgeVerdict.NO_POSE
    component = np.arange(12) // 6
    found = pair_agreement(replace(graph, read_verdicts=verdicts), R, p, component)
    inside = (component[graph.edges[:, 0]] == component[graph.edges[:, 1]]) & (verdicts == EdgeVerdict.KEPT)
    assert [part.num_pairs for part in found] == [
        int((inside & (component[graph.edges[:, 0]] == k)).sum()) for k in (0, 1)
    ]
    assert pair_agreement(graph, R, p, np.full(12, -1)) == ()
