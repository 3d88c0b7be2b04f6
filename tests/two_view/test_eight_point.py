"""Matrices from matches alone: exact on exact data, robust, unaffected by coordinates, near optimal under noise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matched_rays import matched_rays

from colmap_vg.geometry import so3
from colmap_vg.two_view.eight_point import (
    estimate_essential_from_inliers,
    estimate_fundamental_from_inliers,
    weighted_moments,
)
from colmap_vg.two_view.essential import essential_from_pose, poses_from_essential
from colmap_vg.two_view.pieces import Pieces


def test_moments_are_the_outer_products_of_the_constraint_rows():
    data, weights = matched_rays(0, [9, 40]), np.random.default_rng(0).random(49)
    rows = np.einsum("ki,kj->kij", data.bearings2, data.bearings1).reshape(49, 9)
    pieces = Pieces.cut(data.offsets, [*data.bearings1.T, *data.bearings2.T])
    padded = Pieces.cut(data.offsets, [weights]).columns[:, 0]
    found = weighted_moments(pieces, padded)
    np.testing.assert_allclose(found[0], rows[:9].T @ (weights[:9, None] * rows[:9]), atol=1e-12)
    np.testing.assert_allclose(found[1], rows[9:].T @ (weights[9:, None] * rows[9:]), atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000))
def test_exact_matches_give_exact_matrices(seed):
    data = matched_rays(seed, [30, 4, 50])
    E = estimate_essential_from_inliers(data.offsets, data.bearings1, data.bearings2)
    truth = essential_from_pose(data.rotations, data.directions)
    assert np.isnan(E[1]).all()
    for k in (0, 2):
        assert min(np.abs(E[k] - truth[k]).max(), np.abs(E[k] + truth[k]).max()) < 1e-7
    kept = estimate_essential_from_inliers(data.offsets, data.bearings1, data.bearings2, truth)
    np.testing.assert_array_equal(kept[1], truth[1])


def _turned(E, data):
    poses = poses_from_essential(E, data.offsets, data.bearings1, data.bearings2)
    return so3.angle(poses.rotations @ np.swapaxes(data.rotations, 1, 2))


def test_few_outliers_do_not_pull_and_from_a_start_many_do_not():
    few = matched_rays(1, [300] * 40, sigma=5e-4, outlier_share=0.05)
    rays = (few.offsets, few.bearings1, few.bearings2)
    robust = _turned(estimate_essential_from_inliers(*rays), few)
    plain = _turned(estimate_essential_from_inliers(*rays, num_iterations=1), few)
    assert np.quantile(robust, 0.9) < 3e-3
    assert np.median(plain) > 10 * np.median(robust)
    many = matched_rays(1, [300] * 40, sigma=5e-4, outlier_share=0.15)
    start = essential_from_pose(many.rotations, many.directions)
    started = _turned(estimate_essential_from_inliers(many.offsets, many.bearings1, many.bearings2, start), many)
    assert np.quantile(started, 0.9) < 3e-3


@pytest.mark.parametrize("focal", [300.0, 3000.0])
def test_fundamental_matrices_agree_with_the_pose_in_any_pixel_frame(focal):
    data = matched_rays(2, [60, 200, 3])
    K = np.array([[focal, 0, 1500.0], [0, focal, 900.0], [0, 0, 1.0]])
    points = [(x @ K.T)[:, :2] / x[:, 2:] for x in (data.bearings1, data.bearings2)]
    F = estimate_fundamental_from_inliers(data.offsets, *points)
    E = K.T @ F[:2] @ K
    E = E / np.linalg.norm(E, axis=(1, 2), keepdims=True) * np.sqrt(2)
    truth = essential_from_pose(data.rotations, data.directions)[:2]
    assert np.minimum(np.abs(E - truth).max(axis=(1, 2)), np.abs(E + truth).max(axis=(1, 2))).max() < 1e-5
    np.testing.assert_allclose(np.linalg.det(F[:2]), 0.0, atol=1e-15)
    assert np.isnan(F[2]).all()


def test_keypoints_at_one_place_end_in_finite_matrices():
    points = np.zeros((20, 2))
    F = estimate_fundamental_from_inliers(np.array([0, 20]), points, points)
    assert np.isfinite(F).all()
