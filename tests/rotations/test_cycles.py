"""Triangles by brute force; shares of triangles that close by hand."""

import itertools

import numpy as np
import pytest

from colmap_vg.geometry import so3
from colmap_vg.rotations.cycles import closing_shares, find_triangles, rival_share


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


def _graph_of_two_solutions(num_images, num_moved, num_false, rng):
    """All pairs of images; those from the first few to the rest agree with a second solution or with none."""
    R = so3.random(num_images, rng)
    other = R.copy()
    other[:num_moved] = R[:num_moved] @ so3.random(1, rng)[0]
    edges = np.array(list(itertools.combinations(range(num_images), 2)))
    relative = R[edges[:, 1]] @ np.swapaxes(R[edges[:, 0]], 1, 2)
    rival = (edges[:, 0] < num_moved) & (edges[:, 1] >= num_moved) & (rng.random(len(edges)) < 0.4)
    relative[rival] = (other[edges[:, 1]] @ np.swapaxes(other[edges[:, 0]], 1, 2))[rival]
    false = rng.permutation(np.flatnonzero(~rival))[:num_false]
    relative[false] = so3.random(num_false, rng)
    agree = ~rival
    agree[false] = False
    return edges, relative, agree


def test_edges_of_another_solution_close_among_themselves():
    rng = np.random.default_rng(1)
    edges, relative, agree = _graph_of_two_solutions(20, 5, 0, rng)
    assert rival_share(20, edges, relative, np.ones(len(edges)), agree) == 1.0
    edges, relative, agree = _graph_of_two_solutions(20, 5, 30, rng)
    assert 0.2 < rival_share(20, edges, relative, np.ones(len(edges)), agree) < 0.9


def test_edges_that_are_false_each_in_its_own_way_close_nothing():
    edges, relative, agree = _graph_of_two_solutions(20, 0, 60, np.random.default_rng(2))
    assert rival_share(20, edges, relative, np.ones(len(edges)), agree) < 0.005
    assert rival_share(20, edges, relative, np.ones(len(edges)), np.ones(len(edges), dtype=bool)) == 0.0


def test_edges_in_no_triangle_tell_nothing_of_another_solution():
    edges = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
    relative = so3.random(4, np.random.default_rng(3))
    assert rival_share(4, edges, relative, np.ones(4), np.array([True, True, True, False])) == 1.0
