"""Bundle adjustment of scenes with known truth: where it ends, how it steps, and what it leaves alone."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bundle_scenes import bent, displaced, plain_residuals, scene, street
from threadpoolctl import threadpool_info, threadpool_limits

from colmap_vg.bundle import adjustment
from colmap_vg.bundle.adjustment import MAX_SHARE, adjust
from colmap_vg.bundle.linearization import (
    Linearization,
    linearize,
)
from colmap_vg.bundle.point_systems import factored, gradients
from colmap_vg.bundle.problem import BundleProblem, BundleState
from colmap_vg.bundle.reduced_system import ReducedPattern, ReducedSystem
from colmap_vg.geometry.similarity import align_positions
from colmap_vg.linear.solvers import SingularMatrixError


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


class Recorder:
    """Keeps the dampings and steps of an adjustment, and the numbers of steps before each correction."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.dampings: list[float] = []
        self.steps: list[np.ndarray] = []
        self.expected: list[float] = []
        self.corrected: list[int] = []
        plain, correction, correcting = ReducedSystem.step, ReducedSystem.correction, list[bool]()

        def step(system: ReducedSystem, damping: float) -> np.ndarray:
            found = plain(system, damping)
            if not correcting:
                self.dampings.append(damping)
                self.steps.append(found)
                self.expected.append(-float(system.gradient @ found))
            return found

        def corrected(*arguments: Any) -> tuple[np.ndarray, np.ndarray]:
            self.corrected.append(len(self.steps))
            correcting.append(True)
            found = correction(*arguments)
            correcting.clear()
            return found

        monkeypatch.setattr(ReducedSystem, "step", step)
        monkeypatch.setattr(ReducedSystem, "correction", corrected)


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
    moved = adjust(problem, start, 1.0).state
    expected = state.moved(problem, found.relaxation * recorder.steps[0], state.points, start.viewed(problem))
    np.testing.assert_allclose(moved.centers, expected.centers, atol=1e-12)


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
    # At the start, after the step and after its correction.
    assert len(told) == 3


def test_damping_grows_faster_and_faster_with_failures(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(sigma_px=0.5)
    costs_times([1.0, 1.3], monkeypatch)
    recorder = Recorder(monkeypatch)
    monkeypatch.setattr(adjustment, "MAX_NUM_STEPS", 5)
    adjust(problem, displaced(problem, truth, 0.01), 1.0, tolerance=1e-9)
    np.testing.assert_allclose(recorder.dampings, np.array([0.0, 1.0, 4.0, 32.0, 512.0]) * adjustment.FIRST_DAMPING)
    assert recorder.corrected == [1, 2, 3, 4, 5]


def test_a_step_that_fails_is_corrected_before_it_is_damped(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(sigma_px=0.5)
    costs_times([1.0, 1.3, 0.9, 0.8], monkeypatch)
    recorder = Recorder(monkeypatch)
    monkeypatch.setattr(adjustment, "MAX_NUM_STEPS", 2)
    adjust(problem, displaced(problem, truth, 0.01), 1.0, tolerance=1e-9)
    assert recorder.dampings == [0.0, 0.0]
    assert recorder.corrected == [1]


def test_a_bent_street_is_straight_after_two_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = street(120)
    found = adjust(problem, bent(truth, 0.02), 1.0)
    recorder = Recorder(monkeypatch)
    exact = adjust(problem, found.state, 1.0, tolerance=1e-6)
    errors, _ = align_positions(found.state.centers, exact.state.centers)
    best, _ = align_positions(exact.state.centers, truth.centers)
    assert errors.mean() < 0.1 * best.mean()
    assert len(recorder.steps) < 8


def test_damping_falls_with_the_gain_and_then_grows_slowly_again(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(sigma_px=0.5)
    told = costs_times([1.0, *6 * [1.3], 0.999, 1.3], monkeypatch)
    recorder = Recorder(monkeypatch)
    monkeypatch.setattr(adjustment, "MAX_NUM_STEPS", 7)
    adjust(problem, displaced(problem, truth, 0.01), 1.0, tolerance=1e-9)
    gain = 2.0 * (told[0] - told[7]) / recorder.expected[3]
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


def test_points_alone_move_where_all_poses_are_held() -> None:
    problem, truth = scene(free=(), sigma_px=0.3)
    held = replace(problem, held=np.ones(problem.num_images, dtype=bool))
    start = replace(truth, points=truth.points + 1e-3)
    found = adjust(held, start, 1.0)
    np.testing.assert_array_equal(found.state.centers, truth.centers)
    assert found.final_cost < found.initial_cost


def test_a_scene_that_fits_exactly_stays() -> None:
    problem, truth = scene(free=())
    exact = replace(problem, keypoints=plain_residuals(problem, truth).reshape(-1, 2) + problem.keypoints)
    found = adjust(exact, truth, 1.0)
    assert found.final_cost == pytest.approx(0.0, abs=1e-18)
    np.testing.assert_allclose(found.state.centers, truth.centers, atol=1e-9)


def test_blas_has_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(sigma_px=0.5)
    threads = set[int]()

    def observed(*arguments: object) -> Linearization:
        threads.update(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
        return linearize(*arguments)

    monkeypatch.setattr(adjustment, "linearize", observed)
    with threadpool_limits(2, "blas"):
        adjust(problem, displaced(problem, truth, 0.01), 1.0)
    assert threads == {1}


def test_a_step_that_goes_on_in_the_direction_of_the_last_one_is_lengthened() -> None:
    problem, truth = scene(sigma_px=0.5)
    state = displaced(problem, truth, 0.01)
    system = ReducedSystem.of(problem, ReducedPattern(problem), state, linearize(problem, state, 1.0))
    before = system.step(0.0)
    across = np.random.default_rng(0).normal(size=len(before)) * np.abs(before)
    across -= before * (across @ system.matrix @ before) / (before @ system.matrix @ before)
    for share, factor in ((0.0, 1.0), (0.25, 1.0), (0.5, 2.0), (0.6, 2.5), (0.9, 1.0 / (1.0 - MAX_SHARE)), (-0.5, 1.0)):
        assert adjustment._lengthening(system, before, share * before + across) == pytest.approx(factor)
    assert adjustment._lengthening(system, None, before) == 1.0


def test_the_step_after_a_lengthened_one_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(sigma_px=0.5)
    asked: list[bool] = []

    def always_longer(system: ReducedSystem, before: np.ndarray | None, step: np.ndarray) -> float:
        asked.append(before is not None)
        return 1.5 if before is not None else 1.0

    monkeypatch.setattr(adjustment, "_lengthening", always_longer)
    monkeypatch.setattr(adjustment, "MAX_NUM_STEPS", 5)
    adjust(problem, displaced(problem, truth, 0.01), 1.0, tolerance=1e-9)
    assert asked == [False, True, False, True, False]


def test_a_step_after_one_that_failed_is_not_lengthened(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(sigma_px=0.5)
    costs_times([1.0, 1.3], monkeypatch)
    asked: list[bool] = []

    def recorded(system: ReducedSystem, before: np.ndarray | None, step: np.ndarray) -> float:
        asked.append(before is not None)
        return 1.0

    monkeypatch.setattr(adjustment, "_lengthening", recorded)
    monkeypatch.setattr(adjustment, "MAX_NUM_STEPS", 3)
    adjust(problem, displaced(problem, truth, 0.01), 1.0, tolerance=1e-9)
    assert asked == [False, False, False]


def test_heavy_tails_take_fewer_steps_than_without_lengthening(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(12, 300, num_lenses=1)
    rng = np.random.default_rng(2)
    problem = replace(problem, keypoints=problem.keypoints + 0.3 * rng.standard_cauchy(problem.keypoints.shape))
    start = displaced(problem, truth, 0.003)
    recorder = Recorder(monkeypatch)
    found = adjust(problem, start, 0.3, tolerance=0.01).final_cost
    longer = len(recorder.steps)
    recorder.steps.clear()
    monkeypatch.setattr(adjustment, "_lengthening", lambda *_: 1.0)
    assert adjust(problem, start, 0.3, tolerance=0.01).final_cost == pytest.approx(found, rel=1e-5)
    assert longer < len(recorder.steps)
