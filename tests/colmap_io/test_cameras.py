"""Bearings and scaled focal lengths against the camera models' own projections."""

import numpy as np
import pycolmap
import pytest

from colmap_vg.colmap_io.cameras import bearings_of_keypoints, calibration_matrix, with_focal_scale

MODELS = {
    "SIMPLE_PINHOLE": (800.0, 512.0, 384.0),
    "PINHOLE": (800.0, 780.0, 512.0, 384.0),
    "SIMPLE_RADIAL": (800.0, 512.0, 384.0, -0.08),
    "RADIAL": (800.0, 512.0, 384.0, -0.08, 0.02),
    "OPENCV": (800.0, 780.0, 512.0, 384.0, -0.08, 0.02, 0.003, -0.002),
    "FULL_OPENCV": (800.0, 780.0, 512.0, 384.0, -0.08, 0.02, 0.003, -0.002, 0.004, 0.03, -0.01, 0.002),
    "SIMPLE_DIVISION": (800.0, 512.0, 384.0, -0.1),
    "DIVISION": (800.0, 780.0, 512.0, 384.0, -0.1),
    "SIMPLE_RADIAL_FISHEYE": (400.0, 512.0, 384.0, 0.02),
    "RADIAL_FISHEYE": (400.0, 512.0, 384.0, 0.02, -0.004),
    "OPENCV_FISHEYE": (400.0, 390.0, 512.0, 384.0, 0.02, -0.004, 0.001, -0.0005),
    "THIN_PRISM_FISHEYE": (400.0, 390.0, 512.0, 384.0, 0.02, -0.004, 1e-3, -1e-3, 1e-4, 0.0, 1e-3, -1e-3),
    "FOV": (500.0, 500.0, 512.0, 384.0, 0.9),
    "EUCM": (400.0, 400.0, 512.0, 384.0, 0.6, 1.1),
}


def camera_of(model: str) -> pycolmap.Camera:
    return pycolmap.Camera(camera_id=1, model=model, width=1024, height=768, params=list(MODELS[model]))


def rays_up_to(angle_deg: float, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    theta, phi = np.radians(rng.uniform(0, angle_deg, count)), rng.uniform(0, 2 * np.pi, count)
    return np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


@pytest.mark.parametrize("model", MODELS)
def test_bearings_invert_the_projection(model: str) -> None:
    rays = rays_up_to(70.0 if "FISHEYE" in model else 38.0, 300, seed=1)
    camera = camera_of(model)
    bearings, valid = bearings_of_keypoints(camera, camera.img_from_cam(rays))
    assert valid.all()
    assert np.linalg.norm(bearings - rays, axis=1).max() < 1e-6
    assert np.allclose(np.linalg.norm(bearings, axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("model", MODELS)
def test_a_valid_bearing_projects_back_on_its_pixel(model: str) -> None:
    """Pixels over four times the image: where a model has no ray, the bearing is marked, never wrong in silence."""
    rng = np.random.default_rng(2)
    pixels = rng.uniform([-1500, -1200], [2500, 2000], (4000, 2))
    camera = camera_of(model)
    bearings, valid = bearings_of_keypoints(camera, pixels)
    assert valid.any()
    assert np.isfinite(bearings).all()
    assert np.allclose(np.linalg.norm(bearings, axis=1), 1.0, atol=1e-12)
    assert (bearings[valid, 2] > 0).all()
    assert np.linalg.norm(camera.img_from_cam(bearings[valid]) - pixels[valid], axis=1).max() < 1.0


def test_fisheye_pixels_beyond_a_right_angle_are_marked() -> None:
    camera = pycolmap.Camera(
        camera_id=1, model="OPENCV_FISHEYE", width=1024, height=768, params=[200.0, 200.0, 512.0, 384.0, 0, 0, 0, 0]
    )
    theta = np.radians(np.arange(0.5, 180.0, 1.0))  # equidistant: r = f theta
    pixels = np.column_stack([512.0 + 200.0 * theta, np.full(len(theta), 384.0)])
    bearings, valid = bearings_of_keypoints(camera, pixels)
    assert valid[theta < np.radians(88)].all()
    assert not valid[theta > np.radians(90)].any()
    expected = np.column_stack([np.sin(theta), np.zeros(len(theta)), np.cos(theta)])
    assert np.linalg.norm(bearings - expected, axis=1)[valid].max() < 1e-6


def test_no_keypoints_and_broken_ones() -> None:
    camera = camera_of("SIMPLE_RADIAL")
    bearings, valid = bearings_of_keypoints(camera, np.zeros((0, 2)))
    assert bearings.shape == (0, 3)
    assert valid.shape == (0,)
    bearings, valid = bearings_of_keypoints(camera, np.array([[np.nan, 1.0], [512.0, 384.0]]))
    assert valid.tolist() == [False, True]
    assert np.allclose(bearings, [0.0, 0.0, 1.0])


@pytest.mark.parametrize("model", [name for name in MODELS if "FISHEYE" not in name and name not in ("FOV", "EUCM")])
@pytest.mark.parametrize("scale", [0.7, 1.4])
def test_another_focal_length_keeps_the_distortion_seen_in_the_image(model: str, scale: float) -> None:
    """With focal s f the ray (x / s, y / s, 1) falls where (x, y, 1) fell with f."""
    camera = camera_of(model)
    scaled = with_focal_scale(camera, scale)
    rays = rays_up_to(35.0, 200, seed=3)
    rays /= rays[:, 2:]
    flatter = rays * [1 / scale, 1 / scale, 1.0]
    assert np.allclose(scaled.img_from_cam(flatter), camera.img_from_cam(rays), atol=1e-7)
    assert scaled.mean_focal_length() == pytest.approx(scale * camera.mean_focal_length(), rel=1e-12)
    assert np.allclose(camera.params, MODELS[model], atol=0.0)


def test_a_factor_of_one_changes_no_bit() -> None:
    for model in MODELS:
        assert np.array_equal(with_focal_scale(camera_of(model), 1.0).params, MODELS[model])
    K = calibration_matrix(camera_of("PINHOLE"), 2.0)
    assert K.tolist() == [[1600.0, 0.0, 512.0], [0.0, 1560.0, 384.0], [0.0, 0.0, 1.0]]
