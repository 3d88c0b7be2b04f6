"""A viewing graph refuses what is no viewing graph, and says which row."""

from dataclasses import replace

import numpy as np
import pytest

from colmap_vg.errors import GraphError
from colmap_vg.scene.verdicts import EdgeVerdict
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.simulation.ring_scenes import ring_scene


@pytest.fixture
def graph() -> ViewGraph:
    return ring_scene(6, 2).graph


def test_conventions_of_the_table(graph):
    scene = ring_scene(6, 2)
    R, p = scene.cam_from_world_rotations, scene.projection_centers
    i, j = graph.edges[0]
    # cam2_from_cam1 = (R_21, t_21) maps camera 1's points into camera 2; the direction is -R_21^T t_21, normalised.
    R21 = R[j] @ R[i].T
    t21 = R[j] @ (p[i] - p[j])
    np.testing.assert_allclose(graph.cam2_from_cam1_rotations[0], R21, atol=1e-12)
    np.testing.assert_allclose(graph.cam2_in_cam1_directions[0], -R21.T @ t21 / np.linalg.norm(t21), atol=1e-12)


def test_empty_graphs_are_graphs():
    graph = ViewGraph(np.arange(3), np.zeros((0, 2), int), [], [])
    assert (graph.num_images, graph.num_edges, graph.has_inliers) == (3, 0, False)


def test_read_verdicts_say_what_may_be_used(graph):
    words = np.array([EdgeVerdict.ROTATION_ONLY, EdgeVerdict.WATERMARK] + [EdgeVerdict.KEPT] * (graph.num_edges - 2))
    graph = replace(graph, read_verdicts=words)
    assert graph.has_rotation[:3].tolist() == [True, False, True]
    assert graph.has_direction[:3].tolist() == [False, False, True]


def _rays(count):
    rays = np.tile([0.0, 0.0, 1.0], (count, 1))
    return {"inlier_bearings1": rays, "inlier_bearings2": rays}


def _bad(array, row, value):
    array = array.copy()
    array[row] = value
    return array


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda g: {"image_ids": np.zeros(6, int)}, "not unique"),
        (lambda g: {"edges": _bad(g.edges, 0, (0, 6))}, "outside the 6 images"),
        (lambda g: {"edges": _bad(g.edges, 2, (4, 4))}, "edge 2 links image row 4 to itself"),
        (lambda g: {"edges": g.edges.astype(float)}, "integers"),
        (lambda g: {"cam2_from_cam1_rotations": _bad(g.cam2_from_cam1_rotations, 1, 2 * np.eye(3))}, "row 1"),
        (lambda g: {"cam2_from_cam1_rotations": _bad(g.cam2_from_cam1_rotations, 1, -np.eye(3))}, "row 1"),
        (lambda g: {"cam2_from_cam1_rotations": g.cam2_from_cam1_rotations[1:]}, "shape"),
        (lambda g: {"cam2_in_cam1_directions": _bad(g.cam2_in_cam1_directions, 3, np.nan)}, "row 3"),
        (lambda g: {"cam2_in_cam1_directions": 2 * g.cam2_in_cam1_directions}, "unit"),
        (lambda g: {"num_inliers": np.ones(2, int)}, "num_inliers has shape"),
        (lambda g: {"image_names": ("a",)}, "1 names for 6 images"),
        (lambda g: {"inlier_offsets": np.arange(g.num_edges + 1), **_rays(2)}, "increase from 0"),
        (lambda g: {"inlier_offsets": np.zeros(g.num_edges + 1), "inlier_bearings1": np.ones((0, 3))}, "integers"),
        (lambda g: {"inlier_bearings1": np.zeros((0, 3))}, "go together"),
        (lambda g: {"inlier_offsets": np.full(g.num_edges + 1, 0), **_rays(0), "edges": None}, "edges is missing"),
        (lambda g: {"cam2_in_cam1_directions": None}, "cam2_in_cam1_directions is missing"),
        (lambda g: {"cam2_in_cam1_directions": g.cam2_in_cam1_directions.astype(str)}, "real numbers"),
        (lambda g: {"cam2_in_cam1_directions": g.cam2_in_cam1_directions.astype(complex)}, "real numbers"),
        (lambda g: {"image_ids": "text"}, "must be an array"),
        (lambda g: {"image_ids": [[1], [2, 3]]}, "is not an array"),
        (lambda g: {"num_inliers": np.full(g.num_edges, -1)}, "negative"),
        (lambda g: {"camera_idx": np.full(6, 2**62)}, "without a camera"),
        (lambda g: {"camera_idx": np.full(6, 1), "camera_ids": [1], "camera_focal_lengths": [9.0]}, "without a camera"),
        (lambda g: {"camera_ids": [1], "camera_focal_lengths": [0.0]}, "focal length"),
        (lambda g: {"edge_information": np.full((g.num_edges, 5, 5), np.nan)}, "information"),
        (lambda g: {"edge_information": np.tile(-np.eye(5), (g.num_edges, 1, 1))}, "information"),
    ],
)
def test_malformed_graphs_are_refused(graph, change, complaint):
    with pytest.raises(GraphError, match=complaint):
        replace(graph, **change(graph))
