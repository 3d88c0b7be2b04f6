"""Missing pairs: images that look the same way should match, and tell a fold from the truth."""

import numpy as np
import pytest

from colmap_vg.geometry import so3
from colmap_vg.rotations import consensus
from colmap_vg.rotations.consensus import average_rotations_by_consensus
from colmap_vg.rotations.near_views import NUM_NEAR_VIEWS, matching_share
from colmap_vg.simulation.objects import ObjectNoise, object_scene


def _brute_force(edges, agree, R):
    linked = {frozenset(edge) for edge in edges[agree].tolist()}
    found = []
    for i, view in enumerate(R[:, 2]):
        angles = np.arccos(np.clip(R[:, 2] @ view, -1.0, 1.0))
        angles[i] = np.inf
        found += [frozenset((i, int(j))) in linked for j in np.argsort(angles)[:NUM_NEAR_VIEWS]]
    return np.mean(found)


@pytest.mark.parametrize("seed", range(4))
def test_the_share_is_that_of_all_angles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R = so3.exp(rng.standard_normal((30, 3)))
    i, j = np.triu_indices(30, 1)
    edges = np.stack([i, j], axis=1)[rng.random(len(i)) < 0.4]
    edges = np.where(rng.random((len(edges), 1)) < 0.5, edges, edges[:, ::-1])
    agree = rng.random(len(edges)) < 0.7
    assert matching_share(edges, agree, R) == pytest.approx(_brute_force(edges, agree, R))


def test_images_that_look_the_same_way_are_near_each_other() -> None:
    # Ten images in one direction: the image itself may be missing among its nearest, and never counts.
    R = np.repeat(np.eye(3)[None], 10, axis=0)
    i, j = np.triu_indices(10, 1)
    edges = np.stack([i, j], axis=1)
    assert matching_share(edges, np.ones(len(edges), dtype=bool), R) == 1.0
    assert matching_share(edges, np.zeros(len(edges), dtype=bool), R) == 0.0


def test_few_images() -> None:
    assert matching_share(np.array([[0, 1]]), np.array([True]), np.repeat(np.eye(3)[None], 2, axis=0)) == 1.0
    assert matching_share(np.zeros((0, 2), dtype=int), np.zeros(0, dtype=bool), np.eye(3)[None]) == 0.0


@pytest.mark.parametrize(
    ("num_images", "num_edges", "hardness", "coherent_share", "focal_error", "seed"),
    [(144, 1774, 1.0, 0.5, 0.0, 49), (108, 2336, 1.0, 0.9, 0.0, 81), (125, 1734, 0.5, 0.9, 0.0, 277)],
)
def test_missing_pairs_tell_where_a_fold_has_more_consensus(
    num_images: int, num_edges: int, hardness: float, coherent_share: float, focal_error: float, seed: int
) -> None:
    scene = object_scene(num_images, num_edges, ObjectNoise(0.3, 1.5, hardness, coherent_share, focal_error), seed)
    graph, ones = scene.graph, np.ones(num_edges)
    relative, inliers = graph.cam2_from_cam1_rotations, graph.num_inliers.astype(float)
    found = average_rotations_by_consensus(num_images, graph.edges, relative, inliers, ones)
    turns = np.swapaxes(scene.cam_from_world_rotations, 1, 2) @ found.cam_from_world_rotations
    errors = np.degrees(so3.angle(np.swapaxes(turns[:, None], 2, 3) @ turns[None])).max(axis=1).min()
    assert errors <= 3.0
    assert found.lead < 1.0 / 3.0


@pytest.mark.parametrize(
    ("shares", "consensuses", "chosen"),
    [
        ((0.6, 0.95), (1.0, 0.9), 1),
        ((0.6, 0.95), (1.0, 0.7), 0),  # too little consensus
        ((0.9, 0.95), (1.0, 0.9), 0),  # hardly more
        ((0.5, 0.8), (1.0, 0.9), 0),  # not enough of them match
        ((0.6, 0.9, 0.95), (1.0, 0.95, 0.9), 2),
        ((0.6, 0.9, 0.95), (1.0, 0.95, 0.7), 1),
    ],
)
def test_near_views_overrule_consensus_only_where_they_are_clear(
    shares: tuple[float, ...], consensuses: tuple[float, ...], chosen: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = object_scene(50, 1000, seed=0).graph
    inliers = graph.num_inliers.astype(float)
    search = consensus._Search(50, graph.edges, graph.cam2_from_cam1_rotations, inliers)
    for _ in shares:
        search.add(np.repeat(np.eye(3)[None], 50, axis=0))
    given = iter(shares)
    monkeypatch.setattr(consensus, "matching_share", lambda *_: next(given))
    assert search._with_its_near_views(0, np.array(consensuses)) == chosen
