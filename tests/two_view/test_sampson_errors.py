"""Sampson errors of rays and of pixels: the distance to the nearest match that fits, and one another."""

import numpy as np
import pytest
from matched_rays import matched_rays

from colmap_vg.two_view.essential import essential_from_pose
from colmap_vg.two_view.pieces import Pieces
from colmap_vg.two_view.sampson_errors import pixel_sampson_errors, sampson_errors, squared_errors_and_variances


def test_sampson_error_is_the_distance_to_the_nearest_pair_that_fits():
    data = matched_rays(3, [40], sigma=1e-3)
    E = essential_from_pose(data.rotations, data.directions)
    errors = sampson_errors(E, data.offsets, data.bearings1, data.bearings2)
    f1, f2 = np.array([900.0]), np.array([400.0])
    in_px = sampson_errors(E, data.offsets, data.bearings1, data.bearings2, f1, f2)
    for k in range(40):
        assert abs(errors[k]) == pytest.approx(_distance(E[0], data.bearings1[k], data.bearings2[k], 1, 1), rel=1e-2)
        assert abs(in_px[k]) == pytest.approx(_distance(E[0], data.bearings1[k], data.bearings2[k], 900, 400), rel=1e-2)


def _distance(E, x1, x2, f1, f2):
    """Newton steps on the constraint in the four tangent coordinates, in pixels."""
    u1, u2 = (np.linalg.svd(x[None])[2][1:].T for x in (x1, x2))
    delta = np.zeros(4)
    for _ in range(20):
        a, b = x1 + u1 @ delta[:2] / f1, x2 + u2 @ delta[2:] / f2
        gradient = np.concatenate([u1.T @ E.T @ b / f1, u2.T @ E @ a / f2])
        delta = gradient * (gradient @ delta - b @ E @ a) / (gradient @ gradient)
    return np.linalg.norm(delta)


def test_pixel_errors_are_the_distance_to_the_nearest_pair_of_points_that_fits():
    data = matched_rays(4, [30], sigma=1e-3)
    E = essential_from_pose(data.rotations, data.directions)
    K = np.array([[900.0, 0.0, 500.0], [0.0, 850.0, 400.0], [0.0, 0.0, 1.0]])
    F = np.linalg.inv(K).T @ E @ np.linalg.inv(K)
    points1, points2 = ((x @ K.T)[:, :2] / x[:, 2:] for x in (data.bearings1, data.bearings2))
    errors = pixel_sampson_errors(7.0 * F, data.offsets, points1, points2)
    for k in range(30):
        assert abs(errors[k]) == pytest.approx(_pixel_distance(F[0], points1[k], points2[k]), rel=2e-2)
    at_epipoles = pixel_sampson_errors(np.zeros((1, 3, 3)), np.array([0, 1]), points1[:1], points2[:1])
    assert not np.isfinite(at_epipoles).any()


def _pixel_distance(F, x1, x2):
    """Newton steps on the constraint in the four pixel coordinates."""
    delta = np.zeros(4)
    for _ in range(20):
        a, b = np.append(x1 + delta[:2], 1.0), np.append(x2 + delta[2:], 1.0)
        gradient = np.concatenate([(F.T @ b)[:2], (F @ a)[:2]])
        delta = gradient * (gradient @ delta - b @ F @ a) / (gradient @ gradient)
    return np.linalg.norm(delta)


def test_squared_errors_over_variances_are_those_of_single_matches():
    data = matched_rays(5, [30, 70], sigma=1e-2)
    E = essential_from_pose(data.rotations, data.directions)
    rays = data.bearings1, data.bearings2
    points = [x[:, :2] / x[:, 2:] for x in rays]
    flat = [np.column_stack([x, np.ones(len(x))]) for x in points]
    for (x1, x2), on_sphere, expected in (
        (rays, True, sampson_errors(E, data.offsets, *rays)),
        (flat, False, pixel_sampson_errors(E, data.offsets, *points)),
    ):
        pieces = Pieces.cut(data.offsets, [*x1.T, *x2.T])
        squared, variance = (pieces.rows(a) for a in squared_errors_and_variances(E, pieces, on_sphere=on_sphere))
        np.testing.assert_allclose(squared / variance, expected**2, rtol=1e-6)
