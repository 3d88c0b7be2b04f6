"""Votes between clusters: exact where edges are, a twin in plain Python, majorities over strong false edges."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_vg.errors import GraphError
from colmap_vg.geometry import quaternions, so3
from colmap_vg.rotations.votes import AGREEMENT_DEG, NUM_HYPOTHESES, _Clusters, rotations_by_votes
from colmap_vg.scene.edge_residuals import rotation_residuals
from colmap_vg.simulation.ring_scenes import ring_scene


def _twin(num_images, edges, relative, weights):
    """The same merging by dictionaries, every vote of every round taken anew."""
    R, cluster = np.tile(np.eye(3), (num_images, 1, 1)), np.arange(num_images)
    gate = np.radians(AGREEMENT_DEG)
    while len(np.unique(cluster)) > 1:
        votes = {}
        for (i, j), relation, weight in zip(edges, relative, weights, strict=True):
            turn = R[j].T @ relation @ R[i]
            a, b = cluster[i], cluster[j]
            if a != b:
                votes.setdefault((min(a, b), max(a, b)), []).append((weight, turn if a < b else turn.T))
        best = None
        for (a, b), ballots in votes.items():
            angle = [[so3.angle((one.T @ other)[None])[0] for _, other in ballots] for _, one in ballots]
            support = [sum(w for (w, _), x in zip(ballots, row, strict=True) if x < gate) for row in angle]
            winner = int(np.argmax(support))
            rivals = [s for s, x in zip(support, angle[winner], strict=True) if x >= gate]
            lead = support[winner] - max(rivals, default=0.0)
            if best is None or lead > best[0]:
                agreeing = [(w, t) for (w, t), x in zip(ballots, angle[winner], strict=True) if x < gate]
                mean = so3.project(sum(w * t for w, t in agreeing)[None])[0]
                best = (lead, a, b, mean)
        _, a, b, turn = best
        R[cluster == b] = R[cluster == b] @ turn
        cluster[cluster == b] = a
    return R


def _tangle(num_images, num_edges, seed):
    """Rotations, edges of which a third are false, weights."""
    rng = np.random.default_rng(seed)
    R = so3.random(num_images, rng)
    ring = np.stack([np.arange(num_images), (np.arange(num_images) + 1) % num_images], axis=1)
    edges = np.unique(np.sort(np.concatenate([ring, rng.integers(num_images, size=(num_edges, 2))]), axis=1), axis=0)
    edges = edges[edges[:, 0] != edges[:, 1]]
    relative = R[edges[:, 1]] @ np.swapaxes(R[edges[:, 0]], 1, 2)
    relative = so3.exp(0.01 * rng.standard_normal((len(edges), 3))) @ relative
    false = rng.random(len(edges)) < 0.33
    relative[false] = so3.random(int(false.sum()), rng)
    return R, edges, relative, rng.uniform(0.5, 2.0, len(edges)), false


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_twin_in_plain_python(seed):
    _, edges, relative, weights, _ = _tangle(9, 16, seed)
    found, twin = rotations_by_votes(9, edges, relative, weights), _twin(9, edges, relative, weights)
    # The common gauge is the first images'; the mean of the turns differs in the second order of their noise.
    found, twin = found @ found[0].T, twin @ twin[0].T
    difference = np.swapaxes(found, 1, 2)[0] @ found, np.swapaxes(twin, 1, 2)[0] @ twin
    assert np.degrees(so3.angle(np.swapaxes(difference[0], 1, 2) @ difference[1])).max() < 0.2


def test_exact_edges_give_exact_rotations():
    scene = ring_scene(40, seed=3)
    graph = scene.graph
    R = rotations_by_votes(graph.num_images, graph.edges, graph.cam2_from_cam1_rotations)
    assert rotation_residuals(graph.edges, graph.cam2_from_cam1_rotations, R).max() < 1e-7


def test_a_strong_false_edge_is_outvoted_between_clusters():
    # Two groups whose images are linked well; between them three true edges and a false one of twice their weight each.
    rng = np.random.default_rng(2)
    R = so3.random(12, rng)
    inside = [(i, j) for g in (0, 6) for i in range(g, g + 6) for j in range(i + 1, g + 6)]
    edges = np.array([*inside, (0, 6), (1, 7), (2, 8), (3, 9)])
    relative = R[edges[:, 1]] @ np.swapaxes(R[edges[:, 0]], 1, 2)
    relative[-1] = so3.random(1, rng)[0]
    weights = np.array([5.0] * len(inside) + [1.0, 1.0, 1.0, 2.0])
    found = rotations_by_votes(12, edges, relative, weights)
    residuals = rotation_residuals(edges, relative, found)
    assert residuals[:-1].max() < 1e-7
    assert residuals[-1] > 0.5


def test_order_of_edges_does_not_matter():
    _, edges, relative, weights, _ = _tangle(20, 80, 5)
    order = np.random.default_rng(0).permutation(len(edges))
    one = rotations_by_votes(20, edges, relative, weights)
    other = rotations_by_votes(20, edges[order], relative[order], weights[order])
    assert np.abs(np.swapaxes(one, 1, 2)[0] @ one - np.swapaxes(other, 1, 2)[0] @ other).max() < 1e-9


def test_one_image_and_parts_apart():
    empty = (np.zeros((0, 2), dtype=int), np.zeros((0, 3, 3)))
    assert np.array_equal(rotations_by_votes(1, *empty), np.eye(3)[None])
    with pytest.raises(GraphError, match="disconnected"):
        rotations_by_votes(2, *empty)


def test_the_heaviest_edges_are_the_hypotheses() -> None:
    rng = np.random.default_rng(0)
    num_light, truth = 3 * NUM_HYPOTHESES, so3.exp(np.array([[0.0, 0.5, 0.0]]))
    relative = np.concatenate([so3.exp(rng.standard_normal((num_light, 3))), np.repeat(truth, 5, axis=0)])
    weights = np.concatenate([np.full(num_light, 0.1), np.full(5, 1.0)])
    R = rotations_by_votes(2, np.repeat([[0, 1]], num_light + 5, axis=0), relative, weights)
    assert np.degrees(so3.angle((R[1] @ R[0].T @ truth[0].T)[None])[0]) < 5.0


def test_bounds_of_stale_votes_are_the_weights_of_their_edges() -> None:
    rng = np.random.default_rng(1)
    i, j = np.triu_indices(20, 1)
    chosen = rng.random(len(i)) < 0.5
    edges, weights = np.stack([i, j], axis=1)[chosen], -np.sort(-rng.uniform(0.1, 2.0, int(chosen.sum())))
    clusters = _Clusters(20, edges, quaternions.from_matrices(so3.exp(rng.standard_normal((len(edges), 3)))), weights)
    for _ in range(12):
        clusters.merge_best()
        for vote in np.flatnonzero(np.isfinite(clusters._lead)).tolist():
            rows = np.concatenate(clusters._voters[vote])
            assert clusters._total[vote] == pytest.approx(weights[rows].sum())
            assert clusters._lead[vote] <= clusters._total[vote] * (1.0 + 1e-9)
