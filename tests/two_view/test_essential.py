"""Poses from essential matrices: right, chosen by cheirality, and as pycolmap's on real databases."""

import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matched_rays import matched_rays

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import angle_between
from colmap_vg.two_view.essential import (
    essential_from_fundamental,
    essential_from_pose,
    in_front_of_both,
    nearest_essential,
    poses_from_essential,
)


@given(seed=st.integers(0, 10_000), scale=st.sampled_from([1.0, -1.0, 1e-4, -37.0]))
def test_poses_come_back_from_essential_matrices_of_any_scale_and_sign(seed, scale):
    data = matched_rays(seed, [30, 0, 12])
    E = scale * essential_from_pose(data.rotations, data.directions)
    poses = poses_from_essential(E, data.offsets, data.bearings1, data.bearings2)
    for k in (0, 2):
        np.testing.assert_allclose(poses.rotations[k], data.rotations[k], atol=1e-8)
        np.testing.assert_allclose(poses.directions[k], data.directions[k], atol=1e-8)
    assert poses.num_in_front.tolist() == [30, 0, 12]
    assert poses.share_in_front.tolist() == [1.0, 0.0, 1.0]
    turned = data.bearings1[:30] @ data.rotations[0].T
    expected = np.median(np.arccos(np.clip(np.sum(turned * data.bearings2[:30], axis=1), -1, 1)))
    assert poses.median_angles[0] == pytest.approx(expected, abs=1e-6)


def test_essential_matrix_is_the_cross_product_form_and_fundamental_matrices_go_back_to_it():
    data = matched_rays(1, [20] * 5)
    E = essential_from_pose(data.rotations, data.directions)
    t = -np.einsum("mij,mj->mi", data.rotations, data.directions)
    np.testing.assert_allclose(E, so3.hat(t) @ data.rotations, atol=1e-12)
    K1, K2 = np.diag([800.0, 810, 1]), np.diag([700.0, 690, 1])
    K1[:2, 2], K2[:2, 2] = [320, 240], [300, 200]
    F = np.linalg.inv(K2).T @ E @ np.linalg.inv(K1)
    np.testing.assert_allclose(essential_from_fundamental(F, K1, K2), E / np.sqrt(2), atol=1e-12)
    np.testing.assert_allclose(nearest_essential(3.0 * E), E, atol=1e-12)


def test_rays_in_front_agree_with_least_squares_depths():
    data = matched_rays(2, [200], sigma=0.3)
    R, d = data.rotations, data.directions
    found = in_front_of_both(R, d, data.offsets, data.bearings1, data.bearings2)
    for x1, x2, said in zip(data.bearings1, data.bearings2, found, strict=True):
        depths = np.linalg.lstsq(np.stack([R[0] @ x1, -x2], axis=1), R[0] @ d[0], rcond=None)[0]
        assert said == (depths > 0).all()
    assert 0 < found.sum() < 200


@pytest.mark.real_data
@pytest.mark.parametrize("name", ["fountain-p11", "temple"])
def test_poses_of_a_real_database_are_pycolmaps(data_folder, tmp_path, name):
    pycolmap = pytest.importorskip("pycolmap")
    path = tmp_path / "copy.db"
    shutil.copyfile(data_folder / "images" / name / "database.db", path)
    path.chmod(0o600)
    E, rays1, rays2, rotations, directions, angles = [], [], [], [], [], []
    with pycolmap.Database.open(path) as database:
        cameras = {c.camera_id: c for c in database.read_all_cameras()}
        images = {i.image_id: cameras[i.camera_id] for i in database.read_all_images()}
        points = {i: database.read_keypoints(i)[:, :2].astype(np.float64) for i in images}
        ids, geometries = database.read_two_view_geometries()
        for pair, g in zip(ids, geometries, strict=True):
            i, j = pycolmap.pair_id_to_image_pair(pair)
            if g.config != pycolmap.TwoViewGeometryConfiguration.CALIBRATED or len(g.inlier_matches) < 30:
                continue
            if not pycolmap.estimate_two_view_geometry_pose(images[i], points[i], images[j], points[j], g):
                continue
            E.append(g.E)
            for into, image, column in ((rays1, i, 0), (rays2, j, 1)):
                u = images[image].cam_from_img(points[image][g.inlier_matches[:, column]])
                rays = np.concatenate([u, np.ones((len(u), 1))], axis=1)
                into.append(rays / np.linalg.norm(rays, axis=1, keepdims=True))
            R = g.cam2_from_cam1.rotation.matrix()
            rotations.append(R)
            directions.append(-R.T @ g.cam2_from_cam1.translation)
            angles.append(g.tri_angle)
    offsets = np.concatenate([[0], np.cumsum([len(r) for r in rays1])])
    poses = poses_from_essential(np.array(E), offsets, np.concatenate(rays1), np.concatenate(rays2))
    assert len(E) >= 20
    turned = so3.angle(poses.rotations @ np.swapaxes(np.array(rotations), 1, 2))
    swung = angle_between(poses.directions, np.array(directions))
    assert np.quantile(turned, 0.98) < 1e-6
    assert np.quantile(swung, 0.98) < 1e-6
    assert np.median(np.abs(poses.median_angles - np.array(angles))) < np.deg2rad(0.1)
