"""Graph matrices against dense sums over edges, one at a time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from colmap_vg.linear.assembly import BlockPattern, sum_at_nodes


def _edges(num_nodes, num_edges, rng):
    first = rng.integers(0, num_nodes, num_edges)
    return np.stack([first, (first + rng.integers(1, num_nodes, num_edges)) % num_nodes], axis=1)


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 8), st.integers(0, 20), st.integers(1, 6), st.integers(0, 10_000))
def test_block_systems(num_nodes, num_edges, b, seed):
    rng = np.random.default_rng(seed)
    edges = _edges(num_nodes, num_edges, rng)  # with parallel and reversed ones
    ii, jj, ij = rng.standard_normal((3, num_edges, b, b))
    ii, jj = ii + np.swapaxes(ii, 1, 2), jj + np.swapaxes(jj, 1, 2)
    diagonal = np.tile(np.eye(b), (num_nodes, 1, 1)) * rng.random((num_nodes, 1, 1))
    expected = np.zeros((num_nodes * b, num_nodes * b))
    for k in range(num_nodes):
        expected[k * b : k * b + b, k * b : k * b + b] += diagonal[k]
    for (i, j), A, B, C in zip(edges, ii, jj, ij, strict=True):
        expected[i * b : i * b + b, i * b : i * b + b] += A
        expected[j * b : j * b + b, j * b : j * b + b] += B
        expected[i * b : i * b + b, j * b : j * b + b] += C
        expected[j * b : j * b + b, i * b : i * b + b] += C.T
    pattern = BlockPattern(num_nodes, edges, b)
    found = pattern.assemble(ii, jj, ij, diagonal)
    assert np.allclose(found.toarray(), expected, atol=1e-12)
    assert found.has_sorted_indices
    assert found.has_canonical_format
    # A second assembly on the same pattern does not see the first.
    assert np.allclose(pattern.assemble(2 * ii, 2 * jj, 2 * ij, 2 * diagonal).toarray(), 2 * expected, atol=1e-12)


@pytest.mark.parametrize("shape", [(), (3,), (2, 4), (3, 3)])
@pytest.mark.parametrize("num", [0, 17])
def test_sums_at_nodes(shape, num):
    rng = np.random.default_rng(0)
    nodes, values = rng.integers(0, 5, num), rng.standard_normal((num, *shape))
    expected = np.zeros((6, *shape))
    for node, value in zip(nodes, values, strict=True):
        expected[node] += value
    assert np.allclose(sum_at_nodes(6, nodes, values), expected)
