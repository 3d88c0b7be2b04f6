"""Lengths of baselines from shared tracks: exact on exact data, on lines too, robust, and what becomes of gaps."""

import numpy as np
import pytest
from image_sets import image_set

from colmap_vg.epipolar import baseline_lengths
from colmap_vg.epipolar.baseline_lengths import (
    BaselineRatios,
    connects_all,
    estimate_baseline_ratios,
    positions_by_lengths,
    solve_lengths,
)
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.geometry.similarity import align_positions


def relative_poses(edges, R, p):
    i, j = edges.T
    return R[j] @ np.swapaxes(R[i], 1, 2), normalized(np.einsum("kab,kb->ka", R[i], p[j] - p[i]))


def true_lengths(edges, p):
    return np.linalg.norm(p[edges[:, 1]] - p[edges[:, 0]], axis=1)


@pytest.mark.parametrize("layout", ["ring", "street", "grid"])
def test_exact_tracks_give_exact_lengths_and_positions(layout):
    problem, R, p = image_set(3, layout, 16, 1500, 0.0)
    relative, directions = relative_poses(problem.edges, R, p)
    lengths = solve_lengths(len(problem.edges), estimate_baseline_ratios(problem, relative, directions))
    factors = lengths / true_lengths(problem.edges, p)
    assert np.isfinite(factors).all()
    np.testing.assert_allclose(factors, factors[0], rtol=1e-7)
    world = np.einsum("kba,kb->ka", R[problem.edges[:, 0]], directions)
    found = positions_by_lengths(16, problem.edges, world, lengths)
    assert align_positions(found, p)[0].max() < 1e-7


def test_noise_of_a_pixel_moves_lengths_along_a_street_by_little():
    problem, R, p = image_set(4, "street", 40, 6000, 1.0)
    relative, directions = relative_poses(problem.edges, R, p)
    lengths = solve_lengths(len(problem.edges), estimate_baseline_ratios(problem, relative, directions))
    errors = np.log(lengths / true_lengths(problem.edges, p))
    assert np.abs(errors - np.median(errors)).max() < 0.05


def test_false_directions_and_rotations_do_not_move_positions():
    problem, R, p = image_set(5, "grid", 25, 2500, 0.0)
    relative, directions = relative_poses(problem.edges, R, p)
    rng = np.random.default_rng(0)
    false = rng.random(len(problem.edges)) < 0.1
    assert false.sum() > 5
    relative[false] = so3.exp(rng.standard_normal((false.sum(), 3))) @ relative[false]
    directions[false] = normalized(rng.standard_normal((false.sum(), 3)))
    lengths = solve_lengths(len(problem.edges), estimate_baseline_ratios(problem, relative, directions))
    world = np.einsum("kba,kb->ka", R[problem.edges[:, 0]], directions)
    found = positions_by_lengths(25, problem.edges, world, lengths)
    radius = np.linalg.norm(p, axis=1).max()
    # The Cauchy loss of the lengths does not forget false ratios altogether.
    assert align_positions(found, p)[0].max() < 1e-2 * radius


def test_false_ratios_do_not_move_lengths():
    rng = np.random.default_rng(1)
    true = rng.normal(size=60)
    links = np.array([(a, b) for a in range(60) for b in range(a + 1, 60) if rng.random() < 0.2])
    ratios = true[links[:, 0]] - true[links[:, 1]]
    false = rng.random(len(links)) < 0.2
    ratios[false] += rng.normal(0, 2, false.sum())
    lengths = solve_lengths(60, BaselineRatios(links, ratios, np.full(len(links), 1e-3)))
    errors = np.log(lengths) - true
    assert np.abs(errors - np.median(errors)).max() < 0.02


def test_only_the_largest_group_of_edges_gets_lengths():
    links = BaselineRatios(np.array([[0, 1], [3, 4], [4, 5]]), np.log([2.0, 3.0, 0.5]), np.full(3, 0.01))
    lengths = solve_lengths(7, links)
    assert np.isnan(lengths[[0, 1, 2, 6]]).all()
    np.testing.assert_allclose(lengths[3] / lengths[4], 3.0)
    np.testing.assert_allclose(lengths[4] / lengths[5], 0.5)


def test_edges_of_unknown_length_take_theirs_from_the_start():
    rng = np.random.default_rng(2)
    p = rng.standard_normal((12, 3))
    edges = np.array([(a, b) for a in range(12) for b in range(a + 1, 12)])
    world = normalized(p[edges[:, 1]] - p[edges[:, 0]])
    lengths = np.where((edges < 8).all(axis=1), true_lengths(edges, p), np.nan)
    assert not connects_all(12, edges, np.isfinite(lengths))
    assert connects_all(12, edges, edges[:, 0] == 0)
    start = 0.1 * (p + 0.02 * rng.standard_normal((12, 3)))
    found = positions_by_lengths(12, edges, world, lengths, start)
    start_error, error = (align_positions(q, p)[0].mean() for q in (start, found))
    assert error < 0.3 * start_error


def test_links_need_tracks_in_front(monkeypatch):
    problem, R, p = image_set(6, "ring", 8, 300, 0.0)
    relative, directions = relative_poses(problem.edges, R, p)
    whole = estimate_baseline_ratios(problem, relative, directions)
    assert len(whole.edges) > 0
    behind = estimate_baseline_ratios(problem, relative, -directions)
    assert len(behind.edges) == 0
    monkeypatch.setattr(baseline_lengths, "MIN_TRACKS", 10**6)
    assert len(estimate_baseline_ratios(problem, relative, directions).edges) == 0


def test_ratios_that_noise_swamps_are_not_firm() -> None:
    links = BaselineRatios(np.array([[0, 1], [1, 2], [2, 3]]), np.zeros(3), np.array([0.001, 0.09, 0.2]))
    assert links.reliable.tolist() == [True, True, False]
