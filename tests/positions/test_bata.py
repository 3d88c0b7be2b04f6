"""BATA: its objective, its stationary points and its robustness."""

import numpy as np
import pytest
from position_problems import ring_problem

from colmap_vg import align_positions
from colmap_vg.positions.bata import ROBUST_SCALE, solve_bata
from colmap_vg.positions.cls import solve_cls


def _objective(problem, p, weights):
    """Angle by angle: Cauchy's loss of the sine up to 90 degrees, of 1 beyond."""
    total = 0.0
    for k, (i, j) in enumerate(problem.edges):
        d = p[j] - p[i]
        cosine = d @ problem.directions[k] / np.linalg.norm(d)
        squared = 1.0 - cosine**2 if cosine > 0 else 1.0
        total += weights[k] * ROBUST_SCALE**2 * np.log1p(squared / ROBUST_SCALE**2)
    return total


@pytest.mark.parametrize("seed", range(3))
def test_result_is_a_minimum_of_the_robust_sines(seed):
    problem = ring_problem(15, 6, direction_sigma=0.05, seed=seed)
    weights = np.random.default_rng(seed).uniform(0.3, 2.0, len(problem.edges))
    result = solve_bata(*problem.measured, weights, max_num_iterations=2000, tolerance=1e-11)
    p = result.projection_centers
    assert result.converged
    assert result.cost == pytest.approx(_objective(problem, p, weights), rel=1e-9)
    step = 1e-5 * np.abs(p).max()
    for row in range(0, 15, 4):
        for axis in range(3):
            move = np.zeros_like(p)
            move[row, axis] = step
            up, down = (_objective(problem, p + sign * move, weights) for sign in (1, -1))
            assert abs(up - down) < 1e-3 * (up + down - 2.0 * result.cost), "the lowest point of a parabola"


@pytest.mark.parametrize("seed", range(3))
def test_long_baselines_do_not_draw_the_others(seed):
    # An edge counts by its angle alone; CLS fits the long ones at the cost of the short ones.
    problem = ring_problem(40, 10, direction_sigma=0.03, seed=seed)

    def long_over_short(p):
        d = p[problem.edges[:, 1]] - p[problem.edges[:, 0]]
        length = np.linalg.norm(d, axis=1)
        squared = np.sum((d / length[:, None] - problem.directions) ** 2, axis=1)
        long = length > np.median(length)
        return np.sqrt(squared[long].mean() / squared[~long].mean())

    assert long_over_short(solve_cls(*problem.measured).projection_centers) < 0.8
    assert long_over_short(solve_bata(*problem.measured).projection_centers) > 1.0


def test_outliers_are_outvoted():
    problem = ring_problem(120, 12, direction_sigma=0.02, outlier_share=0.2, seed=1)
    robust = align_positions(solve_bata(*problem.measured).projection_centers, problem.centers)[0]
    squares = align_positions(solve_cls(*problem.measured).projection_centers, problem.centers)[0]
    assert np.median(robust) < 0.02 * 4.0
    assert np.median(robust) < 0.1 * np.median(squares)


def test_backward_edges_have_no_length():
    problem = ring_problem(40, 8)
    problem.directions[3] *= -1.0
    result = solve_bata(*problem.measured)
    assert np.isinf(result.lambdas[3])
    assert result.cost == pytest.approx(ROBUST_SCALE**2 * np.log1p(ROBUST_SCALE**-2), rel=1e-3), "as if at 90 degrees"
    assert np.isfinite(np.delete(result.lambdas, 3)).all()
    assert align_positions(result.projection_centers, problem.centers)[0].max() < 1e-4


def test_gauge():
    problem = ring_problem(30, 6, direction_sigma=0.05)
    p = solve_bata(*problem.measured).projection_centers
    d = p[problem.edges[:, 1]] - p[problem.edges[:, 0]]
    assert np.sum(d * problem.directions) == pytest.approx(len(d), rel=1e-12)


def test_ten_rounds_as_published():
    problem = ring_problem(60, 8, direction_sigma=0.03, outlier_share=0.3, seed=2)
    result = solve_bata(*problem.measured)
    assert result.num_iterations == 10
    assert result.converged
    assert result.log[-1].change > 1e-8
    assert not solve_bata(*problem.measured, max_num_iterations=9).converged
