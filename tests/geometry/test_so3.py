"""Batched rotations against scipy's Rotation, finite differences and group axioms, near 0 and near pi."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from colmap_vg.geometry import so3

ANGLES = [0.0, 1e-12, 1e-9, 1e-7, 9.9e-5, 1.1e-4, 1e-2, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-7, np.pi - 1e-10, np.pi]


def _axes(num, seed=0):
    v = np.random.default_rng(seed).standard_normal((num, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    return np.concatenate([v, np.eye(3), -np.eye(3), [[0.6, 0.8, 0.0], [0.0, -0.6, 0.8]]])


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_and_log_against_scipy(angle):
    w = angle * _axes(50)
    R = so3.exp(w)
    assert np.allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=4e-16 * 4)
    back = so3.log(Rotation.from_rotvec(w).as_matrix())
    assert np.allclose(np.linalg.norm(back, axis=1), angle, rtol=1e-9, atol=1e-15)
    assert np.allclose(so3.exp(back), R, atol=1e-14)
    if angle < np.pi:  # at pi the axis has two signs
        assert np.allclose(back, w, rtol=1e-8, atol=1e-15)
    assert np.allclose(so3.angle(R), angle, rtol=1e-7, atol=3e-15)


def test_small_rotations_keep_their_digits():
    w = 1e-8 * _axes(20)
    assert np.allclose(so3.log(so3.exp(w)), w, rtol=1e-12, atol=1e-22)


def test_exp_has_no_step_where_the_series_ends():
    axis = np.array([0.48, -0.6, 0.64])
    below, above = so3.exp(axis * 0.99999999e-4), so3.exp(axis * 1.00000001e-4)
    slope = (above - below) / (0.00000002e-4)
    assert np.allclose(slope, so3.hat(axis) @ so3.exp(axis * 1e-4), atol=1e-3)
    exact = Rotation.from_rotvec(axis * 0.99999999e-4).as_matrix()
    assert np.abs(below - exact).max() < 3e-16


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_group_axioms(seed):
    rng = np.random.default_rng(seed)
    R, S = so3.random(20, rng), so3.perturbed(np.tile(np.eye(3), (20, 1, 1)), 10.0 ** rng.uniform(-9, 0), rng)
    for Q in (R, S, R @ S):
        assert np.allclose(Q @ np.swapaxes(Q, 1, 2), np.eye(3), atol=1e-14)
        assert np.allclose(np.linalg.det(Q), 1.0)
    assert np.allclose(so3.log(np.swapaxes(R, 1, 2)), -so3.log(R), atol=1e-7)
    # Ad: R exp(w) R^T = exp(R w)
    w = so3.log(S)
    conjugated = R @ S @ np.swapaxes(R, 1, 2)
    assert np.allclose(conjugated, so3.exp(np.einsum("nab,nb->na", R, w)), atol=1e-14)


def test_hat_and_vee():
    rng = np.random.default_rng(0)
    v, w = rng.standard_normal((2, 10, 3))
    assert np.allclose(np.einsum("nab,nb->na", so3.hat(v), w), np.cross(v, w))
    assert np.array_equal(so3.vee(so3.hat(v)), v)
    symmetric = rng.standard_normal((10, 3, 3))
    symmetric = symmetric + np.swapaxes(symmetric, 1, 2)
    assert np.allclose(so3.vee(so3.hat(v) + symmetric), v)
    assert so3.hat(np.zeros((2, 4, 3))).shape == (2, 4, 3, 3)


def test_exp_derivative_at_zero_is_hat():
    w = np.array([0.3, -0.5, 0.9])
    h = 1e-6
    assert np.allclose((so3.exp(h * w) - so3.exp(-h * w)) / (2 * h), so3.hat(w), atol=1e-9)


@pytest.mark.parametrize("angle", ANGLES)
def test_quaternions_against_scipy(angle):
    R = so3.exp(angle * _axes(30))
    q = so3.to_quaternion(R)
    expected = Rotation.from_matrix(R).as_quat()
    assert np.allclose(np.abs(np.einsum("na,na->n", q, expected)), 1.0, atol=1e-14)
    assert (q[:, 3] >= 0).all()
    assert np.allclose(so3.from_quaternion(q), R, atol=1e-14)
    assert np.allclose(so3.from_quaternion(3.0 * q), R, atol=1e-14)


def test_shapes_are_kept():
    R = so3.random(6, np.random.default_rng(0))
    many = R.reshape(2, 3, 3, 3)
    assert np.array_equal(so3.log(many), so3.log(R).reshape(2, 3, 3))
    assert np.array_equal(so3.angle(many), so3.angle(R).reshape(2, 3))
    assert np.array_equal(so3.to_quaternion(R[0]), so3.to_quaternion(R)[0])
    assert so3.log(R[:0]).shape == (0, 3)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_projection_is_the_nearest_rotation(seed):
    rng = np.random.default_rng(seed)
    M = rng.standard_normal((10, 3, 3))
    P = so3.project(M)
    assert np.allclose(np.linalg.det(P), 1.0)
    nearest = np.linalg.norm(M - P, axis=(1, 2))
    for sigma in (1e-3, 0.1, 2.0):
        assert (np.linalg.norm(M - so3.perturbed(P, sigma, rng), axis=(1, 2)) >= nearest - 1e-12).all()
    assert np.allclose(so3.project(P), P, atol=1e-14)
    # Stationary: P^T M is symmetric.
    assert np.allclose(so3.vee(np.swapaxes(P, 1, 2) @ M), 0.0, atol=1e-12)


def test_projection_of_a_singular_matrix_is_a_rotation():
    M = np.stack([np.zeros((3, 3)), np.outer([1.0, 2.0, 3.0], [0.0, 1.0, 0.0]), np.diag([1.0, 1.0, 0.0])])
    P = so3.project(M)
    assert np.allclose(np.linalg.det(P), 1.0)
    assert np.allclose(P @ np.swapaxes(P, 1, 2), np.eye(3))


def test_random_rotations_are_uniform():
    R = so3.random(20_000, np.random.default_rng(0))
    assert np.abs(R.mean(axis=0)).max() < 0.02
    # Haar measure: the angle has density (1 - cos a) / pi, mean pi / 2 + 2 / pi.
    assert so3.angle(R).mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.02)


def test_perturbation_has_the_asked_size():
    R = so3.random(20_000, np.random.default_rng(0))
    w = so3.log(so3.perturbed(R, 0.02, np.random.default_rng(1)) @ np.swapaxes(R, 1, 2))
    assert np.allclose(w.std(axis=0), 0.02, rtol=0.02)
