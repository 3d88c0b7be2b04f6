"""Unit vectors: lengths, angles accurate at both ends, bases without a singular direction."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from colmap_vg.geometry.directions import angle_between, norm_of_cross, normalized, tangent_basis

UNIT = hnp.arrays(np.float64, (3,), elements=st.floats(-1.0, 1.0)).filter(lambda v: np.linalg.norm(v) > 1e-3)


def test_zero_stays_zero():
    v = normalized(np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0]]))
    assert np.allclose(v, [[0.0, 0.0, 0.0], [0.6, 0.0, 0.8]])


@given(UNIT)
def test_tangent_basis_is_orthonormal(v):
    u = normalized(v)
    B = np.concatenate([tangent_basis(u), u[:, None]], axis=1)
    assert np.allclose(B.T @ B, np.eye(3), atol=1e-14)


def test_tangent_basis_at_the_poles():
    poles = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, -0.0], [1e-20, 0.0, -1.0]])
    poles[2] = [1.0, 0.0, -0.0]
    B = tangent_basis(poles)
    assert np.allclose(np.einsum("nai,naj->nij", B, B), np.eye(2), atol=1e-14)
    assert np.allclose(np.einsum("nai,na->ni", B, poles), 0.0, atol=1e-14)


def test_angles_of_any_vectors_follow_from_their_cosines():
    u, v = np.random.default_rng(0).standard_normal((2, 50, 3))
    cosine = np.sum(u * v, axis=1) / (np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1))
    np.testing.assert_allclose(angle_between(u, v), np.arccos(cosine), rtol=1e-9)
    np.testing.assert_allclose(norm_of_cross(u, v), np.linalg.norm(np.cross(u, v), axis=1), rtol=1e-12)


def test_angles_are_exact_near_zero_and_pi():
    turn = np.array([0.0, 1e-14, 1e-9, 1e-4, 1.0, np.pi / 2, np.pi - 1e-9, np.pi])
    u = np.tile([1.0, 0.0, 0.0], (len(turn), 1))
    v = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    assert np.allclose(angle_between(u, 5.0 * v), turn, rtol=1e-6, atol=1e-16)
