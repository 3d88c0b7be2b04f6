"""Alignment of positions: exact recovery, scipy's minimiser as the judge of optimality, degenerate sets."""

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_vg.errors import GraphError
from colmap_vg.geometry import so3
from colmap_vg.geometry.similarity import Similarity, align_positions


@settings(max_examples=40, deadline=None)
@given(st.integers(3, 30), st.integers(0, 10_000))
def test_a_similarity_is_recovered(num, seed):
    rng = np.random.default_rng(seed)
    p = rng.standard_normal((num, 3))
    true = Similarity(rng.uniform(0.01, 100.0), so3.random(1, rng)[0], 10.0 * rng.standard_normal(3))
    errors, found = align_positions(p, true.apply(p))
    assert errors.max() < 1e-10 * true.scale * 10
    assert found.scale == pytest.approx(true.scale)
    assert np.allclose(found.rotation, true.rotation, atol=1e-6)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_no_similarity_fits_better(mirror):
    """Also for a mirrored set, where the plain SVD would return a reflection."""
    rng = np.random.default_rng(3)
    p = rng.standard_normal((12, 3))
    q = p * np.array([1.0, 1.0, mirror]) + 0.1 * rng.standard_normal((12, 3))
    errors, found = align_positions(p, q)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)

    def cost(x):
        return np.sum((np.exp(x[0]) * p @ (so3.exp(x[1:4]) @ found.rotation).T + x[4:] - q) ** 2)

    start = np.concatenate([[np.log(found.scale)], np.zeros(3), found.translation])
    assert cost(start) == pytest.approx(np.sum(errors**2))
    best = min(scipy.optimize.minimize(cost, start + rng.normal(0, s, 7), tol=1e-12).fun for s in (0.01, 1.0, 2.0, 3.0))
    assert np.sum(errors**2) <= best * (1 + 1e-9)


def test_planar_line_and_single_points_align():
    rng = np.random.default_rng(0)
    for flat in ([1.0, 1.0, 0.0], [1.0, 0.0, 0.0]):
        p = rng.standard_normal((10, 3)) * flat
        true = Similarity(2.0, so3.random(1, rng)[0], np.ones(3))
        errors, found = align_positions(p, true.apply(p))
        assert errors.max() < 1e-12
        assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    errors, found = align_positions(np.ones((1, 3)), np.zeros((1, 3)))
    assert errors[0] == 0.0
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_malformed_input_is_refused():
    good = np.zeros((4, 3))
    for a, b in ((good, good[:3]), (good[:0], good[:0]), (good[:, :2], good[:, :2]), (good.ravel(), good.ravel())):
        with pytest.raises(GraphError, match="needs two"):
            align_positions(a, b)
    with pytest.raises(GraphError, match="NaN"):
        align_positions(np.full((4, 3), np.nan), good)
