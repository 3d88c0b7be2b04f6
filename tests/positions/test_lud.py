"""LUD: exact data exactly, its optimality conditions, and outliers that do not pull."""

import numpy as np
import pytest
from position_problems import ring_problem

from colmap_vg import SolveOptions, align_positions, solve_view_graph
from colmap_vg.positions.cls import solve_cls
from colmap_vg.positions.lud import solve_lud
from colmap_vg.simulation.ring_scenes import ring_scene


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_noise_free_positions_are_recovered(seed, weighted):
    problem = ring_problem(60, 6, seed=seed)
    weights = np.random.default_rng(0).uniform(0.1, 5.0, len(problem.edges)) if weighted else None
    result = solve_lud(*problem.measured, weights)
    assert result.converged
    size = np.sqrt(np.mean(np.sum(problem.centers**2, axis=1)))
    assert align_positions(result.projection_centers, problem.centers)[0].max() < 1e-8 * size


def test_noise_free_graphs_are_recovered_through_the_options():
    scene = ring_scene(25, 6, seed=3)
    solution = solve_view_graph(scene.graph, SolveOptions(method="lud"))
    assert align_positions(solution.projection_centers, scene.projection_centers)[0].max() < 1e-8 * 4.0


def _reweighted_cost(problem, weights):
    """Least cost of many reweighted CLS problems, whose residuals have a lower limit that goes to zero."""
    i, j = problem.edges.T
    p, reweighted, least = None, weights, np.inf
    for floor in np.repeat(np.logspace(-1, -8, 15), 30):
        found = solve_cls(*problem.measured, reweighted, initial_centers=p)
        p = found.projection_centers
        residual = np.linalg.norm(p[j] - p[i] - found.lambdas[:, None] * problem.directions, axis=1)
        least, reweighted = min(least, float(weights @ residual)), weights / np.hypot(residual, floor)
    return least


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("outlier_share", [0.0, 0.3])
def test_minimum_of_reweighted_least_squares(seed, outlier_share):
    problem = ring_problem(20, 4, direction_sigma=0.05, outlier_share=outlier_share, seed=seed)
    weights = np.random.default_rng(seed).uniform(0.5, 2.0, len(problem.edges))
    result = solve_lud(*problem.measured, weights)
    assert result.converged
    assert result.cost == pytest.approx(_reweighted_cost(problem, weights), rel=2e-6)


def test_the_bound_is_one():
    # Other positions, and few steps, cost at least what the bound of the last step says.
    problem = ring_problem(30, 5, direction_sigma=0.1, outlier_share=0.2, seed=4)
    least = solve_lud(*problem.measured).cost
    rough = solve_lud(*problem.measured, max_num_iterations=8)
    assert not rough.converged
    bounds = [entry.cost * (1.0 - entry.change) for entry in rough.log]
    assert max(bounds) > 0.5 * least
    assert max(bounds) <= least * (1.0 + 1e-9)


def test_edges_of_weight_zero_are_ignored():
    problem = ring_problem(30, 5, direction_sigma=0.1, outlier_share=0.2, seed=2)
    weights = np.ones(len(problem.edges))
    weights[::7] = 0.0
    some = solve_lud(*problem.measured, weights)
    rest = solve_lud(problem.num_images, problem.edges[weights > 0], problem.directions[weights > 0])
    np.testing.assert_allclose(some.projection_centers, rest.projection_centers, atol=1e-4)
    assert some.cost == pytest.approx(rest.cost, rel=2e-6)


def test_outliers_pull_less_than_in_least_squares():
    problem = ring_problem(60, 10, direction_sigma=0.01, outlier_share=0.1, seed=1)
    lud, cls = (
        np.median(align_positions(solver(*problem.measured).projection_centers, problem.centers)[0])
        for solver in (solve_lud, solve_cls)
    )
    assert lud < 0.5 * cls
