"""Factorisations: dense or sparse as the fill asks for, with the same solutions."""

import numpy as np
import pytest
import scipy.sparse as sp

from colmap_vg.linear.solvers import _CholeskyFactor, _SuperLUFactor, factorize


def _laplacian(num_nodes, edges):
    ones = np.ones(len(edges))
    links = sp.coo_array((ones, tuple(edges.T)), shape=(num_nodes, num_nodes)).tocsr()
    links = links + links.T
    return sp.csc_array(sp.diags_array(np.asarray(links.sum(axis=1)).ravel() + 1.0) - links)


def _random_edges(num_nodes, degree, seed=0):
    drawn = np.random.default_rng(seed).integers(0, num_nodes, (num_nodes * degree // 2, 2))
    return np.unique(np.sort(drawn[drawn[:, 0] != drawn[:, 1]], axis=1), axis=0)


def _ring_edges(num_nodes, num_neighbors):
    first = np.repeat(np.arange(num_nodes), num_neighbors)
    return np.stack([first, (first + np.tile(np.arange(1, num_neighbors + 1), num_nodes)) % num_nodes], axis=1)


@pytest.mark.parametrize(
    ("edges", "kind"),
    [
        (_random_edges(600, 20), _CholeskyFactor),  # 3 % nonzeros, but the factor fills up
        (_ring_edges(600, 10), _SuperLUFactor),  # as many nonzeros, and little fill in
        (_random_edges(200, 4), _CholeskyFactor),  # tiny
        (_random_edges(600, 90), _CholeskyFactor),  # many nonzeros
    ],
)
def test_the_factor_is_dense_where_that_is_faster(edges, kind):
    n = int(edges.max()) + 1
    matrix = _laplacian(n, edges)
    factor = factorize(matrix)
    assert isinstance(factor, kind)
    b = np.random.default_rng(1).standard_normal((n, 2))
    assert np.abs(matrix @ factor.solve(b) - b).max() < 1e-10


def test_rows_without_entries_are_no_exception():
    matrix = sp.csc_array((400, 400))
    with pytest.raises(Exception, match=r"definite|singular"):
        factorize(matrix)
