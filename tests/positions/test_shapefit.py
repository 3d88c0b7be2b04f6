"""ShapeFit against a dense reweighted twin and a certificate of its dual."""

import numpy as np
import pytest
from position_problems import PositionProblem, ring_problem
from scipy.optimize import minimize

from colmap_vg import align_positions
from colmap_vg.geometry.directions import normalized
from colmap_vg.positions.shapefit import solve_shapefit


def _dense(problem):
    """Residual operator (m, 3, 3 n) and the constraint's gradient (3 n,)."""
    n, m = problem.num_images, len(problem.edges)
    A, g = np.zeros((m, 3, 3 * n)), np.zeros(3 * n)
    for k, (i, j) in enumerate(problem.edges):
        gamma = problem.directions[k]
        P = np.eye(3) - np.outer(gamma, gamma)
        A[k, :, 3 * j : 3 * j + 3], A[k, :, 3 * i : 3 * i + 3] = P, -P
        g[3 * j : 3 * j + 3] += gamma
        g[3 * i : 3 * i + 3] -= gamma
    return A, g


def _reweighted(problem, weights):
    """Minimum by many reweighted least-squares problems in the constraints' null space."""
    n = problem.num_images
    A, g = _dense(problem)
    constraints = np.vstack([np.kron(np.ones((1, n)), np.eye(3)), g])
    p0 = np.linalg.lstsq(constraints, np.array([0.0, 0.0, 0.0, 1.0]), rcond=None)[0]
    Z = np.linalg.svd(constraints)[2][4:].T
    AZ, b = A @ Z, A @ p0
    root = np.sqrt(weights)[:, None]
    x, best = np.zeros(Z.shape[1]), np.inf
    for floor in np.repeat(np.logspace(-2, -9, 15), 60):
        length = np.linalg.norm(AZ @ x + b, axis=1)
        scale = (root / np.sqrt(np.hypot(length, floor * length.mean()))[:, None])[:, :, None]
        x = np.linalg.lstsq((scale * AZ).reshape(-1, Z.shape[1]), -(scale[:, :, 0] * b).ravel(), rcond=None)[0]
        best = min(best, float(np.sum(weights * np.linalg.norm(AZ @ x + b, axis=1))))
    return best


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("outlier_share", [0.0, 0.2])
def test_minimum_of_a_dense_twin(seed, outlier_share):
    problem = ring_problem(9, 4, direction_sigma=0.15, outlier_share=outlier_share, seed=seed)
    weights = np.random.default_rng(seed).uniform(0.3, 2.0, len(problem.edges))
    result = solve_shapefit(*problem.measured, weights)
    assert result.converged
    assert result.cost == pytest.approx(_reweighted(problem, weights), rel=2e-6)


def test_minimum_of_a_generic_solver():
    problem = ring_problem(6, 4, direction_sigma=0.2, seed=1)
    A, g = _dense(problem)
    result = solve_shapefit(*problem.measured)
    constraint = {"type": "eq", "fun": lambda x: g @ x - 1.0, "jac": lambda x: g}

    def smooth(x):
        residual = A @ x
        s = np.sqrt(np.sum(residual**2, axis=1) + 1e-16)
        return s.sum(), np.einsum("kab,ka->b", A, residual / s[:, None])

    start = result.projection_centers.ravel() + 0.02 * np.random.default_rng(0).standard_normal(18)
    other = minimize(
        smooth,
        start / (g @ start),
        jac=True,
        method="SLSQP",
        constraints=constraint,
        options={"maxiter": 500, "ftol": 1e-14},
    )
    assert other.fun >= result.cost * (1.0 - 1e-6)
    assert other.fun <= result.cost * (1.0 + 1e-3), "SLSQP comes near the kinks"


def test_constraints_hold():
    problem = ring_problem(30, 6, direction_sigma=0.1)
    result = solve_shapefit(*problem.measured)
    assert result.lambdas.sum() == pytest.approx(1.0, rel=1e-12)
    assert np.abs(result.projection_centers.sum(axis=0)).max() < 1e-12


def test_gap_closes_in_a_handful_of_steps():
    problem = ring_problem(120, 8, direction_sigma=0.1, outlier_share=0.2, seed=3)
    result = solve_shapefit(*problem.measured)
    assert result.converged
    assert result.log[-1].change <= 1e-6
    assert result.num_iterations <= 30


def test_exact_recovery_in_spite_of_outliers():
    # The theorem's ground: random positions, many edges, few of them wrong.
    rng = np.random.default_rng(0)
    n = 30
    centers = rng.standard_normal((n, 3))
    edges = np.stack(np.triu_indices(n, 1), axis=1)
    edges = edges[rng.random(len(edges)) < 0.6]
    directions = normalized(centers[edges[:, 1]] - centers[edges[:, 0]])
    wrong = rng.random(len(edges)) < 0.1
    directions[wrong] = normalized(rng.standard_normal((int(wrong.sum()), 3)))
    problem = PositionProblem(n, edges, directions, centers, wrong)
    result = solve_shapefit(*problem.measured, tolerance=1e-7)
    assert align_positions(result.projection_centers, centers)[0].max() < 1e-5
