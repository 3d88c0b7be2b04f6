"""Decomposed homographies: the true pose is one of the two, and both explain the plane."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matched_rays import matched_rays

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import angle_between
from colmap_vg.two_view.homography import calibrated_homography, poses_from_homography, pure_rotations


@given(seed=st.integers(0, 10_000), scale=st.sampled_from([1.0, -2.0, 1e-3]))
def test_true_pose_is_one_of_the_two_and_both_reproduce_the_homography(seed, scale):
    data = matched_rays(seed, [40, 60], planar=True)
    H = data.homographies
    found = poses_from_homography(scale * H, data.offsets, data.bearings1, data.bearings2)
    pair = (found.better, found.alternative)
    turned = np.stack([so3.angle(p.rotations @ np.swapaxes(data.rotations, 1, 2)) for p in pair])
    swung = np.stack([angle_between(p.directions, data.directions) for p in pair])
    assert ((turned < 1e-6) & (swung < 1e-6)).any(axis=0).all()
    middle = np.linalg.svd(H, compute_uv=False)[:, 1]
    for pose, normal in zip(pair, found.normals, strict=True):
        t = -np.einsum("mij,mj->mi", pose.rotations, pose.directions) * found.baseline_ratios[:, None]
        np.testing.assert_allclose(
            pose.rotations + t[:, :, None] * normal[:, None, :], H / middle[:, None, None], atol=1e-7
        )
    assert (found.better.num_in_front >= found.alternative.num_in_front).all()
    assert (found.median_errors < 1e-9).all()


def test_decompositions_are_opencvs():
    cv2 = pytest.importorskip("cv2")
    data = matched_rays(5, [40] * 20, planar=True)
    found = poses_from_homography(data.homographies, data.offsets, data.bearings1, data.bearings2)
    for k, H in enumerate(data.homographies):
        _, rotations, _, _ = cv2.decomposeHomographyMat(H, np.eye(3))
        for pose in (found.better, found.alternative):
            assert min(np.abs(pose.rotations[k] - R).max() for R in rotations) < 1e-6


def test_pure_rotation_is_recognised():
    turning = matched_rays(6, [50, 50], baseline=1e-9, sigma=2e-4, outlier_share=0.1)
    moving = matched_rays(6, [50, 50], sigma=2e-4)
    still = pure_rotations(turning.offsets, turning.bearings1, turning.bearings2)
    assert so3.angle(still.rotations @ np.swapaxes(turning.rotations, 1, 2)).max() < 2e-4
    assert (still.median_errors < 6e-4).all()
    assert (pure_rotations(moving.offsets, moving.bearings1, moving.bearings2).median_errors > 0.02).all()
    found = poses_from_homography(turning.rotations, turning.offsets, turning.bearings1, turning.bearings2)
    assert found.baseline_ratios.max() < 1e-6
    np.testing.assert_allclose(found.better.rotations, turning.rotations, atol=1e-6)


def test_pixel_homographies_are_calibrated():
    H, K1, K2 = matched_rays(7, [1]).homographies, np.diag([500.0, 400, 1]), np.diag([300.0, 300, 1])
    K1[0, 2] = 250
    np.testing.assert_allclose(calibrated_homography(K2 @ H @ np.linalg.inv(K1), K1, K2), H, atol=1e-10)
