"""Direct minimisation of eq. CLE1 against scipy's least_squares and finite differences."""

import numpy as np
import pytest
from position_problems import ring_problem
from scipy.optimize import least_squares

from colmap_vg import align_positions
from colmap_vg.positions.cls import solve_cls
from colmap_vg.positions.direct import _Directions, minimize_directions, solve_cle1
from colmap_vg.positions.fixed_point import solve_fixed_point

METRICS = ["chordal", "orthogonal"]


def _residuals(problem, p, weights, metric):
    i, j = problem.edges.T
    d = p[j] - p[i]
    unit = d / np.linalg.norm(d, axis=1, keepdims=True)
    residual = problem.directions - unit if metric == "chordal" else np.cross(problem.directions, unit)
    return (np.sqrt(weights)[:, None] * residual).ravel()


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("seed", range(3))
def test_minimum_of_scipy_s_least_squares(metric, seed):
    problem = ring_problem(15, 6, direction_sigma=0.1, seed=seed)
    weights = np.random.default_rng(seed).uniform(0.3, 2.0, len(problem.edges))
    start = solve_cls(*problem.measured, weights).projection_centers
    result = minimize_directions(*problem.measured, start, weights, metric=metric)
    other = least_squares(
        lambda x: _residuals(problem, x.reshape(-1, 3), weights, metric),
        start.ravel(),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-12,
    )
    assert result.converged
    assert result.cost == pytest.approx(2.0 * other.cost, rel=1e-9)
    errors, _ = align_positions(result.projection_centers, other.x.reshape(-1, 3))
    assert errors.max() < 1e-6 * np.abs(other.x).max()


@pytest.mark.parametrize("seed", range(3))
def test_named_method_reaches_scipy_s_minimum_from_its_own_start(seed):
    problem = ring_problem(15, 6, direction_sigma=0.08, seed=seed)
    result = solve_cle1(*problem.measured)
    ones = np.ones(len(problem.edges))
    other = least_squares(
        lambda x: _residuals(problem, x.reshape(-1, 3), ones, "chordal"),
        problem.centers.ravel(),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-12,
    )
    assert result.cost == pytest.approx(2.0 * other.cost, rel=1e-6)


@pytest.mark.parametrize("metric", METRICS)
def test_gradient_and_hessian_by_finite_differences(metric):
    problem = ring_problem(8, 4, direction_sigma=0.3, seed=1)
    weights = np.random.default_rng(0).uniform(0.3, 2.0, len(problem.edges))
    functions = _Directions(*problem.measured, weights, metric)
    p = problem.centers - problem.centers.mean(axis=0)
    at = functions.linearize(p)
    steps = 1e-5 * np.eye(p.size).reshape(-1, *p.shape)
    numeric = np.array([functions.cost(p + s) - functions.cost(p - s) for s in steps]) / 2e-5
    assert np.abs(at.gradient.ravel() - numeric).max() < 1e-8 * np.abs(numeric).max() + 1e-9
    numeric_hessian = np.array(
        [(functions.linearize(p + s).gradient - functions.linearize(p - s).gradient).ravel() for s in steps]
    )
    hessian = np.zeros((p.size, p.size))
    for k, (i, j) in enumerate(problem.edges):
        for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            hessian[3 * a : 3 * a + 3, 3 * b : 3 * b + 3] += sign * at.exact[k]
    assert np.abs(hessian - numeric_hessian / 2e-5).max() < 1e-7 * np.abs(hessian).max()


@pytest.mark.parametrize("metric", METRICS)
def test_gauss_newton_s_matrix_is_the_residuals_jacobian_squared(metric):
    problem = ring_problem(8, 4, direction_sigma=0.3, seed=1)
    ones = np.ones(len(problem.edges))
    p = problem.centers
    blocks = _Directions(*problem.measured, ones, metric).linearize(p).gauss_newton
    for k in range(3):
        j = problem.edges[k, 1]
        columns = []
        for axis in range(3):
            step = np.zeros_like(p)
            step[j, axis] = 1e-6
            up, down = (_residuals(problem, p + sign * step, ones, metric).reshape(-1, 3)[k] for sign in (1, -1))
            columns.append((up - down) / 2e-6)
        J = np.stack(columns, axis=1)
        assert np.abs(2.0 * J.T @ J - blocks[k]).max() < 1e-7 * np.abs(blocks[k]).max()


def test_cost_falls_below_that_of_the_fixed_point_of_1o():
    problem = ring_problem(60, 6, direction_sigma=0.04, seed=1)
    start = solve_cls(*problem.measured).projection_centers
    fixed = solve_fixed_point(*problem.measured, start, "O")
    result = solve_cle1(*problem.measured)
    share = (fixed.cost - result.cost) / result.cost
    assert 1e-5 < share < 1e-2, "near, but not the same"


@pytest.mark.parametrize("outlier_share", [0.0, 0.3])
def test_cost_never_rises(outlier_share):
    problem = ring_problem(40, 6, direction_sigma=0.2, outlier_share=outlier_share, seed=4)
    costs = [entry.cost for entry in solve_cle1(*problem.measured).log]
    assert (np.diff(costs) <= 1e-11 * costs[0]).all()


def test_end_is_quadratic():
    problem = ring_problem(60, 6, direction_sigma=0.1, seed=2)
    result = solve_cle1(*problem.measured)
    sizes = [entry.change for entry in result.log]
    assert result.num_iterations <= 15
    assert sizes[-1] < 1e-3 * sizes[-2]
