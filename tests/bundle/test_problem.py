"""Steps of the state: what stays in proportion, what is added, and what does not move."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bundle_scenes import FOCAL, displaced, plain_residuals, scene

from colmap_vg.bundle.adjustment import adjust
from colmap_vg.bundle.problem import MAX_GROWTH, BundleProblem, BundleState


def test_an_image_looks_at_the_middle_of_its_points() -> None:
    problem, truth = scene(num_points=500)
    viewed = truth.viewed(problem)
    assert np.linalg.norm(viewed, axis=1).max() < 0.3
    rays = truth.points[problem.point_row] - truth.centers[problem.image_row]
    own = problem.image_row == 2
    distance = 1.0 / np.mean(1.0 / np.linalg.norm(rays[own], axis=1))
    assert np.linalg.norm(viewed[2] - truth.centers[2]) == pytest.approx(distance, rel=1e-12)


def zoomed(problem: BundleProblem, truth: BundleState, share: float) -> BundleState:
    """A step of all focal lengths, and of all distances from the middle of the scene, by a share."""
    step = np.zeros(problem.num_unknowns)
    viewed = np.zeros_like(truth.centers)
    poses = step[: 6 * problem.num_images].reshape(-1, 6)
    poses[:, 3:] = share * (truth.centers - viewed)
    step[6 * problem.num_images :: 2] = [share * parameters[0] for parameters in truth.parameters]
    return truth.moved(problem, step, truth.points, viewed)


@pytest.mark.parametrize("share", [-0.5, 0.3, 1.0])
def test_focal_lengths_and_distances_stay_in_proportion(share: float) -> None:
    problem, truth = scene()
    moved = zoomed(problem, truth, share)
    np.testing.assert_allclose(moved.centers, np.exp(share) * truth.centers, rtol=1e-12)
    for after, before in zip(moved.parameters, truth.parameters, strict=True):
        assert after[0] == pytest.approx(np.exp(share) * before[0], rel=1e-12)
        np.testing.assert_array_equal(after[1:], before[1:])


def test_steps_sideways_and_of_other_parameters_are_added() -> None:
    problem, truth = scene()
    viewed = truth.viewed(problem)
    away = truth.centers - viewed
    sideways = np.cross(away, [0.0, 1.0, 0.0])
    step = np.zeros(problem.num_unknowns)
    step[: 6 * problem.num_images].reshape(-1, 6)[:, 3:] = sideways
    step[6 * problem.num_images + 1 :: 2] = 0.01
    moved = truth.moved(problem, step, truth.points, viewed)
    np.testing.assert_allclose(moved.centers, truth.centers + sideways, atol=1e-12)
    for after, before in zip(moved.parameters, truth.parameters, strict=True):
        np.testing.assert_allclose(after, before + np.array([0.0, 0.0, 0.0, 0.01]), atol=1e-15)


def test_a_step_sideways_grows_with_the_distance() -> None:
    problem, truth = scene()
    viewed = np.zeros_like(truth.centers)
    sideways = 0.1 * np.cross(truth.centers, [0.0, 1.0, 0.0])
    step = np.zeros(problem.num_unknowns)
    step[: 6 * problem.num_images].reshape(-1, 6)[:, 3:] = 0.3 * truth.centers + sideways
    moved = truth.moved(problem, step, truth.points, viewed)
    np.testing.assert_allclose(moved.centers, np.exp(0.3) * (truth.centers + sideways), rtol=1e-12)


def test_what_has_no_step_keeps_every_bit_and_huge_steps_are_bounded() -> None:
    problem, truth = scene()
    viewed = truth.viewed(problem)
    still = truth.moved(problem, np.zeros(problem.num_unknowns), truth.points, viewed)
    np.testing.assert_array_equal(still.centers, truth.centers)
    np.testing.assert_array_equal(still.parameters, truth.parameters)
    for share in (-1e6, 1e6):
        moved = zoomed(problem, truth, share)
        expected = np.exp(np.sign(share) * MAX_GROWTH)
        np.testing.assert_allclose(moved.centers, expected * truth.centers, rtol=1e-6)
        assert moved.parameters[0][0] == pytest.approx(expected * FOCAL, rel=1e-12)


def test_images_without_points_stay_finite() -> None:
    problem, truth = scene()
    kept = problem.image_row != 3
    without = BundleProblem(
        problem.image_row[kept], problem.point_row[kept], problem.keypoints[kept], problem.camera_idx, problem.lenses
    )
    viewed = truth.viewed(without)
    np.testing.assert_array_equal(viewed[3], truth.centers[3])
    moved = truth.moved(without, 0.1 * np.ones(problem.num_unknowns), truth.points, viewed)
    assert np.isfinite(moved.centers).all()


def test_a_focal_length_far_off_is_found_in_four_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, truth = scene(12, 300, num_lenses=1)
    truth = zoomed(problem, truth, np.log(3.0))
    rng = np.random.default_rng(0)
    noise = 0.05 * rng.normal(size=problem.keypoints.shape)
    problem = replace(problem, keypoints=problem.keypoints + plain_residuals(problem, truth).reshape(-1, 2) + noise)
    start = zoomed(problem, truth, 0.3)
    loss_scale = 1.3 * float(np.median(np.linalg.norm(plain_residuals(problem, start).reshape(-1, 2), axis=1)))
    plain, states = BundleState.moved, list[BundleState]()

    def recorded(state: BundleState, *step: Any) -> BundleState:
        states.append(plain(state, *step))
        return states[-1]

    monkeypatch.setattr(BundleState, "moved", recorded)
    adjust(problem, start, loss_scale)
    assert states[3].parameters[0][0] == pytest.approx(3.0 * FOCAL, rel=2e-3)
    assert len(states) == 4


@pytest.mark.parametrize("limit", [1, 70, 10_000])
def test_runs_cover_all_observations_once_lens_by_lens(limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = adjusted_from_afar()
    monkeypatch.setattr("colmap_vg.bundle.problem.OBSERVATIONS_PER_RUN", limit)
    problem, _ = scene(num_images=7, num_lenses=3)
    runs = problem.runs
    assert [run.observations.start for run in runs] == [0, *(run.observations.stop for run in runs[:-1])]
    assert runs[-1].observations.stop == len(problem.image_row)
    for run in runs:
        images = range(run.first, run.first + len(run.of_images))
        assert {int(problem.camera_idx[image]) for image in images} == {run.lens}
        for image, at in zip(images, run.of_images, strict=True):
            assert (problem.image_row[run.observations][at] == image).all()
    assert 3 <= len(runs) <= 7
    assert len(runs) == {1: 7, 10_000: 3}.get(limit, len(runs))
    for one, other in zip(adjusted_from_afar(), expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-7)


def adjusted_from_afar() -> tuple[np.ndarray, np.ndarray]:
    """Positions and points after a few steps."""
    problem, truth = scene(num_images=7, num_lenses=3, sigma_px=0.3)
    found = adjust(problem, displaced(problem, truth, 1e-3), 2.0).state
    return found.centers, found.points
