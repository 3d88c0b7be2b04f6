"""Residuals, derivatives and the reduced system of bundle adjustment, against the whole dense problem."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from bundle_scenes import Pinhole, displaced, plain_residuals, scene

from colmap_vg.bundle.linearization import (
    DIFFERENCE,
    LOST_PX,
    _derivative_by_ray,
    derivatives_by_lens,
    linearize,
)
from colmap_vg.bundle.point_systems import DAMPING, factored, gradients
from colmap_vg.bundle.problem import BundleProblem, BundleState
from colmap_vg.bundle.reduced_system import MIN_DAMPING, ReducedPattern, ReducedSystem


def jacobian(problem: BundleProblem, state: BundleState, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (2 k, u + 3 q) of the weighted residuals with fixed weights, by differences of the whole state."""
    u, q = problem.num_unknowns, len(state.points)
    weights = np.repeat(np.sqrt(weights_of(problem, state, scale)), 2)
    columns = []
    for unknown in range(u + 3 * q):
        ends = []
        for sign in (1.0, -1.0):
            step = np.zeros(u + 3 * q)
            step[unknown] = sign * 1e-6
            moved = state.moved(problem, step[:u], state.points + step[u:].reshape(-1, 3), state.viewed(problem))
            ends.append(plain_residuals(problem, moved))
        columns.append(weights * (ends[0] - ends[1]) / 2e-6)
    return np.stack(columns, axis=1), weights * plain_residuals(problem, state)


def weights_of(problem: BundleProblem, state: BundleState, scale: float) -> np.ndarray:
    squared = np.sum(plain_residuals(problem, state).reshape(-1, 2) ** 2, axis=1) / scale**2
    return 1.0 / (1.0 + squared)


@pytest.mark.parametrize(("num_lenses", "free"), [(1, (0, 3)), (2, (0, 3)), (6, (0, 3)), (2, ())])
def test_a_step_is_that_of_the_whole_dense_problem(num_lenses: int, free: tuple[int, ...]) -> None:
    problem, truth = scene(num_points=25, num_lenses=num_lenses, free=free, sigma_px=0.5, seen=0.9)
    state, scale = displaced(problem, truth, 1e-3), 2.0
    J, r = jacobian(problem, state, scale)
    H, u = J.T @ J, problem.num_unknowns
    diagonal = np.zeros(len(H))
    points = np.einsum("kii->ki", np.stack([H[i : i + 3, i : i + 3] for i in range(u, len(H), 3)]))
    diagonal[u:] = np.repeat(DAMPING * points.sum(axis=1), 3)
    found = linearize(problem, state, scale)
    system = ReducedSystem.of(problem, ReducedPattern(problem), state, found)
    full = H + np.diag(diagonal)
    reduced = full[:u, :u] - full[:u, u:] @ np.linalg.solve(full[u:, u:], full[u:, :u])
    gradient = J.T @ r
    right = gradient[:u] - full[:u, u:] @ np.linalg.solve(full[u:, u:], gradient[u:])
    size = np.sqrt(np.diag(reduced))
    np.testing.assert_allclose(
        system.matrix.toarray() / np.outer(size, size), reduced / np.outer(size, size), atol=1e-6
    )
    np.testing.assert_allclose(system.gradient / size, right / size, atol=1e-6 * np.abs(right / size).max())
    damping = 0.01
    step = system.step(damping)
    level = (damping + MIN_DAMPING) * np.diag(reduced)
    np.testing.assert_allclose(step * size, -np.linalg.solve(reduced + np.diag(level), right) * size, atol=2e-5)
    moved = system.steps_of_points(problem, step, 0.5)
    expected = -np.linalg.solve(full[u:, u:], full[u:, :u] @ step + 0.5 * gradient[u:]).reshape(-1, 3)
    np.testing.assert_allclose(moved, expected, atol=1e-8)


def test_a_correction_is_that_of_the_whole_dense_problem() -> None:
    problem, truth = scene(num_points=25, num_lenses=2, sigma_px=0.5, seen=0.9)
    state, scale, damping = displaced(problem, truth, 1e-3), 2.0, 0.01
    J, _ = jacobian(problem, state, scale)
    H, u = J.T @ J, problem.num_unknowns
    rng = np.random.default_rng(0)
    step, shifts, bend = rng.normal(size=u), rng.normal(size=state.points.shape), rng.normal(size=len(J))
    change = bend + J @ np.concatenate([step, shifts.ravel()])
    reduced = H[:u, :u] - H[:u, u:] @ np.linalg.solve(H[u:, u:], H[u:, :u])
    level = np.zeros(len(H))
    level[:u] = (damping + MIN_DAMPING) * np.diag(reduced)
    expected = -np.linalg.solve(H + np.diag(level), J.T @ bend)
    system = ReducedSystem.of(problem, ReducedPattern(problem), state, linearize(problem, state, scale))
    more, further = system.correction(problem, step, shifts, change.reshape(-1, 2).T, damping)
    size = np.sqrt(np.diag(H))
    found = np.concatenate([more, further.ravel()])
    np.testing.assert_allclose(found * size, expected * size, atol=1e-4 * np.abs(expected * size).max())


def test_changes_and_corrections_with_fixed_points_are_those_of_the_dense_problem() -> None:
    problem, truth = scene(num_points=25, num_lenses=2, sigma_px=0.5, seen=0.9)
    problem = replace(problem, fixed=np.arange(25) % 3 == 0)
    state, damping = displaced(problem, truth, 1e-3), 0.01
    J, _ = jacobian(problem, state, 2.0)
    u, rng = problem.num_unknowns, np.random.default_rng(0)
    J[:, u:][:, np.repeat(problem.fixed, 3)] = 0.0
    step, bend = rng.normal(size=u), rng.normal(size=len(J))
    shifts = np.where(problem.fixed[:, None], 0.0, rng.normal(size=state.points.shape))
    system = ReducedSystem.of(problem, ReducedPattern(problem), state, linearize(problem, state, 2.0))
    np.testing.assert_allclose(system._changes(problem, step).T.ravel(), J[:, :u] @ step, rtol=1e-5, atol=1e-5)
    change = bend + J @ np.concatenate([step, shifts.ravel()])
    used = np.concatenate([np.ones(u, dtype=bool), np.repeat(~problem.fixed, 3)])
    H = J[:, used].T @ J[:, used]
    reduced = H[:u, :u] - H[:u, u:] @ np.linalg.solve(H[u:, u:], H[u:, :u])
    level = np.zeros(len(H))
    level[:u] = (damping + MIN_DAMPING) * np.diag(reduced)
    expected = -np.linalg.solve(H + np.diag(level), J[:, used].T @ bend)
    more, further = system.correction(problem, step, shifts, change.reshape(-1, 2).T, damping)
    size, found = np.sqrt(np.diag(H)), np.concatenate([more, further[~problem.fixed].ravel()])
    np.testing.assert_allclose(found * size, expected * size, atol=1e-4 * np.abs(expected * size).max())
    assert not further[problem.fixed].any()


def test_changes_of_residuals_have_the_weights_of_where_they_start() -> None:
    problem, truth = scene(seen=1.0, sigma_px=0.5)
    one = linearize(problem, displaced(problem, truth, 1e-3), 1.0)
    moved = displaced(problem, truth, 2e-3)
    points = moved.points.copy()
    points[0] = moved.centers[0] - 3.0 * moved.rotations[0, 2]  # behind the first camera
    moved = replace(moved, points=points)
    change = one.change_to(linearize(problem, moved, 1.0))
    expected = one.roots * plain_residuals(problem, moved).reshape(-1, 2).T - one.residuals
    lost = np.isnan(expected).any(axis=0)
    assert lost[(problem.point_row == 0) & (problem.image_row == 0)].all()
    assert lost.mean() < 0.1
    np.testing.assert_allclose(change[:, ~lost], expected[:, ~lost], atol=1e-9)
    assert not change[:, lost].any()


def test_two_observations_of_a_point_in_one_image_count_twice() -> None:
    problem, truth = scene(num_points=20, num_lenses=1, sigma_px=0.5, seen=0.95)
    order = np.sort(np.concatenate([np.arange(len(problem.image_row)), [0, 3, 17]]), kind="stable")
    twice = replace(
        problem,
        image_row=problem.image_row[order],
        point_row=problem.point_row[order],
        keypoints=problem.keypoints[order],
    )
    state = displaced(problem, truth, 1e-3)
    J, _ = jacobian(twice, state, 2.0)
    H, u = J.T @ J, problem.num_unknowns
    reduced = H[:u, :u] - H[:u, u:] @ np.linalg.solve(H[u:, u:], H[u:, :u])
    found = ReducedSystem.of(twice, ReducedPattern(twice), state, linearize(twice, state, 2.0)).matrix.toarray()
    size = np.sqrt(np.diag(reduced))
    np.testing.assert_allclose(found / np.outer(size, size), reduced / np.outer(size, size), atol=1e-4)


def test_residuals_costs_and_factors() -> None:
    problem, truth = scene(sigma_px=0.5)
    state, scale = displaced(problem, truth, 1e-3), 1.5
    found, w = linearize(problem, state, scale), weights_of(problem, state, scale)
    r = plain_residuals(problem, state).reshape(-1, 2)
    np.testing.assert_allclose(found.residuals.T, np.sqrt(w)[:, None] * r, rtol=1e-9)
    cost = 0.5 * scale**2 * np.log1p(np.sum(r**2, axis=1) / scale**2)
    np.testing.assert_allclose(found.costs, np.bincount(problem.point_row, cost), rtol=1e-9)
    assert found.cost == pytest.approx(cost.sum())
    assert found.relaxation == pytest.approx(w.mean() / np.mean(w**2))
    spread = np.mean(w**2 * np.sum(r**2, axis=1)) / 2.0
    assert found.variance == pytest.approx(spread * w.mean() / np.mean(w**2) ** 2)


def test_steps_are_at_most_nearly_doubled() -> None:
    problem, truth = scene(sigma_px=5.0)
    assert linearize(problem, truth, 0.1).relaxation == pytest.approx(1.9)
    assert linearize(problem, truth, 1e6).relaxation == pytest.approx(1.0)


def test_points_without_a_projection_pull_nothing_and_cost_much() -> None:
    problem, truth = scene(seen=1.0)
    points = truth.points.copy()
    points[0] = truth.centers[0] - 3.0 * truth.rotations[0, 2]  # behind the first camera
    found = linearize(problem, replace(truth, points=points), 1.0)
    lost = np.flatnonzero((problem.point_row == 0) & (problem.image_row == 0))
    assert len(lost) == 1
    assert not found.by_point[:, :, lost].any()
    assert not derivatives_by_lens(problem, replace(truth, points=points), found)[:, :, lost].any()
    assert not found.residuals[:, lost].any()
    squared = np.sum(plain_residuals(problem, replace(truth, points=points)).reshape(-1, 2) ** 2, axis=1)
    squared[np.isnan(squared)] = LOST_PX**2
    assert found.costs[0] == pytest.approx(0.5 * np.log1p(squared[problem.point_row == 0]).sum())
    assert np.isfinite(found.by_point).all()


def test_the_three_by_three_systems_of_points() -> None:
    rng = np.random.default_rng(0)
    row, A, r = np.repeat(np.arange(5), 4), rng.normal(size=(2, 3, 20)), rng.normal(size=(2, 20))
    factors, gradient = factored(5, row, A), gradients(5, row, A, r)
    for point in range(5):
        own = A[:, :, row == point].transpose(2, 0, 1).reshape(-1, 3)
        H, g = own.T @ own, own.T @ r[:, row == point].T.ravel()
        np.testing.assert_allclose(gradient[:, point], g)
        damped = H + DAMPING * np.trace(H) * np.eye(3)
        solved = factors.upper(factors.lower(gradient))[:, point]
        np.testing.assert_allclose(solved, np.linalg.solve(damped, g))
        b = factors.lower(gradient)[:, point]
        assert b @ b == pytest.approx(g @ np.linalg.solve(damped, g))
        np.testing.assert_array_equal(factors.at(np.array([point])).components[:, 0], factors.components[:, point])


def test_derivatives_by_a_parameter_near_zero_and_by_a_large_one() -> None:
    problem, truth = scene(num_lenses=1)
    found = linearize(problem, truth, 1e9)
    local = np.einsum(
        "kab,kb->ka",
        truth.rotations[problem.image_row],
        (truth.points[problem.point_row] - truth.centers[problem.image_row]),
    )
    flat = local[:, :2] / local[:, 2:]
    squared = np.sum(flat**2, axis=1, keepdims=True)
    f, _, _, k = truth.parameters[0]
    by_lens = derivatives_by_lens(problem, truth, found)
    np.testing.assert_allclose(by_lens[:, 0].T, flat * (1.0 + k * squared), rtol=1e-6)
    np.testing.assert_allclose(by_lens[:, 1].T, f * flat * squared, rtol=1e-6, atol=1e-6)
    assert DIFFERENCE < 1e-5


@dataclass
class Sphere:
    """Longitude and latitude, for rays of all directions."""

    free: np.ndarray

    def project(self, parameters: np.ndarray, rays: np.ndarray) -> np.ndarray:
        return parameters[0] * np.stack(
            [np.arctan2(rays[:, 0], rays[:, 2]), np.arctan2(rays[:, 1], np.hypot(rays[:, 0], rays[:, 2]))], axis=1
        )


def test_derivatives_by_rays_of_all_directions_and_by_those_ahead() -> None:
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(40, 3))
    rays[0, 2] = 0.0
    x, y, z = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).T
    flat = x**2 + z**2
    expected = 300.0 * np.array(
        [[z / flat, 0 * x, -x / flat], [-x * y / np.sqrt(flat), np.sqrt(flat), -y * z / np.sqrt(flat)]]
    )
    lens, parameters = Sphere(np.array([])), np.array([300.0])
    every = np.stack([x, y, z], axis=1)
    np.testing.assert_allclose(_derivative_by_ray(lens, parameters, every), expected, atol=1e-5)
    ahead = np.abs(z) > 0.2
    np.testing.assert_allclose(
        _derivative_by_ray(lens, parameters, every[ahead]), expected[:, :, ahead], atol=1e-5, rtol=1e-6
    )


def test_lenses_may_have_different_numbers_of_unknowns() -> None:
    problem, truth = scene(num_points=25, num_lenses=2, sigma_px=0.5, seen=0.9)
    fewer = replace(problem, lenses=[problem.lenses[0], Pinhole(np.array([], dtype=np.int64))])
    every = ReducedSystem.of(problem, ReducedPattern(problem), truth, linearize(problem, truth, 2.0))
    found = ReducedSystem.of(fewer, ReducedPattern(fewer), truth, linearize(fewer, truth, 2.0))
    u = fewer.num_unknowns
    assert u == problem.num_unknowns - 2
    np.testing.assert_allclose(found.matrix.toarray(), every.matrix.toarray()[:u, :u], rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(found.gradient, every.gradient[:u])
