"""Triangles by brute force; shares of triangles that close by hand."""

import itertools

import numpy as np
import pytest

from colmap_vg.geometry import so3
from colmap_vg.rotations.cycles import closing_shares, find_triangles


@pytest.mark.parametrize("seed", range(5))
def test_triangles_by_brute_force(seed):
    rng = np.random.default_rng(seed)
    pairs = np.array([(i, j) if rng.random() < 0.5 else (j, i) for i, j in itertools.combinations(range(9), 2)])
    edges = pairs[rng.permutation(len(pairs))[:18]]
    row = {frozenset(edge): k for k, edge in enumerate(edges.tolist())}
    expected = {
        (row[frozenset((u, v))], row[frozenset((v, w))], row[frozenset((u, w))])
        for u, v, w in itertools.combinations(range(9), 3)
        if all(frozenset(p) in row for p in ((u, v), (v, w), (u, w)))
    }
    found = find_triangles(9, edges)
    assert {tuple(t) for t in found.tolist()} == expected
    assert len(found) == len(expected)


def test_no_edges_no_triangles():
    assert find_triangles(3, np.zeros((0, 2), dtype=np.int64)).shape == (0, 3)


def test_closing_shares_by_hand():
    # Two triangles on the edge 0-1: one closes, one does not; each counts by the weaker of its other two edges.
    R = so3.random(4, np.random.default_rng(0))
    edges = np.array([[1, 0], [1, 2], [0, 2], [0, 3], [3, 1], [2, 3]])[:5]
    relative = R[edges[:, 1]] @ np.swapaxes(R[edges[:, 0]], 1, 2)
    relative[4] = so3.exp(np.array([[0.5, 0.0, 0.0]]))[0] @ relative[4]
    shares = closing_shares(4, edges, relative, np.array([1.0, 3.0, 5.0, 1.0, 9.0]))
    assert np.allclose(shares, [3.0 / 4.0, 1.0, 1.0, 0.0, 0.0])
