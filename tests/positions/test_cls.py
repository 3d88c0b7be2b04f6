"""CLS against a bounded least-squares solver and against its optimality conditions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from position_problems import ring_problem
from scipy.optimize import lsq_linear

from colmap_vg import align_positions
from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.positions.cls import solve_cls
from colmap_vg.positions.result import centered


def _generic_solution(num_images, edges, directions, weights):
    """Positions and lambdas as one least-squares problem with bounds ``lambda >= 1`` (active set, BVLS)."""
    m, root = len(edges), np.sqrt(weights)
    A = np.zeros((m, 3, num_images * 3 + m))
    for k, (i, j) in enumerate(edges):
        A[k, :, 3 * i : 3 * i + 3] = root[k] * np.eye(3)
        A[k, :, 3 * j : 3 * j + 3] = -root[k] * np.eye(3)
        A[k, :, 3 * num_images + k] = root[k] * directions[k]
    low = np.concatenate([np.full(3 * num_images, -np.inf), np.ones(m)])
    A = A.reshape(3 * m, -1)[:, 3:]  # the first camera stays at the origin
    solution = lsq_linear(A, np.zeros(3 * m), (low[3:], np.inf), method="bvls", tol=1e-14, max_iter=2000)
    p = np.concatenate([np.zeros(3), solution.x[: 3 * num_images - 3]]).reshape(-1, 3)
    return centered(p), solution.x[3 * num_images - 3 :], 2.0 * solution.cost


@pytest.mark.parametrize("seed", range(4))
def test_minimum_of_a_generic_solver(seed):
    problem = ring_problem(10, 4, direction_sigma=0.2, seed=seed)
    weights = np.random.default_rng(seed).uniform(0.2, 3.0, len(problem.edges))
    result = solve_cls(*problem.measured, weights)
    p, lambdas, cost = _generic_solution(*problem.measured, weights)
    assert result.converged
    assert result.cost == pytest.approx(cost, rel=1e-9)
    assert np.abs(result.projection_centers - p).max() < 1e-6
    assert np.abs(result.lambdas - lambdas).max() < 1e-6


@pytest.mark.parametrize("outlier_share", [0.0, 0.3])
def test_optimality_conditions(outlier_share):
    problem = ring_problem(150, 8, direction_sigma=0.1, outlier_share=outlier_share, seed=1)
    weights = np.random.default_rng(0).uniform(0.2, 3.0, len(problem.edges))
    result = solve_cls(*problem.measured, weights)
    p, i, j = result.projection_centers, problem.edges[:, 0], problem.edges[:, 1]
    residual = weights[:, None] * (result.lambdas[:, None] * problem.directions - (p[j] - p[i]))
    stationarity = np.zeros_like(p)
    np.subtract.at(stationarity, j, residual)
    np.add.at(stationarity, i, residual)
    multiplier = np.einsum("ka,ka->k", residual, problem.directions)
    assert np.abs(stationarity).max() < 1e-10
    assert (result.lambdas >= 1.0).all()
    assert multiplier.min() > -1e-10
    assert np.abs(multiplier * (result.lambdas - 1.0)).max() < 1e-10
    share_at_one = float((result.lambdas == 1.0).mean())
    assert 0.05 < share_at_one < 0.95, "the paper's weakness of CLS: many scale factors at their bound"
    assert result.num_iterations <= 20


def test_cost_never_rises():
    problem = ring_problem(80, 8, direction_sigma=0.3, outlier_share=0.3, seed=4)
    costs = [entry.cost for entry in solve_cls(*problem.measured).log]
    assert (np.diff(costs) <= 1e-12 * costs[0]).all()


def test_noise_free_positions_are_recovered():
    problem = ring_problem(60, 6)
    result = solve_cls(*problem.measured)
    errors, _ = align_positions(result.projection_centers, problem.centers)
    assert errors.max() < 1e-8 * 4.0
    assert result.cost < 1e-16


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_world_and_order_do_not_matter(seed):
    rng = np.random.default_rng(seed)
    problem = ring_problem(20, 5, direction_sigma=0.1, seed=2)
    n, m = problem.num_images, len(problem.edges)
    turn, images, order = so3.random(1, rng)[0], rng.permutation(n), rng.permutation(m)
    flip = np.where(rng.random(m) < 0.5, -1, 1)
    edges = np.argsort(images)[problem.edges[order]]
    edges = np.where(flip[:, None] < 0, edges[:, ::-1], edges)
    directions = flip[:, None] * problem.directions[order] @ turn.T
    a = solve_cls(*problem.measured).projection_centers
    b = solve_cls(n, edges, directions).projection_centers
    assert np.abs(b[np.argsort(images)] - a @ turn.T).max() < 1e-7


def test_two_edges_of_the_same_pair_count_twice():
    problem = ring_problem(12, 4, direction_sigma=0.1)
    twice = np.concatenate([problem.edges, problem.edges[:5]])
    weights = np.ones(len(problem.edges))
    weights[:5] = 2.0
    a = solve_cls(problem.num_images, twice, np.concatenate([problem.directions, problem.directions[:5]]))
    b = solve_cls(*problem.measured, weights)
    assert np.abs(a.projection_centers - b.projection_centers).max() < 1e-8


def test_unconnected_graphs_are_refused():
    with pytest.raises(GraphError, match="connected"):
        solve_cls(4, np.array([[0, 1], [2, 3]]), np.array([[0.0, 0.0, 1.0]] * 2))
