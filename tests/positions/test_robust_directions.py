"""Robust direction fit: exact recovery, stationarity by differences, collapse, and deviations against Monte Carlo."""

import numpy as np
import pytest

from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.geometry.similarity import align_positions
from colmap_vg.positions.robust_directions import position_deviations, solve_robust_directions
from colmap_vg.simulation.ring_scenes import nearest_neighbor_edges


def scene(seed, num_images=30, neighbors=8):
    rng = np.random.default_rng(seed)
    p = rng.uniform(-1, 1, (num_images, 3)) * [4.0, 2.0, 1.0]
    edges = nearest_neighbor_edges(p, neighbors)
    return p, edges, normalized(p[edges[:, 1]] - p[edges[:, 0]]), rng


def noisy(d, sigma, rng):
    """Directions turned about random axes at right angles, `sigma` (a number or one each) in each tangent axis."""
    w = rng.standard_normal(d.shape) * np.reshape(sigma, (-1, 1))
    w -= d * np.einsum("ka,ka->k", w, d)[:, None]
    return np.einsum("kab,kb->ka", so3.exp(np.cross(d, w)), d)


def test_exact_directions_give_exact_positions():
    p, edges, d, rng = scene(1)
    start = p + 0.1 * rng.standard_normal(p.shape)
    found = solve_robust_directions(len(p), edges, d, start, tolerance=1e-12).positions
    assert align_positions(found.projection_centers, p)[0].max() < 1e-8


def test_no_position_can_move_for_the_better():
    p, edges, d, rng = scene(2, neighbors=14)
    d = noisy(d, 0.02, rng)
    d[:10] = normalized(rng.standard_normal((10, 3)))
    found = solve_robust_directions(len(p), edges, d, p, tolerance=1e-14)
    x = found.positions.projection_centers

    def slope(x):
        b = x[edges[:, 1]] - x[edges[:, 0]]
        l = np.linalg.norm(b, axis=1)  # noqa: E741
        pull = (found.weights / l)[:, None] * (d - b / l[:, None] * np.einsum("ka,ka->k", d, b / l[:, None])[:, None])
        total = np.zeros_like(x)
        np.add.at(total, edges[:, 1], pull)
        np.add.at(total, edges[:, 0], -pull)
        return total, np.abs(pull).sum()

    total, size = slope(x)
    assert np.abs(total).max() < 1e-5 * size
    assert found.positions.lambdas.min() > 0.02 * np.median(found.positions.lambdas)
    assert found.weights[:10].max() < 0.2 * np.median(found.weights)


def test_outliers_and_unequal_noise_cost_little():
    p, edges, d, rng = scene(3, num_images=60, neighbors=14)
    length = np.linalg.norm(p[edges[:, 1]] - p[edges[:, 0]], axis=1)
    sigma = 0.01 * np.median(length) / length
    measured = noisy(d, sigma, rng)
    false = rng.permutation(len(d))[: len(d) // 10]
    measured[false] = normalized(rng.standard_normal((len(false), 3)))
    found = solve_robust_directions(len(p), edges, measured, p)
    assert align_positions(found.positions.projection_centers, p)[0].max() < 0.05
    true = np.setdiff1d(np.arange(len(d)), false)
    ratio = found.sigmas[true] / sigma[true]
    assert 0.8 < np.median(ratio) < 1.25
    assert np.corrcoef(np.log(found.sigmas[true]), np.log(sigma[true]))[0, 1] > 0.8


def test_contradictions_draw_no_cameras_into_one_point():
    p, edges, d, rng = scene(4)
    d = noisy(d, 0.05, rng)
    pair = np.flatnonzero((edges == [edges[0]]).all(axis=1))
    d[pair] *= -1.0
    found = solve_robust_directions(len(p), edges, d, p, max_num_iterations=300).positions
    assert found.lambdas.min() > 0.05 * np.median(found.lambdas)


def test_deviations_are_those_of_many_draws():
    p, edges, d, rng = scene(5, num_images=40, neighbors=8)
    sigma, size = 0.01, np.linalg.norm(p - p.mean(axis=0))
    solved = [solve_robust_directions(len(p), edges, noisy(d, sigma, rng), p) for _ in range(80)]
    aligned = []
    for one in solved:
        x = one.positions.projection_centers
        _, similarity = align_positions(x, p)
        aligned.append(similarity.scale * x + similarity.translation - p)
    spread = np.sqrt(np.mean(np.sum(np.square(aligned), axis=2), axis=0))
    predicted = position_deviations(len(p), edges, solved[0], seed=1, num_samples=300)
    assert np.linalg.norm(solved[0].positions.projection_centers) == pytest.approx(size)
    assert 0.75 < np.median(predicted / spread) < 1.35
    assert np.corrcoef(np.log(predicted), np.log(spread))[0, 1] > 0.8


def test_a_camera_that_nothing_fixes_is_the_uncertain_one():
    p, edges, d, rng = scene(6)
    # One more camera far away sees two neighbouring ones only, under nearly the same direction.
    far = np.array([[60.0, 0.0, 0.0]])
    i = int(np.argmin(np.linalg.norm(p, axis=1)))
    j = int(np.argsort(np.linalg.norm(p - p[i], axis=1))[1])
    p = np.concatenate([p, far])
    edges = np.concatenate([edges, [[i, len(p) - 1], [j, len(p) - 1]]])
    d = noisy(normalized(p[edges[:, 1]] - p[edges[:, 0]]), 0.01, rng)
    solved = solve_robust_directions(len(p), edges, d, p)
    deviations = position_deviations(len(p), edges, solved)
    assert deviations.argmax() == len(p) - 1
    assert deviations[-1] > 20 * np.median(deviations)
    assert deviations[:-1].max() < 0.1 * deviations[-1]


def test_positions_of_a_graph_in_pieces_are_refused():
    with pytest.raises(GraphError, match="connected"):
        solve_robust_directions(4, np.array([[0, 1], [2, 3]]), np.eye(3)[:2], np.eye(4)[:, :3])
