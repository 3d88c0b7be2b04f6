"""Factors, reweighted Laplacians and eigenvalues against numpy's dense algebra, on all paths."""

import numpy as np
import pytest
import scipy.sparse as sp
from graph_matrices import laplacian

from colmap_vg.linear import eigen
from colmap_vg.linear import laplacian as module
from colmap_vg.linear.eigen import smallest_eigenpairs
from colmap_vg.linear.laplacian import LaplacianSystem, ReweightedLaplacian, conjugate_gradients
from colmap_vg.linear.solvers import SingularMatrixError, factorize


def _ring(num_nodes, rng, reach=3):
    nodes = np.arange(num_nodes)
    edges = np.concatenate([np.stack([nodes, (nodes + k) % num_nodes], axis=1) for k in range(1, reach + 1)])
    return edges, rng.uniform(0.1, 2.0, len(edges))


def _definite(num_nodes, rng):
    edges, weights = _ring(num_nodes, rng)
    return sp.csc_array(laplacian(num_nodes, edges, weights) + 0.1 * sp.eye_array(num_nodes))


@pytest.mark.parametrize("n", [20, 2000])  # below and above the dense limit
@pytest.mark.parametrize("check_definite", [False, True])
def test_solutions(n, check_definite):
    rng = np.random.default_rng(0)
    A = _definite(n, rng)
    b = rng.standard_normal((n, 4))
    factor = factorize(A, check_definite=check_definite)
    assert np.allclose(A @ factor.solve(b), b, atol=1e-11)
    assert np.allclose(factor.solve(b[:, 0]), factor.solve(b)[:, 0], atol=1e-12)


def test_indefinite_and_singular_matrices_are_told():
    rng = np.random.default_rng(0)
    for n in (20, 2000):
        A = sp.csc_array(_definite(n, rng) - 0.3 * sp.eye_array(n))
        with pytest.raises(SingularMatrixError):
            factorize(A, check_definite=True)
    with pytest.raises(SingularMatrixError):
        factorize(sp.csc_array((2000, 2000)))


@pytest.mark.parametrize("n", [30, 900])
def test_laplacian_system(n):
    rng = np.random.default_rng(2)
    edges, _ = _ring(n, rng)
    edges = np.concatenate([edges, edges[:7, ::-1]])
    system, x = LaplacianSystem(n, edges), rng.standard_normal((n, 3))
    x -= x.mean(axis=0)
    for _ in range(2):
        weights = rng.uniform(0.1, 2.0, len(edges))
        b = system.right_side(weights, x[edges[:, 1]] - x[edges[:, 0]])
        assert np.allclose(b, laplacian(n, edges, weights) @ x, atol=1e-12)
        found = system.factor(weights).solve(b)
        assert np.allclose(found - found.mean(axis=0), x, atol=1e-6)


@pytest.mark.parametrize("n", [30, 900])
def test_reweighted_laplacian(n, monkeypatch):
    rng = np.random.default_rng(1)
    edges, weights = _ring(n, rng)
    edges = np.concatenate([edges, edges[:7, ::-1]])  # parallel ones
    weights = rng.uniform(0.1, 2.0, len(edges))
    system = ReweightedLaplacian(n, edges, max_cg_iterations=40)
    factored = []
    monkeypatch.setattr(module, "factorize", lambda A, **how: factored.append(1) or factorize(A, **how))
    for change in (0.0, 0.1, 0.1, 3.0):
        weights = weights * np.exp(change * rng.standard_normal(len(edges)))
        L = laplacian(n, edges, weights)
        assert np.allclose(system.matrix(weights).toarray(), L.toarray())
        flow = rng.standard_normal((3, len(edges)))
        b = system.divergence(flow)
        expected_b = np.zeros((n, 3))
        np.add.at(expected_b, edges[:, 1], flow.T)
        np.subtract.at(expected_b, edges[:, 0], flow.T)
        assert np.allclose(b, expected_b)
        x = system.solve(weights, b, relative_tolerance=1e-10)
        expected = np.linalg.lstsq(L.toarray(), b, rcond=None)[0]
        assert np.allclose(x, expected, atol=1e-7 * np.abs(expected).max())
    # Small changes do not cost a factor where that is slower than conjugate gradients.
    assert len(factored) == 4 if n == 30 else 1 <= len(factored) <= 2


def test_conjugate_gradients_turn_with_the_right_hand_side():
    rng = np.random.default_rng(2)
    A, near = _definite(200, rng), factorize(_definite(200, rng))
    b, Q = rng.standard_normal((200, 3)), np.linalg.qr(rng.standard_normal((3, 3)))[0]
    x = conjugate_gradients(A, b, near, 1e-3, 100)
    assert 1e-6 < np.linalg.norm(A @ x - b) / np.linalg.norm(b) <= 1e-3
    assert np.allclose(conjugate_gradients(A, b @ Q, near, 1e-3, 100), x @ Q, atol=1e-10)
    assert conjugate_gradients(A, b, near, 1e-12, 1) is None
    assert np.array_equal(conjugate_gradients(A, 0 * b, near, 1e-3, 1), 0 * b)


def test_conjugate_gradients_end_in_as_many_steps_as_there_are_eigenvalues():
    rng = np.random.default_rng(5)
    basis = np.linalg.qr(rng.standard_normal((60, 60)))[0]
    A = sp.csc_array(basis @ np.diag(np.repeat([1.0, 3.0, 10.0, 30.0], 15)) @ basis.T)
    b = rng.standard_normal((60, 1))
    plain = factorize(sp.csc_array(sp.eye_array(60)))
    x = conjugate_gradients(A, b, plain, 1e-9, 4)
    assert x is not None
    assert np.allclose(A @ x, b, atol=1e-7)
    assert conjugate_gradients(A, b, plain, 1e-9, 3) is None


@pytest.mark.parametrize("path", ["all", "shifted", "lanczos"])
@pytest.mark.parametrize("below", [0.0, 0.5, 20.0])
def test_smallest_eigenpairs(path, below, monkeypatch):
    """Also where eigenvalues lie far below the bound that was thought."""
    rng = np.random.default_rng(3)
    n = 60 if path == "all" else 700
    edges, weights = _ring(n, rng, reach=20)
    A = sp.csc_array(laplacian(n, edges, weights) - sp.diags_array(below * (rng.random(n) < 0.1)))
    if path == "lanczos":
        monkeypatch.setattr(eigen, "FACTOR_LIMIT", 10)
        monkeypatch.setattr(eigen, "DENSE_ROW", 10)
    values, vectors = smallest_eigenpairs(A, 3)
    expected = np.linalg.eigvalsh(A.toarray())
    scale = np.abs(expected).max()
    assert np.allclose(values, expected[:3], atol=1e-9 * scale)
    assert np.allclose(A @ vectors, values * vectors, atol=1e-7 * scale)
    assert np.allclose(vectors.T @ vectors, np.eye(3), atol=1e-9)
