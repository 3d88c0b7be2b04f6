"""Alg. 1C and 1O against a dense twin written from the paper, and against their fixed-point equations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from position_problems import ring_problem

from colmap_vg import align_positions
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.positions.cls import solve_cls
from colmap_vg.positions.fixed_point import solve_fixed_point

APPROACHES = ["C", "O"]


def _dense_iteration(problem, p, approach, weights):
    """One turn of Alg. 1 by dense least squares, gauge included."""
    n, (i, j) = problem.num_images, problem.edges.T
    length = np.linalg.norm(p[j] - p[i], axis=1)
    B = np.zeros((len(i), n))
    B[np.arange(len(i)), i], B[np.arange(len(i)), j] = -1.0, 1.0
    root = np.sqrt(weights)[:, None]
    if approach == "C":  # min ||lambda gamma - (p_j - p_i)||^2, lambda = length
        A, b = root * B, root * length[:, None] * problem.directions
    else:  # min ||gamma - lambda (p_j - p_i)||^2, lambda = 1 / length
        A, b = root * B / length[:, None], root * problem.directions
    new = np.linalg.lstsq(A, b, rcond=None)[0]
    new = new - new.mean(axis=0)
    return new * (np.linalg.norm(p) / np.linalg.norm(new))


def _start(problem, weights=None):
    return solve_cls(*problem.measured, weights).projection_centers


@pytest.mark.parametrize("approach", APPROACHES)
def test_iterations_are_the_paper_s(approach):
    problem = ring_problem(30, 6, direction_sigma=0.1)
    weights = np.random.default_rng(0).uniform(0.3, 2.0, len(problem.edges))
    p = _start(problem, weights)
    for count in (1, 2, 5):
        result = solve_fixed_point(
            *problem.measured, p, approach, weights, accelerate=False, max_num_iterations=count, tolerance=0.0
        )
        expected = p
        for _ in range(count):
            expected = _dense_iteration(problem, expected, approach, weights)
        assert np.abs(result.projection_centers - expected).max() < 1e-9 * np.abs(p).max()
        assert result.num_iterations == count
        assert not result.converged


@pytest.mark.parametrize("approach", APPROACHES)
@pytest.mark.parametrize("seed", range(3))
def test_plain_and_accelerated_forms_reach_the_same_fixed_point(approach, seed):
    problem = ring_problem(60, 6, direction_sigma=0.1, seed=seed)
    start = _start(problem)
    fast = solve_fixed_point(*problem.measured, start, approach, tolerance=1e-11)
    plain = solve_fixed_point(
        *problem.measured, start, approach, accelerate=False, tolerance=1e-12, max_num_iterations=10_000
    )
    assert fast.converged
    assert plain.converged
    size = np.linalg.norm(start)
    assert np.linalg.norm(fast.projection_centers - plain.projection_centers) < 1e-8 * size
    assert fast.num_iterations < plain.num_iterations / 4
    for result in (fast, plain):
        again = _dense_iteration(problem, result.projection_centers, approach, np.ones(len(problem.edges)))
        assert np.linalg.norm(again - result.projection_centers) < 1e-8 * size
        assert np.linalg.norm(result.projection_centers) == pytest.approx(size, rel=1e-12)
        assert np.abs(result.projection_centers.mean(axis=0)).max() < 1e-12 * size


@pytest.mark.parametrize("approach", APPROACHES)
def test_fixed_point_equations(approach):
    problem = ring_problem(50, 6, direction_sigma=0.1, seed=5)
    p = solve_fixed_point(*problem.measured, _start(problem), approach, tolerance=1e-12).projection_centers
    i, j = problem.edges.T
    d = p[j] - p[i]
    length = np.linalg.norm(d, axis=1, keepdims=True)
    own, pull = (d, length * problem.directions) if approach == "C" else (d / length**2, problem.directions / length)
    at_nodes = np.zeros((2, len(p), 3))
    for term, flow in zip(at_nodes, (own, pull), strict=True):
        np.add.at(term, j, flow)
        np.subtract.at(term, i, flow)
    c = np.vdot(at_nodes[0], at_nodes[1]) / np.vdot(at_nodes[0], at_nodes[0])
    assert 0.5 < c < 1.0, "the multiplier of the gauge: without it the C variant shrinks"
    assert np.abs(c * at_nodes[0] - at_nodes[1]).max() < 1e-9 * np.abs(at_nodes[0]).max()


@pytest.mark.parametrize("approach", APPROACHES)
@pytest.mark.parametrize("accelerate", [True, False])
def test_noise_free_positions_are_recovered_from_a_bad_start(approach, accelerate):
    problem = ring_problem(40, 8)
    rng = np.random.default_rng(0)
    start = problem.centers + 0.3 * rng.standard_normal(problem.centers.shape)
    result = solve_fixed_point(
        *problem.measured, start, approach, accelerate=accelerate, tolerance=1e-13, max_num_iterations=10_000
    )
    assert result.converged
    assert align_positions(result.projection_centers, problem.centers)[0].max() < 1e-8 * 4.0


@pytest.mark.parametrize("approach", APPROACHES)
def test_lambdas_are_the_lengths_where_cls_leaves_them_at_one(approach):
    problem = ring_problem(60, 8, direction_sigma=0.1)
    cls = solve_cls(*problem.measured)
    result = solve_fixed_point(*problem.measured, cls.projection_centers, approach)
    i, j = problem.edges.T

    def ratio(r):
        return np.log10(r.lambdas / np.linalg.norm(r.projection_centers[j] - r.projection_centers[i], axis=1))

    assert np.abs(ratio(result)).max() < 1e-8
    assert np.abs(ratio(cls)).max() > 0.01


@pytest.mark.parametrize("approach", APPROACHES)
def test_cost_is_the_paper_s_objective(approach):
    problem = ring_problem(20, 5, direction_sigma=0.1)
    result = solve_fixed_point(*problem.measured, _start(problem), approach)
    i, j = problem.edges.T
    d = result.projection_centers[j] - result.projection_centers[i]
    length = np.linalg.norm(d, axis=1)
    expected = sum(
        np.sum((length[k] * problem.directions[k] - d[k]) ** 2) / (1.0 if approach == "C" else length[k] ** 2)
        for k in range(len(d))
    )
    assert result.cost == pytest.approx(expected, rel=1e-12)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(APPROACHES), st.floats(0.01, 100.0))
def test_world_scale_and_order_do_not_matter(seed, approach, scale):
    rng = np.random.default_rng(seed)
    problem = ring_problem(20, 5, direction_sigma=0.05, seed=2)
    start = _start(problem)
    turn, images, order = so3.random(1, rng)[0], rng.permutation(20), rng.permutation(len(problem.edges))
    a = solve_fixed_point(*problem.measured, start, approach, tolerance=1e-12).projection_centers
    b = solve_fixed_point(
        20,
        np.argsort(images)[problem.edges[order]],
        problem.directions[order] @ turn.T,
        scale * start[images] @ turn.T + rng.standard_normal(3),
        approach,
        tolerance=1e-12,
    ).projection_centers
    assert np.abs(b[np.argsort(images)] - scale * a @ turn.T).max() < 1e-8 * scale * np.abs(a).max()


def test_same_bits_again():
    problem = ring_problem(40, 6, direction_sigma=0.1)
    start = _start(problem)
    a, b = (solve_fixed_point(*problem.measured, start, "O").projection_centers for _ in range(2))
    assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("approach", APPROACHES)
def test_a_camera_whose_directions_diverge_does_not_leave_with_the_scale(approach):
    problem = ring_problem(40, 8)
    leaf = len(problem.centers)
    toward = normalized(np.array([[1.0, 0.2, 0.1]]))[0]
    ends = np.array([0, 1])
    # Noise has turned the two directions apart: the leaf's best place is at infinity.
    apart = problem.centers[1] - problem.centers[0]
    directions = normalized(np.stack([toward - 0.02 * apart, toward + 0.02 * apart]))
    edges = np.concatenate([problem.edges, np.stack([ends, [leaf, leaf]], axis=1)])
    measured = (leaf + 1, edges, np.concatenate([problem.directions, directions]))
    start = solve_cls(*measured).projection_centers
    farthest = max(1.5 * np.linalg.norm(start) / np.sqrt(leaf + 1), np.linalg.norm(start, axis=1).max())
    fast, plain = (
        solve_fixed_point(*measured, start, approach, accelerate=accelerate, max_num_iterations=5000)
        for accelerate in (True, False)
    )
    for result in (fast, plain):
        assert result.converged
        assert np.linalg.norm(result.projection_centers[leaf]) < 1.01 * farthest
        assert align_positions(result.projection_centers[:leaf], problem.centers)[0].max() < 0.02 * 4.0
    assert np.linalg.norm(fast.projection_centers - plain.projection_centers) < 1e-6 * np.linalg.norm(start)
