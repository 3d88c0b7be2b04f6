"""LUD: exact data exactly, its optimality conditions, and outliers that do not pull."""

import numpy as np
import pytest
from position_problems import ring_problem

from colmap_vg import SolveOptions, align_positions, solve_view_graph
from colmap_vg.positions.cls import solve_cls
from colmap_vg.positions.lud import RESIDUAL_FLOOR, solve_lud
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


@pytest.mark.parametrize("seed", range(2))
def test_optimality_conditions(seed):
    problem = ring_problem(40, 6, direction_sigma=0.05, outlier_share=0.1, seed=seed)
    weights = np.random.default_rng(seed).uniform(0.5, 2.0, len(problem.edges))
    result = solve_lud(*problem.measured, weights, max_num_iterations=2000, tolerance=1e-10)
    assert result.converged
    p, (i, j) = result.projection_centers, problem.edges.T
    residual = result.lambdas[:, None] * problem.directions - (p[j] - p[i])
    length = np.linalg.norm(residual, axis=1)
    force = weights[:, None] * residual / np.maximum(length, RESIDUAL_FLOOR)[:, None]
    balance = np.zeros_like(p)
    np.subtract.at(balance, j, force)
    np.add.at(balance, i, force)
    assert np.abs(balance).max() < 1e-6
    along = np.einsum("ka,ka->k", force, problem.directions)
    assert along.min() > -1e-6, "lambda would rather shrink below 1"
    assert np.abs(along * (result.lambdas - 1.0)).max() < 1e-6


def test_outliers_pull_less_than_in_least_squares():
    problem = ring_problem(60, 10, direction_sigma=0.01, outlier_share=0.1, seed=1)
    lud, cls = (
        np.median(align_positions(solver(*problem.measured).projection_centers, problem.centers)[0])
        for solver in (solve_lud, solve_cls)
    )
    assert lud < 0.5 * cls
