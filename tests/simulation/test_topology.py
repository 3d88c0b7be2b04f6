"""Scenes on given adjacencies: truth and measurements agree, noise is what it says, seeds decide."""

from typing import get_args

import numpy as np
import pytest

from colmap_vg.errors import OptionError
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import angle_between, normalized
from colmap_vg.simulation.ring_scenes import nearest_neighbor_edges
from colmap_vg.simulation.topology import Layout, TopologyNoise, adjacency_order, scene_on_topology

LAYOUTS = get_args(Layout)
EXACT = TopologyNoise(rotation_deg=0.0, direction_deg=0.0)


def _band(n=80, width=5):
    """Each image linked to the next few: a street's adjacency."""
    line = np.stack([np.arange(n), np.zeros(n), np.zeros(n)], axis=1) + 1e-3 * np.arange(n)[:, None] ** 2
    return n, nearest_neighbor_edges(line, width)


def _errors_deg(scene):
    """Angles of each edge's rotation and direction to the truth."""
    R, p, (i, j) = scene.cam_from_world_rotations, scene.projection_centers, scene.graph.edges.T
    true = normalized(np.einsum("kab,kb->ka", R[i], p[j] - p[i]))
    turn = scene.graph.cam2_from_cam1_rotations @ R[i] @ np.swapaxes(R[j], 1, 2)
    return np.degrees(so3.angle(turn)), np.degrees(angle_between(scene.graph.cam2_in_cam1_directions, true))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_noise_free_edges_are_the_truth_s(layout):
    scene = scene_on_topology(*_band(), layout=layout, noise=EXACT)
    rotation, direction = _errors_deg(scene)
    assert rotation.max() < 1e-9
    assert direction.max() < 1e-9
    assert not scene.outlier.any()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_seeds_decide(layout):
    a, b, c = (scene_on_topology(*_band(), layout=layout, seed=seed) for seed in (4, 4, 5))
    assert a.projection_centers.tobytes() == b.projection_centers.tobytes()
    assert a.graph.cam2_in_cam1_directions.tobytes() == b.graph.cam2_in_cam1_directions.tobytes()
    assert not np.array_equal(a.projection_centers, c.projection_centers)


def test_images_that_see_each_other_stand_near_each_other():
    rng = np.random.default_rng(0)
    n, edges = _band()
    names = rng.permutation(n)
    along = adjacency_order(n, names[edges])
    place = along[names]  # of the band's images in their order
    assert abs(np.corrcoef(place, np.arange(n))[0, 1]) > 0.99
    scene = scene_on_topology(n, names[edges])
    p, (i, j) = scene.projection_centers, scene.graph.edges.T
    linked = np.linalg.norm(p[j] - p[i], axis=1)
    assert np.median(linked) < 0.2 * np.median(np.linalg.norm(p[:, None] - p, axis=2))


def test_collinear_runs_are_collinear():
    p = scene_on_topology(*_band(), layout="collinear").projection_centers
    order = np.argsort(adjacency_order(*_band()))
    run = p[order[:8]] - p[order[:8]].mean(axis=0)
    size = np.linalg.svd(run)[1]
    assert size[1] < 0.05 * size[0]


def test_noise_grows_as_baselines_and_matches_shrink():
    n, edges = _band(400, 8)
    scene = scene_on_topology(n, edges, noise=TopologyNoise(rotation_deg=0.5, direction_deg=1.0), seed=1)
    rotation, direction = _errors_deg(scene)
    few = scene.graph.num_inliers < np.median(scene.graph.num_inliers)
    baseline = np.linalg.norm(np.diff(scene.projection_centers[edges], axis=1)[:, 0], axis=1)
    short = baseline < np.median(baseline)
    assert np.median(rotation[few]) > 1.2 * np.median(rotation[~few])
    assert np.median(direction[short]) > 1.5 * np.median(direction[~short])
    typical = np.abs(np.log(scene.graph.num_inliers / 80)) < 0.2
    # The angle of three (two) tangent components of the stated deviation each.
    assert np.median(rotation[typical]) == pytest.approx(0.5 * 1.538, rel=0.15)
    assert (direction <= 6 * 20.0).all()


def test_outliers_are_marked_and_counted():
    noise = TopologyNoise(rotation_deg=0.0, direction_deg=0.0, outlier_share=0.2)
    scene = scene_on_topology(*_band(), noise=noise)
    rotation, direction = _errors_deg(scene)
    assert scene.outlier.sum() == round(0.2 * len(scene.graph.edges))
    assert rotation[~scene.outlier].max() < 1e-9
    assert direction[~scene.outlier].max() < 1e-9
    assert np.median(rotation[scene.outlier]) > 60


def test_false_clusters_are_wrong_in_one_and_the_same_way():
    noise = TopologyNoise(rotation_deg=0.0, direction_deg=0.0, false_cluster_share=0.02)
    scene = scene_on_topology(*_band(width=20), noise=noise)
    false = scene.outlier
    assert 0 < false.sum() <= round(0.02 * len(false))
    R, (i, j) = scene.cam_from_world_rotations, scene.graph.edges[false].T
    # R_ij = R_j S R_i^T with one S for all of them.
    S = np.swapaxes(R[j], 1, 2) @ scene.graph.cam2_from_cam1_rotations[false] @ R[i]
    assert np.abs(S - S[0]).max() < 1e-12
    assert np.degrees(so3.angle(S[0])) > 1.0
    rotation, _ = _errors_deg(scene)
    assert rotation[~false].max() < 1e-9


def test_bad_options_are_refused():
    with pytest.raises(OptionError, match="layout"):
        scene_on_topology(*_band(), layout="spiral")
    with pytest.raises(OptionError, match="between 0 and 1"):
        scene_on_topology(*_band(), noise=TopologyNoise(outlier_share=1.5))


def test_information_is_that_of_the_noise():
    n, edges = _band()
    truth = scene_on_topology(n, edges, noise=EXACT, seed=2).graph
    scene = scene_on_topology(n, edges, noise=TopologyNoise(rotation_deg=0.5, direction_deg=1.0), seed=2)
    graph = scene.graph
    turn = so3.angle(graph.cam2_from_cam1_rotations @ np.swapaxes(truth.cam2_from_cam1_rotations, 1, 2))
    apart = np.linalg.norm(np.cross(graph.cam2_in_cam1_directions, truth.cam2_in_cam1_directions), axis=1)
    # Whitened, the squares of three and of two normal deviates.
    assert np.mean(turn**2 * graph.edge_information[:, 0, 0]) == pytest.approx(3.0, rel=0.15)
    assert np.mean(apart**2 * graph.edge_information[:, 3, 3]) == pytest.approx(2.0, rel=0.15)
