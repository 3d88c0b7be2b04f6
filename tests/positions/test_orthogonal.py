"""The appendix's coordinate descent against a dense twin, and its limit against the direct minimisation."""

import numpy as np
import pytest
from position_problems import ring_problem

from colmap_vg import align_positions
from colmap_vg.positions.cls import solve_cls
from colmap_vg.positions.direct import minimize_directions
from colmap_vg.positions.orthogonal import solve_orthogonal


def _dense_iteration(problem, p, weights):
    """lambda at fixed positions, then positions at fixed lambda, each by numpy's least squares."""
    n, (i, j) = problem.num_images, problem.edges.T
    d = p[j] - p[i]
    scales = np.array([np.linalg.lstsq(d[k][:, None], problem.directions[k], rcond=None)[0][0] for k in range(len(d))])
    B = np.zeros((len(i), n))
    B[np.arange(len(i)), i], B[np.arange(len(i)), j] = -1.0, 1.0
    root = np.sqrt(weights)[:, None]
    new = np.linalg.lstsq(root * scales[:, None] * B, root * problem.directions, rcond=None)[0]
    new = new - new.mean(axis=0)
    return new * (np.linalg.norm(p) / np.linalg.norm(new))


def test_iterations_are_the_paper_s():
    problem = ring_problem(25, 6, direction_sigma=0.1)
    weights = np.random.default_rng(0).uniform(0.3, 2.0, len(problem.edges))
    expected = solve_cls(*problem.measured, weights).projection_centers
    for count in range(1, 5):
        expected = _dense_iteration(problem, expected, weights)
        result = solve_orthogonal(*problem.measured, weights, accelerate=False, max_num_iterations=count, tolerance=0.0)
        assert np.abs(result.projection_centers - expected).max() < 1e-8 * np.abs(expected).max()


@pytest.mark.parametrize("outlier_share", [0.0, 0.2])
def test_cost_never_rises(outlier_share):
    problem = ring_problem(40, 6, direction_sigma=0.2, outlier_share=outlier_share, seed=4)
    for accelerate in (False, True):
        result = solve_orthogonal(*problem.measured, accelerate=accelerate, max_num_iterations=100)
        costs = np.array([entry.cost for entry in result.log])
        assert (np.diff(costs) <= 1e-10 * costs[:-1]).all()


def test_plain_and_accelerated_forms_reach_the_same_minimum():
    problem = ring_problem(40, 6, direction_sigma=0.08, seed=1)
    fast = solve_orthogonal(*problem.measured, tolerance=1e-12)
    plain = solve_orthogonal(*problem.measured, accelerate=False, tolerance=1e-12, max_num_iterations=20_000)
    assert fast.converged
    assert plain.converged
    size = np.linalg.norm(plain.projection_centers)
    assert np.linalg.norm(fast.projection_centers - plain.projection_centers) < 1e-8 * size
    assert fast.num_iterations < plain.num_iterations / 3


@pytest.mark.parametrize("seed", range(3))
def test_the_limit_is_the_minimum_of_cle1_with_the_orthogonal_metric(seed):
    problem = ring_problem(30, 6, direction_sigma=0.1, seed=seed)
    start = solve_cls(*problem.measured).projection_centers
    direct = minimize_directions(*problem.measured, start, metric="orthogonal")
    result = solve_orthogonal(*problem.measured, tolerance=1e-11)
    assert result.cost == pytest.approx(direct.cost, rel=1e-9)
    errors, _ = align_positions(result.projection_centers, direct.projection_centers)
    assert errors.max() < 1e-6 * np.abs(direct.projection_centers).max()


def test_scales_are_negative_where_an_edge_points_backwards():
    problem = ring_problem(30, 8)
    problem.directions[0] *= -1.0
    scales = solve_orthogonal(*problem.measured, initial_centers=problem.centers).lambdas
    assert scales[0] < 0
    assert (scales[1:] > 0).all()
