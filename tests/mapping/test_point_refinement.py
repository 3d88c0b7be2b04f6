"""Points with the cameras standing still: the minimum that scipy finds, outliers, and points that nothing improves."""

import numpy as np
from scipy.optimize import least_squares

from colmap_vg.geometry.directions import normalized
from colmap_vg.mapping.point_refinement import refine_points

FOCAL = 900.0


def scene(seed, *, num_points=30, num_views=4, sigma_px=0.5):
    rng = np.random.default_rng(seed)
    X = rng.uniform([-1, -1, 5], [1, 1, 7], (num_points, 3))
    point_row = np.repeat(np.arange(num_points), num_views)
    centers = rng.normal(0, 0.5, (len(point_row), 3))
    noise = sigma_px / FOCAL * rng.standard_normal((len(point_row), 3))
    return X, point_row, normalized(normalized(X[point_row] - centers) + noise), centers


def angular_residuals(x, rays, centers):
    """Components across the ray of the unit vector to x, in pixels: three with a rank of two, and the same norm."""
    toward = normalized(x - centers)
    return FOCAL * (toward - np.sum(toward * rays, axis=1, keepdims=True) * rays)


def test_points_end_at_the_robust_minimum():
    X, point_row, rays, centers = scene(0)
    start = X + 0.05 * np.random.default_rng(1).standard_normal(X.shape)
    found = refine_points(start, point_row, rays, centers, np.full(len(rays), FOCAL), scale_px=2.0, num_iterations=20)
    for k, x in enumerate(found):
        own = point_row == k

        def cost(y, own=own):
            return np.sqrt(np.log1p(np.sum(angular_residuals(y, rays[own], centers[own]) ** 2, axis=1) / 4.0))

        expected = least_squares(cost, X[k], xtol=1e-14, ftol=1e-14, gtol=1e-14).x
        np.testing.assert_allclose(x, expected, atol=2e-4)


def test_exact_rays_give_exact_points_and_a_false_one_does_not_pull():
    X, point_row, rays, centers = scene(2, num_views=6, sigma_px=0.0)
    rays[::6] = normalized(rays[::6] + np.array([0.05, 0.0, 0.0]))
    start = X + 0.01 * np.random.default_rng(3).standard_normal(X.shape)
    found = refine_points(start, point_row, rays, centers, np.full(len(rays), FOCAL), num_iterations=30)
    assert np.linalg.norm(found - X, axis=1).max() < 2e-3


def test_points_behind_their_cameras_and_without_parallax_stay_finite():
    rays = np.tile([0.0, 0.0, 1.0], (4, 1))
    positions = np.array([[0.0, 0.0, -5.0], [0.01, 0.0, 5.0]])
    found = refine_points(positions, np.array([0, 0, 1, 1]), rays, np.zeros((4, 3)), np.full(4, FOCAL))
    np.testing.assert_array_equal(found[0], positions[0])
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[1, :2], 0.0, atol=1e-4)
