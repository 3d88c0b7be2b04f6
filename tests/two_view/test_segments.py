"""Sums, quantiles and selections of segments against loops."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from colmap_vg.two_view import segments
from colmap_vg.two_view.segments import rows_of_segments, segment_quantiles, segment_subset, segment_sums

COUNTS = st.lists(st.integers(0, 6), min_size=1, max_size=8)


@given(counts=COUNTS, quantile=st.sampled_from([0.0, 0.25, 0.5, 1.0]), seed=st.integers(0, 100))
def test_segments_are_what_loops_give(counts, quantile, seed):
    rng = np.random.default_rng(seed)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    values, weights = rng.standard_normal((offsets[-1], 2, 3)), rng.random(offsets[-1])
    parts = [slice(a, b) for a, b in itertools.pairwise(offsets)]
    np.testing.assert_allclose(segment_sums(offsets, values), [values[p].sum(axis=0) for p in parts], atol=1e-12)
    weighted = [(weights[p, None, None] * values[p]).sum(axis=0) for p in parts]
    np.testing.assert_allclose(segment_sums(offsets, values, weights), weighted, atol=1e-12)
    expected = [np.quantile(values[p, 0, 0], quantile) if p.stop > p.start else np.nan for p in parts]
    np.testing.assert_allclose(segment_quantiles(offsets, values[:, 0, 0], quantile), expected, atol=1e-12)
    keep = weights > 0.5
    np.testing.assert_array_equal(np.diff(segment_subset(offsets, keep)), [keep[p].sum() for p in parts])
    chosen = np.flatnonzero(rng.random(len(counts)) > 0.5)
    rows, subset = rows_of_segments(offsets, chosen)
    np.testing.assert_array_equal(rows, np.concatenate([np.arange(offsets[-1])[parts[k]] for k in chosen] or [[]]))
    np.testing.assert_array_equal(np.diff(subset), np.diff(offsets)[chosen])


@pytest.mark.parametrize("at_a_time", [1, 3, 128])
def test_products_are_those_of_each_segment(at_a_time: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segments, "SEGMENTS_AT_A_TIME", at_a_time)
    rng = np.random.default_rng(0)
    counts = np.array([0, 3, 1, 0, 0, 7, 2, 0])
    offsets = np.concatenate([[0], np.cumsum(counts)])
    matrices, vectors = rng.normal(size=(8, 2, 3)), rng.normal(size=(13, 3))
    found = segments.products_of_segments(matrices, offsets, vectors)
    expected = [matrices[k] @ vectors[row] for k in range(8) for row in range(offsets[k], offsets[k + 1])]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert segments.products_of_segments(matrices[:0], np.zeros(1, dtype=np.int64), vectors[:0]).shape == (0, 2)


@pytest.mark.parametrize("limit", [1, 3, 5, 7])
def test_thinned_rows_are_at_regular_intervals(limit: int) -> None:
    counts = [0, 1, 5, 12, 3, 30]
    kept = segments.evenly_thinned(np.concatenate([[0], np.cumsum(counts)]), limit)
    most = [min(count, limit) for count in counts]
    expected = [r * k // c != (r - 1) * k // c for c, k in zip(counts, most, strict=True) for r in range(c)]
    assert kept.tolist() == expected
    assert segments.evenly_thinned(np.array([0, 4, 9]), 0).all()
