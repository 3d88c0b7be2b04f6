"""The scale of the robust loss: wide under normal noise, narrow under heavy tails, and of the least variance."""

import numpy as np
import pycolmap
import pytest

from colmap_vg.colmap_io.model_observations import ModelObservations
from colmap_vg.geometry.directions import normalized
from colmap_vg.linear.robust_losses import cauchy_weight
from colmap_vg.mapping import observations
from colmap_vg.mapping.observations import MIN_SIGMA_PX, SCALES_IN_SIGMAS, Observations, loss_scale, variances
from colmap_vg.mapping.point_refinement import refine_points


def model(noise_px: float = 0.0, heavy: bool = False, num_views: int = 8) -> pycolmap.Reconstruction:
    """A synthetic model; keypoints with normal noise, or with that of Student's t of two degrees of freedom."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_cameras_per_rig=1,
        num_frames_per_rig=num_views,
        num_points3D=400,
        num_points2D_without_point3D=0,
    )
    pycolmap.set_random_seed(0)
    found = pycolmap.synthesize_dataset(options)
    rng = np.random.default_rng(0)
    for image in found.images.values():
        for point in image.points2D:
            noise = rng.standard_normal(2) / (np.sqrt(rng.chisquare(2.0) / 2.0) if heavy else 1.0)
            point.xy = point.xy + noise_px * noise
    return found


def test_observations_are_those_of_the_points() -> None:
    found = model(noise_px=2.0)
    ids = sorted(found.points3D)[3:20:4]
    seen = Observations.of(found, ModelObservations.of(found), np.array(ids))
    errors = seen.reprojection_errors(found)
    told = {}
    for row, (point, image) in enumerate(zip(seen.point_row.tolist(), seen.image_row.tolist(), strict=True)):
        assert seen.camera_ids[row] == seen.images[image].camera_id
        told[ids[point], seen.images[image].image_id, *seen.keypoints[row].tolist()] = errors[row]
    expected = {}
    for point_id in ids:
        for element in found.points3D[point_id].track.elements:
            image, keypoint = found.image(element.image_id), found.image(element.image_id).point2D(element.point2D_idx)
            offset = image.project_point(found.points3D[point_id].xyz) - keypoint.xy
            expected[point_id, element.image_id, *keypoint.xy.tolist()] = np.linalg.norm(offset)
    assert told == pytest.approx(expected, rel=1e-9)
    np.testing.assert_array_equal(seen.positions, [found.points3D[i].xyz for i in ids])


@pytest.mark.parametrize("noise_px", [0.3, 2.0])
def test_normal_noise_has_nearly_squares_and_heavy_tails_have_not(noise_px: float) -> None:
    sigma = noise_px
    assert loss_scale(model(noise_px), 3) > 6.0 * sigma
    heavy = loss_scale(model(noise_px, heavy=True), 3)
    assert 0.8 * sigma < heavy < 3.0 * sigma
    assert loss_scale(model(2.0 * noise_px, heavy=True), 3) == pytest.approx(2.0 * heavy, rel=0.01)


def test_exact_keypoints_and_no_points_have_a_finite_scale() -> None:
    found = model()
    least, most = SCALES_IN_SIGMAS[[0, -1]] * MIN_SIGMA_PX
    assert least <= loss_scale(found, 3) <= most
    assert loss_scale(found, 1000) == least


@pytest.mark.parametrize("num_views", [6, 8])
def test_the_scale_is_that_of_the_noise_although_points_follow_it(num_views: int) -> None:
    exact, found = (model(noise_px, num_views=num_views) for noise_px in (0.0, 1.0))
    noise = [
        point.xy - image.points2D[row].xy
        for image_id, image in exact.images.items()
        for row, point in enumerate(found.image(image_id).points2D)
    ]
    ids = sorted(found.points3D)
    seen = Observations.of(found, ModelObservations.of(found), np.array(ids))
    camera = found.camera(1)
    rays = np.concatenate([camera.cam_from_img(seen.keypoints), np.ones((len(seen.keypoints), 1))], axis=1)
    moved = refine_points(
        seen.positions,
        seen.point_row,
        np.einsum("kba,kb->ka", seen.rotations[seen.image_row], normalized(rays)),
        seen.centers[seen.image_row],
        np.full(len(rays), camera.mean_focal_length()),
        scale_px=20.0,
        num_iterations=20,
    )
    for point_id, position in zip(ids, moved, strict=True):
        found.point3D(point_id).xyz = position
    squared = np.sum(np.square(noise), axis=1)
    expected = SCALES_IN_SIGMAS[np.argmin(variances(squared, SCALES_IN_SIGMAS))]
    assert loss_scale(found, 3) == pytest.approx(expected, rel=0.07)


def test_short_tracks_and_points_that_no_camera_shows_do_not_count() -> None:
    noisy, without = model(1.0, heavy=True), model(1.0, heavy=True)
    expected = loss_scale(noisy, 8)
    assert expected == loss_scale(noisy, 3)
    assert loss_scale(noisy, 9) == loss_scale(without, 1000)
    few, unseen = sorted(noisy.points3D)[::2], sorted(noisy.points3D)[1::4]
    for point_id in few:
        without.delete_point3D(point_id)
        elements = noisy.points3D[point_id].track.elements
        for image_id, row in [(element.image_id, element.point2D_idx) for element in elements[4:]]:
            noisy.delete_observation(image_id, row)
        noisy.points3D[point_id].xyz += 0.1
    assert loss_scale(noisy, 5) == loss_scale(without, 5)
    assert loss_scale(noisy, 3) > 1.2 * loss_scale(without, 3)
    for point_id in unseen:
        without.delete_point3D(point_id)
        noisy.points3D[point_id].xyz = np.full(3, np.nan)
    assert loss_scale(noisy, 5) == loss_scale(without, 5)


def test_the_scale_is_estimated_from_points_of_every_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    found = model(1.0, heavy=True)
    exact = model()
    for image_id, image in found.images.items():
        for row, point in enumerate(image.points2D):
            if point.point3D_id > 80:  # of 400
                point.xy += 4.0 * (point.xy - exact.image(image_id).points2D[row].xy)
    every = loss_scale(found, 3)
    monkeypatch.setattr(observations, "NUM_SAMPLED_OBSERVATIONS", 400)
    assert loss_scale(found, 3) == pytest.approx(every, rel=0.1)


def test_variances_are_those_of_estimates() -> None:
    # The position of 40 two-dimensional deviates of Student's t, fitted many times.
    rng = np.random.default_rng(1)
    r = rng.standard_normal((4000, 40, 2)) / np.sqrt(rng.chisquare(3.0, (4000, 40, 1)) / 3.0)
    for scale in (1.0, 4.0):
        at = np.zeros((4000, 1, 2))
        for _ in range(60):
            weights = cauchy_weight(np.sum((r - at) ** 2, axis=2) / scale**2)[:, :, None]
            at = (weights * r).sum(axis=1, keepdims=True) / weights.sum(axis=1, keepdims=True)
        expected = variances(np.sum(r**2, axis=2).ravel(), np.array([scale]))[0]
        assert 40 * np.var(at, axis=0).mean() == pytest.approx(expected, rel=0.1)
