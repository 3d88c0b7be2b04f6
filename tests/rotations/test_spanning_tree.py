"""Spanning tree initialisation against a plain Kruskal and chained products."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_vg.geometry import so3
from colmap_vg.rotations.spanning_tree import rotations_from_spanning_tree
from colmap_vg.scene.edge_residuals import rotation_residuals
from colmap_vg.simulation.ring_scenes import ring_scene


def _kruskal(num_images, edges, weights):
    """Edges of the maximum-weight spanning tree, by union-find."""
    group = list(range(num_images))

    def root(k):
        while group[k] != k:
            k = group[k]
        return k

    tree = []
    for k in np.argsort(-weights, kind="stable"):
        a, b = root(edges[k, 0]), root(edges[k, 1])
        if a != b:
            group[a] = b
            tree.append(k)
    return np.array(tree, dtype=int)


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 15), st.integers(0, 10_000))
def test_agrees_exactly_with_the_edges_of_the_heaviest_tree(num_images, seed):
    rng = np.random.default_rng(seed)
    chain = np.stack([np.arange(num_images - 1), np.arange(1, num_images)], axis=1)
    extra = np.stack([rng.permutation(num_images)[:2] for _ in range(2 * num_images)])
    edges = np.concatenate([chain, extra, extra[:3, ::-1]])  # with parallel and reversed edges
    relative = so3.random(len(edges), rng)
    weights = rng.permutation(len(edges)) + 1.0
    R = rotations_from_spanning_tree(num_images, edges, relative, weights)
    tree = _kruskal(num_images, edges, weights)
    residuals = rotation_residuals(edges, relative, R)
    assert residuals[tree].max() < 1e-12
    others = np.setdiff1d(np.arange(len(edges)), tree)
    assert residuals[others].min(initial=1.0) > 1e-6


def test_noise_free_graph_is_solved_and_weight_zero_avoided():
    scene = ring_scene(30, seed=1)
    g = scene.graph
    relative = g.cam2_from_cam1_rotations.copy()
    bad = np.arange(g.num_edges) % 5 == 0
    relative[bad] = so3.random(int(bad.sum()), np.random.default_rng(0))
    R = rotations_from_spanning_tree(30, g.edges, relative, np.where(bad, 0.0, 1.0))
    assert rotation_residuals(g.edges, g.cam2_from_cam1_rotations, R).max() < 1e-12


def test_a_long_chain():
    n = 3000
    edges = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
    relative = so3.random(n - 1, np.random.default_rng(0))
    R = rotations_from_spanning_tree(n, edges, relative)
    assert rotation_residuals(edges, relative, R).max() < 1e-12
