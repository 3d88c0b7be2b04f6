"""Bundle adjustment against dense least squares, scenes with known truth, and Ceres."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from colmap_vg.bundle import adjustment
from colmap_vg.bundle.adjustment import adjust
from colmap_vg.bundle.linearization import (
    DIFFERENCE,
    LOST_PX,
    Linearization,
    _derivative_by_ray,
    derivatives_by_lens,
    linearize,
)
from colmap_vg.bundle.point_systems import DAMPING, factored, gradients
from colmap_vg.bundle.problem import BundleProblem, BundleState
from colmap_vg.bundle.reduced_system import MIN_DAMPING, ReducedPattern, ReducedSystem
from colmap_vg.geometry.similarity import align_positions
from colmap_vg.linear.solvers import SingularMatrixError

FOCAL = 800.0


@dataclass
class Pinhole:
    """Focal length, principal point and one radial term."""

    free: np.ndarray

    def project(self, parameters: np.ndarray, rays: np.ndarray) -> np.ndarray:
        f, x, y, k = parameters
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = np.where(rays[:, 2:] > 0.0, rays[:, :2] / rays[:, 2:], np.nan)
        return f * flat * (1.0 + k * np.sum(flat**2, axis=1, keepdims=True)) + (x, y)


def scene(
    num_images: int = 6,
    num_points: int = 60,
    *,
    free: tuple[int, ...] = (0, 3),
    num_lenses: int = 2,
    sigma_px: float = 0.0,
    seen: float = 0.7,
    seed: int = 0,
) -> tuple[BundleProblem, BundleState]:
    """Images around a cloud of points, with lenses of their own in turn, and keypoints with noise."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (num_points, 3))
    angles = np.linspace(0.0, 1.8, num_images)
    R = Rotation.from_euler("yx", np.stack([angles, 0.2 * np.sin(7 * angles)], axis=1)).as_matrix()
    centers = -np.einsum("nba,b->na", R, [0.0, 0.1, 4.0]) + 0.1 * rng.normal(size=(num_images, 3))
    camera_idx = np.sort(np.arange(num_images) % num_lenses)
    lenses = [Pinhole(np.array(free, dtype=np.int64)) for _ in range(num_lenses)]
    parameters = [np.array([FOCAL + 30 * c, 500.0, 400.0, -0.05 + 0.02 * c]) for c in range(num_lenses)]
    rows = np.argwhere(rng.random((num_images, num_points)) < seen)
    image_row, point_row = rows[:, 0], rows[:, 1]
    local = np.einsum("kab,kb->ka", R[image_row], points[point_row] - centers[image_row])
    keypoints = np.zeros((len(rows), 2))
    for c, lens in enumerate(lenses):
        own = camera_idx[image_row] == c
        keypoints[own] = lens.project(parameters[c], local[own])
    keypoints += sigma_px * rng.normal(size=keypoints.shape)
    problem = BundleProblem(image_row, point_row, keypoints, camera_idx, lenses)
    return problem, BundleState(R, centers, points, parameters)


def displaced(problem: BundleProblem, state: BundleState, size: float, seed: int = 1) -> BundleState:
    """A state some way off, with focal lengths and radial terms too."""
    rng = np.random.default_rng(seed)
    n = problem.num_images
    step = size * rng.normal(size=problem.num_unknowns)
    for lens in problem.lenses:
        assert len(lens.free) in (0, 2)
    step[6 * n :: 2] *= FOCAL
    return state.moved(problem, step, state.points + size * rng.normal(size=state.points.shape))


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
            moved = state.moved(problem, step[:u], state.points + step[u:].reshape(-1, 3))
            ends.append(plain_residuals(problem, moved))
        columns.append(weights * (ends[0] - ends[1]) / 2e-6)
    return np.stack(columns, axis=1), weights * plain_residuals(problem, state)


def plain_residuals(problem: BundleProblem, state: BundleState) -> np.ndarray:
    found = np.zeros((len(problem.image_row), 2))
    for k, (image, point) in enumerate(zip(problem.image_row, problem.point_row, strict=True)):
        camera = problem.camera_idx[image]
        local = state.rotations[image] @ (state.points[point] - state.centers[image])
        found[k] = problem.lenses[camera].project(state.parameters[camera], local[None])[0] - problem.keypoints[k]
    return found.ravel()


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


@pytest.mark.parametrize("num_lenses", [1, 2, 6])
def test_exact_keypoints_give_the_exact_scene(num_lenses: int) -> None:
    problem, truth = scene(12, 150, num_lenses=num_lenses)
    found = adjust(problem, displaced(problem, truth, 0.01), 1.0, tolerance=1e-6)
    assert found.final_cost < 1e-9 < 1.0 < found.initial_cost
    errors, _ = align_positions(found.state.centers, truth.centers)
    assert errors.max() < 1e-5
    for parameters, expected in zip(found.state.parameters, truth.parameters, strict=True):
        np.testing.assert_allclose(parameters[[0, 3]], expected[[0, 3]], rtol=1e-3)
        np.testing.assert_array_equal(parameters[[1, 2]], expected[[1, 2]])


def test_wrong_keypoints_hardly_matter() -> None:
    problem, truth = scene(12, 200, num_lenses=1, sigma_px=0.3)
    start = displaced(problem, truth, 0.003)
    clean, _ = align_positions(adjust(problem, start, 0.7, tolerance=0.01).state.centers, truth.centers)
    rng = np.random.default_rng(3)
    keypoints = problem.keypoints.copy()
    wrong = rng.random(len(keypoints)) < 0.1
    keypoints[wrong] += rng.uniform(-30.0, 30.0, (wrong.sum(), 2))
    robust, _ = align_positions(
        adjust(replace(problem, keypoints=keypoints), start, 0.7, tolerance=0.01).state.centers, truth.centers
    )
    assert robust.mean() < 1.5 * clean.mean()


def test_the_end_is_within_the_tolerance_of_the_minimum() -> None:
    problem, truth = scene(12, 200, num_lenses=1, sigma_px=0.5)
    start = displaced(problem, truth, 0.003)
    rough, exact = adjust(problem, start, 2.0, tolerance=0.1), adjust(problem, start, 2.0, tolerance=1e-4)
    assert exact.final_cost <= rough.final_cost
    found = linearize(problem, exact.state, 2.0)
    system = ReducedSystem.of(problem, ReducedPattern(problem), exact.state, found)
    # The cost above the minimum is half the squared distance in standard deviations.
    distance = np.sqrt(2.0 * (rough.final_cost - exact.final_cost) / found.variance / problem.num_unknowns)
    assert distance < 0.1
    initial = ReducedSystem.of(problem, ReducedPattern(problem), start, linearize(problem, start, 2.0)).gradient
    assert np.abs(system.gradient).max() < 1e-2 * np.abs(initial).max()


def test_costs_never_rise_even_from_far_away() -> None:
    problem, truth = scene(8, 80, sigma_px=0.5)
    for seed in range(4):
        found = adjust(problem, displaced(problem, truth, 0.1, seed), 1.0)
        assert found.final_cost <= found.initial_cost


def test_a_singular_system_is_damped_and_given_up_with_the_state_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene()
    asked = []

    def singular(_: ReducedSystem, damping: float) -> np.ndarray:
        asked.append(damping)
        raise SingularMatrixError

    monkeypatch.setattr(ReducedSystem, "step", singular)
    start = displaced(problem, truth, 0.01)
    found = adjust(problem, start, 1.0)
    assert asked[0] == 0.0
    assert asked == sorted(asked)
    assert asked[-1] > 1.0
    assert len(asked) < adjustment.MAX_NUM_STEPS
    np.testing.assert_array_equal(found.state.rotations, start.rotations)
    assert found.final_cost <= found.initial_cost


def test_points_that_lose_by_their_step_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(sigma_px=0.5)
    start = displaced(problem, truth, 0.02)
    before = linearize(problem, start, 1.0)

    def worse_at_even_points(*arguments: object) -> Linearization:
        found = linearize(*arguments)
        costs = found.costs.copy()
        costs[::2] += 1e6
        return replace(found, costs=costs)

    monkeypatch.setattr(adjustment, "linearize", worse_at_even_points)
    state, after = adjustment._with_refined_points(problem, start, before, 1.0)
    np.testing.assert_array_equal(state.points[::2], start.points[::2])
    assert (state.points[1::2] != start.points[1::2]).any(axis=1).mean() > 0.9
    assert (after.costs <= before.costs).all()
    again = linearize(problem, state, 1.0)
    np.testing.assert_allclose(after.residuals, again.residuals, atol=1e-12)
    np.testing.assert_allclose(after.by_point, again.by_point, atol=1e-9)
    np.testing.assert_allclose(after.roots, again.roots, atol=1e-12)
    np.testing.assert_allclose(after.rays, again.rays, atol=1e-12)


def test_the_same_problem_gives_the_same_bits() -> None:
    problem, truth = scene(sigma_px=0.5)
    start = displaced(problem, truth, 0.01)
    one, two = adjust(problem, start, 1.0), adjust(problem, start, 1.0)
    np.testing.assert_array_equal(one.state.centers, two.state.centers)
    np.testing.assert_array_equal(one.state.points, two.state.points)


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


def test_points_follow_a_step_that_gains_only_once_they_have(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(sigma_px=0.5)
    start = displaced(problem, truth, 0.01)
    refined = adjustment._with_refined_points
    calls = []

    def gaining_late(
        asked: BundleProblem, state: BundleState, found: Linearization, scale_px: float
    ) -> tuple[BundleState, Linearization]:
        after, there = refined(asked, state, found, scale_px)
        calls.append(there.cost)
        late = len(calls) % adjustment.MAX_NUM_REFINEMENTS == 1 or len(calls) == 1
        return after, there if late else replace(there, costs=1.1 * calls[0] / there.cost * there.costs)

    monkeypatch.setattr(adjustment, "_with_refined_points", gaining_late)
    monkeypatch.setattr(adjustment, "MAX_NUM_STEPS", 1)
    found = adjust(problem, start, 1.0)
    # Once at the start, then three times after the step, of which only the last one gains.
    assert len(calls) == 1 + adjustment.MAX_NUM_REFINEMENTS
    assert found.final_cost == calls[-1] < found.initial_cost


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


class Recorder:
    """Keeps the dampings, steps and systems of an adjustment."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.dampings: list[float] = []
        self.steps: list[np.ndarray] = []
        self.expected: list[float] = []
        plain = ReducedSystem.step

        def step(system: ReducedSystem, damping: float) -> np.ndarray:
            found = plain(system, damping)
            self.dampings.append(damping)
            self.steps.append(found)
            self.expected.append(-float(system.gradient @ found))
            return found

        monkeypatch.setattr(ReducedSystem, "step", step)


def test_it_ends_with_the_first_step_that_is_short(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(12, 150, sigma_px=0.5)
    recorder = Recorder(monkeypatch)
    found = adjust(problem, displaced(problem, truth, 0.01), 1.0, tolerance=0.02)
    variance = linearize(problem, found.state, 1.0).variance
    sizes = np.sqrt(np.array(recorder.expected) / variance / problem.num_unknowns)
    assert 3 <= len(sizes) < 20
    assert sizes[-1] < 0.02 < sizes[:-1].min()


def test_steps_are_lengthened(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(sigma_px=0.5)
    start = displaced(problem, truth, 0.002)
    recorder = Recorder(monkeypatch)
    monkeypatch.setattr(adjustment, "MAX_NUM_STEPS", 1)
    state, found = adjustment._with_refined_points(problem, start, linearize(problem, start, 1.0), 1.0)
    assert found.relaxation > 1.05
    moved = adjust(problem, start, 1.0).state.centers - state.centers
    expected = found.relaxation * recorder.steps[0][: 6 * problem.num_images].reshape(-1, 6)[:, 3:]
    np.testing.assert_allclose(moved, expected, atol=1e-12)


def costs_times(factors: list[float], monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Let the next refinements of points end at the cost of the first, times factors; return the costs told."""
    refined, told = adjustment._with_refined_points, list[float]()

    def with_factor(
        problem: BundleProblem, state: BundleState, found: Linearization, scale_px: float
    ) -> tuple[BundleState, Linearization]:
        after, there = refined(problem, state, found, scale_px)
        factor = factors[len(told)] if len(told) < len(factors) else factors[-1]
        there = replace(there, costs=there.costs / there.cost * factor * (told[0] if told else there.cost))
        told.append(there.cost)
        return after, there

    monkeypatch.setattr(adjustment, "_with_refined_points", with_factor)
    return told


def test_points_do_not_follow_a_step_that_is_hopeless(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(sigma_px=0.5)
    told = costs_times([1.0, 1.3], monkeypatch)
    monkeypatch.setattr(adjustment, "MAX_NUM_STEPS", 1)
    adjust(problem, displaced(problem, truth, 0.01), 1.0)
    assert len(told) == 2


def test_damping_grows_faster_and_faster_with_failures(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(sigma_px=0.5)
    costs_times([1.0, 1.3], monkeypatch)
    recorder = Recorder(monkeypatch)
    monkeypatch.setattr(adjustment, "MAX_NUM_STEPS", 5)
    adjust(problem, displaced(problem, truth, 0.01), 1.0, tolerance=1e-9)
    np.testing.assert_allclose(recorder.dampings, np.array([0.0, 1.0, 4.0, 32.0, 512.0]) * adjustment.FIRST_DAMPING)


def test_damping_falls_with_the_gain_and_then_grows_slowly_again(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(sigma_px=0.5)
    told = costs_times([1.0, 1.3, 1.3, 1.3, 0.999, 1.3], monkeypatch)
    recorder = Recorder(monkeypatch)
    monkeypatch.setattr(adjustment, "MAX_NUM_STEPS", 7)
    adjust(problem, displaced(problem, truth, 0.01), 1.0, tolerance=1e-9)
    gain = 2.0 * (told[0] - told[4]) / recorder.expected[3]
    assert 0.0 < gain < 0.1
    after = recorder.dampings[3] * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
    np.testing.assert_allclose(recorder.dampings[4:], after * np.array([1.0, 2.0, 8.0]))


def test_steps_of_points_are_lengthened() -> None:
    problem, truth = scene(sigma_px=0.5)
    start = replace(truth, points=truth.points + 1e-4)
    found = linearize(problem, start, 1.0)
    state, _ = adjustment._with_refined_points(problem, start, found, 1.0)
    q, rows = len(start.points), problem.point_row
    factors = factored(q, rows, found.by_point)
    step = factors.upper(factors.lower(gradients(q, rows, found.by_point, found.residuals))).T
    moved = (state.points != start.points).any(axis=1)
    assert moved.mean() > 0.8
    assert found.relaxation > 1.05
    np.testing.assert_allclose((start.points - state.points)[moved], found.relaxation * step[moved], atol=1e-12)
