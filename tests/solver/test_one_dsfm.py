"""1DSfM against a plain twin, known orders, and outliers that it must find."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_vg.errors import GraphError
from colmap_vg.geometry.directions import normalized
from colmap_vg.solver.one_dsfm import one_dsfm_broken_weights, order_positions, projection_directions


def _plain_order(num_images, edges, projections):
    """Greedy order along one line, written from the paper: everything is summed anew at each step."""
    arcs = [(i, j, p) if p > 0 else (j, i, -p) for (i, j), p in zip(edges, projections, strict=True) if p != 0]
    left = set(range(num_images))
    order = []
    while left:
        best, best_score = None, -1.0
        for node in sorted(left):
            coming = [w for i, j, w in arcs if j == node and i in left]
            going = [w for i, j, w in arcs if i == node and j in left]
            score = np.inf if not coming else (sum(going) + 1.0) / (sum(coming) + 1.0)
            if score > best_score:
                best, best_score = node, score
        order.append(best)
        left.remove(best)
    position = np.empty(num_images, dtype=int)
    position[order] = np.arange(num_images)
    return position


def _random_graph(num_images, num_edges, rng):
    first = rng.integers(0, num_images, num_edges)
    second = (first + rng.integers(1, num_images, num_edges)) % num_images  # parallel and reversed edges occur
    return np.stack([first, second], axis=1), normalized(rng.standard_normal((num_edges, 3)))


@settings(max_examples=60, deadline=None)
@given(st.integers(2, 12), st.integers(0, 40), st.integers(0, 10_000))
def test_orders_are_the_plain_twins(num_images, num_edges, seed):
    rng = np.random.default_rng(seed)
    edges, directions = _random_graph(num_images, num_edges, rng)
    lines, weights = normalized(rng.standard_normal((5, 3))), rng.uniform(0.1, 3.0, num_edges)
    found = order_positions(num_images, edges, directions, lines, weights)
    for k, line in enumerate(lines):
        assert np.array_equal(found[k], _plain_order(num_images, edges, weights * (directions @ line)))


@settings(max_examples=20, deadline=None)
@given(st.integers(3, 10), st.integers(0, 10_000))
def test_broken_weights_by_definition(num_images, seed):
    rng = np.random.default_rng(seed)
    edges, directions = _random_graph(num_images, 30, rng)
    found = one_dsfm_broken_weights(num_images, edges, directions, 7, seed=seed)
    lines = projection_directions(directions, 7, np.random.default_rng(seed))
    expected = np.zeros(30)
    for line in lines:
        position = _plain_order(num_images, edges, directions @ line)
        for k, (i, j) in enumerate(edges):
            p = directions[k] @ line
            if (position[j] - position[i]) * p < 0:
                expected[k] += abs(p) / 7
    assert np.allclose(found, expected, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.integers(3, 30), st.integers(0, 10_000))
def test_consistent_directions_break_nothing(num_images, seed):
    rng = np.random.default_rng(seed)
    p = rng.standard_normal((num_images, 3))
    edges, _ = _random_graph(num_images, 4 * num_images, rng)
    directions = normalized(p[edges[:, 1]] - p[edges[:, 0]])
    assert np.array_equal(one_dsfm_broken_weights(num_images, edges, directions), np.zeros(len(edges)))


def test_outliers_are_found_and_good_edges_kept():
    rng = np.random.default_rng(0)
    p = rng.standard_normal((80, 3))
    edges = np.stack(np.triu_indices(80, 1), axis=1)
    edges = edges[rng.random(len(edges)) < 0.4]
    directions = normalized(p[edges[:, 1]] - p[edges[:, 0]] + 0.02 * rng.standard_normal((len(edges), 3)))
    reversed_ = rng.random(len(edges)) < 0.1
    directions[reversed_] *= -1.0
    broken = one_dsfm_broken_weights(80, edges, directions)
    assert (broken[reversed_] > 0.1).mean() > 0.97
    assert (broken[~reversed_] > 0.1).mean() < 0.05


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_an_edge_and_its_reverse_are_the_same(seed):
    rng = np.random.default_rng(seed)
    edges, directions = _random_graph(10, 30, rng)
    flip = rng.random(30) < 0.5
    lines = normalized(rng.standard_normal((4, 3)))
    flipped = np.where(flip[:, None], edges[:, ::-1], edges), np.where(flip[:, None], -directions, directions)
    assert np.array_equal(order_positions(10, edges, directions, lines), order_positions(10, *flipped, lines))


def test_lines_follow_the_density_of_the_edges():
    """Edges in one plane: lines are drawn in that plane, where an order can be read off."""
    rng = np.random.default_rng(0)
    flat = normalized(rng.standard_normal((2000, 3)) * np.array([1.0, 1.0, 0.0]))
    lines = projection_directions(flat, 500, rng)
    assert np.abs(lines[:, 2]).max() < 1e-12
    assert np.allclose(np.linalg.norm(lines, axis=1), 1.0)
    assert np.linalg.eigvalsh(np.cov(lines.T))[1] > 0.2  # both directions of the plane are there
    # Weight moves the density.
    heavy = np.where(np.abs(flat[:, 0]) > 0.9, 1.0, 0.0)
    assert np.mean(projection_directions(flat, 500, rng, heavy)[:, 0] ** 2) > 0.7


def test_the_density_is_not_much_wider_than_the_edges():
    """Directions within 0.1 of one axis: the kernel adds (1 + m^(-2/7))^(1/2) = 1.06 to the spread, not more."""
    rng = np.random.default_rng(0)
    directions = normalized(np.array([0.0, 0.0, 1.0]) + 0.1 * rng.standard_normal((2000, 3)) * [1.0, 1.0, 0.0])
    lines = projection_directions(directions, 4000, rng)
    slope = np.abs(lines[:, :2] / lines[:, 2:])
    assert 0.9 < np.median(slope) / (0.0675 * 1.06) < 1.1  # the median of |N(0, 0.1)| is 0.0675


def test_seed_decides():
    edges, directions = _random_graph(20, 100, np.random.default_rng(0))
    a, b, c = (one_dsfm_broken_weights(20, edges, directions, seed=s) for s in (1, 1, 2))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)


def test_malformed_input_is_refused():
    edges, directions = _random_graph(5, 10, np.random.default_rng(0))
    assert one_dsfm_broken_weights(5, np.zeros((0, 2), dtype=int), np.zeros((0, 3))).shape == (0,)
    with pytest.raises(GraphError, match="9 directions"):
        one_dsfm_broken_weights(5, edges, directions[:9])
    with pytest.raises(GraphError, match="of 3 images"):
        one_dsfm_broken_weights(3, edges, directions)
    with pytest.raises(GraphError, match="NaN"):
        one_dsfm_broken_weights(5, edges, directions * np.nan)
    with pytest.raises(GraphError, match="at least one"):
        one_dsfm_broken_weights(5, edges, directions, 0)
    with pytest.raises(GraphError, match="not negative"):
        one_dsfm_broken_weights(5, edges, directions, weights=-np.ones(10))
