"""Cross against a dense twin with numpy's eigenvectors."""

import numpy as np
import pytest
from position_problems import ring_problem

from colmap_vg.geometry import so3
from colmap_vg.positions.cross import solve_cross


def _rows(problem):
    """The linear system ``gamma x (p_j - p_i)``: (m, 3, 3 n)."""
    n, m = problem.num_images, len(problem.edges)
    A = np.zeros((m, 3, 3 * n))
    for k, (i, j) in enumerate(problem.edges):
        A[k, :, 3 * j : 3 * j + 3] = so3.hat(problem.directions[k])
        A[k, :, 3 * i : 3 * i + 3] = -so3.hat(problem.directions[k])
    return A


def _twin(problem, weights, num_iterations):
    """Right singular vector of the smallest singular value orthogonal to the translations, after each reweighting."""
    n, (i, j) = problem.num_images, problem.edges.T
    centered = np.linalg.svd(np.kron(np.ones((1, n)), np.eye(3)))[2][3:].T
    A, lengths, steps = _rows(problem), np.ones(len(i)), []
    for _ in range(num_iterations + 1):
        scaled = (np.sqrt(weights) / lengths)[:, None, None] * A
        p = (centered @ np.linalg.svd(scaled.reshape(-1, 3 * n) @ centered)[2][-1]).reshape(n, 3)
        ahead = np.sum(weights * np.sign(np.sum(problem.directions * (p[j] - p[i]), axis=1)))
        steps.append(p * np.sign(ahead))
        lengths = np.linalg.norm(p[j] - p[i], axis=1)
    return steps


def _cost(problem, weights, p):
    i, j = problem.edges.T
    d = p[j] - p[i]
    cosine = np.sum(d * problem.directions, axis=1) / np.linalg.norm(d, axis=1)
    return np.sum(weights * (1.0 - cosine**2))


def test_same_as_the_dense_twin():
    problem = ring_problem(20, 6, direction_sigma=0.08, seed=3)
    weights = np.random.default_rng(0).uniform(0.3, 2.0, len(problem.edges))
    result = solve_cross(*problem.measured, weights, tolerance=1e-10)
    steps = _twin(problem, weights, 100)
    assert result.converged
    assert np.abs(result.projection_centers - steps[-1]).max() < 1e-7
    costs = [_cost(problem, weights, p) for p in steps[1 : 1 + len(result.log)]]
    assert [entry.cost for entry in result.log] == pytest.approx(costs, rel=1e-7)


@pytest.mark.parametrize("count", [1, 3, 6])
def test_least_cost_on_the_way_where_it_does_not_converge(count):
    problem = ring_problem(20, 6, direction_sigma=0.08, seed=3)
    ones = np.ones(len(problem.edges))
    result = solve_cross(*problem.measured, max_num_iterations=count, tolerance=1e-10)
    steps = _twin(problem, ones, count)
    best = min(steps, key=lambda p: _cost(problem, ones, p))
    assert not result.converged
    assert result.num_iterations == count
    assert np.abs(result.projection_centers - best).max() < 1e-7
    assert result.cost == pytest.approx(_cost(problem, ones, best), rel=1e-7)


def test_cost_is_the_sum_of_squared_sines():
    problem = ring_problem(15, 5, direction_sigma=0.1)
    result = solve_cross(*problem.measured)
    ones = np.ones(len(problem.edges))
    assert result.cost == pytest.approx(_cost(problem, ones, result.projection_centers), rel=1e-9)
    assert np.linalg.norm(result.projection_centers) == pytest.approx(1.0, rel=1e-12)


def test_sparse_factors_find_the_same_vector():
    # More than 600 unknowns: SuperLU instead of LAPACK. Noise-free, the truth is the null vector.
    problem = ring_problem(260, 8)
    result = solve_cross(*problem.measured)
    truth = problem.centers - problem.centers.mean(axis=0)
    assert np.abs(result.projection_centers - truth / np.linalg.norm(truth)).max() < 1e-9


def test_reweighting_that_gains_nothing_ends():
    problem = ring_problem(60, 8, direction_sigma=0.1, outlier_share=0.5, seed=1)
    result = solve_cross(*problem.measured)
    assert not result.converged
    assert result.num_iterations < 100
    costs, changes = np.array([[entry.cost, entry.change] for entry in result.log]).T
    assert costs[-10:].min() >= costs[:-10].min()
    assert changes[-10:].min() >= changes[:-10].min()
    assert result.cost <= costs.min()
