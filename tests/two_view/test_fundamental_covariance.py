"""Covariances of fundamental matrices against repeated experiments."""

import numpy as np
import pytest
from matched_rays import matched_rays

from colmap_vg.two_view.eight_point import cofactors, estimate_fundamental_from_inliers
from colmap_vg.two_view.fundamental_covariance import fundamental_covariances


def test_cofactors_are_the_derivative_of_the_determinant():
    M = np.random.default_rng(0).standard_normal((4, 3, 3))
    step = 1e-6
    for i in range(3):
        for j in range(3):
            moved = M.copy()
            moved[:, i, j] += step
            slope = (np.linalg.det(moved) - np.linalg.det(M)) / step
            np.testing.assert_allclose(slope, cofactors(M)[:, i, j], atol=1e-5)


def _draws(draws, matches, sigma_px):
    truth = matched_rays(8, [matches])
    K = np.array([[1000.0, 0, 700], [0, 1000, 500], [0, 0, 1]])
    rng = np.random.default_rng(0)
    exact = [(x @ K.T)[:, :2] / x[:, 2:] for x in (truth.bearings1, truth.bearings2)]
    noisy = [np.tile(p, (draws, 1)) + sigma_px * rng.standard_normal((draws * matches, 2)) for p in exact]
    return matches * np.arange(draws + 1), *noisy


def test_covariance_is_that_of_three_hundred_draws():
    offsets, points1, points2 = _draws(300, 150, 0.5)
    F = estimate_fundamental_from_inliers(offsets, points1, points2)
    found = fundamental_covariances(offsets, points1, points2, F)
    scale = np.outer([1000.0, 1000, 1], [1000.0, 1000, 1]).ravel()
    flat = F.reshape(-1, 9) * scale
    # F may be scaled at will: compare at the norm that the covariance fixes, that of pixels over the image size.
    size = max(np.abs(points1).max(), np.abs(points2).max())
    gauge = np.outer([size, size, 1], [size, size, 1]).ravel()
    sign = np.sign(np.einsum("ki,i->k", F.reshape(-1, 9) * gauge, F[0].ravel() * gauge))
    norm = np.linalg.norm(F.reshape(-1, 9) * gauge, axis=1)
    flat = flat * (sign / norm)[:, None]
    predicted = found.covariances * scale[:, None] * scale / np.square(norm)[:, None, None]
    measured = np.cov(flat.T)
    assert np.trace(np.median(predicted, axis=0)) == pytest.approx(np.trace(measured), rel=0.3)
    deviations = np.sqrt(np.diag(np.median(predicted, axis=0)) / np.diag(measured))
    assert deviations.min() > 0.7
    assert deviations.max() < 1.4
    assert np.median(found.sigmas_px) == pytest.approx(0.5, rel=0.1)
    assert np.linalg.matrix_rank(predicted[0], tol=1e-8 * np.trace(predicted[0])) <= 7


def test_matches_beyond_the_effective_number_add_nothing():
    offsets, points1, points2 = _draws(3, 150, 0.5)
    F = estimate_fundamental_from_inliers(offsets, points1, points2)
    full = fundamental_covariances(offsets, points1, points2, F).covariances
    capped = fundamental_covariances(offsets, points1, points2, F, max_effective_matches=50).covariances
    np.testing.assert_allclose(capped, 3.0 * full, rtol=1e-6, atol=1e-9 * np.abs(full).max())


def test_matches_without_noise_are_not_taken_for_exact():
    # What the lens model leaves out is then all that is wrong, and votes for focal lengths would be sure of it.
    offsets, points1, points2 = _draws(2, 150, 0.0)
    F = estimate_fundamental_from_inliers(offsets, points1, points2)
    assert fundamental_covariances(offsets, points1, points2, F).sigmas_px == pytest.approx(0.15)
