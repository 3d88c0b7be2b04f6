"""Pieces of segments against plain loops."""

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from colmap_vg.geometry.directions import normalized
from colmap_vg.two_view import pieces as module
from colmap_vg.two_view.pieces import Pieces, rescaled_rays

COUNTS = st.lists(st.one_of(st.integers(0, 3), st.integers(0, 700)), min_size=1, max_size=12)


@given(counts=COUNTS, seed=st.integers(0, 100), per_block=st.sampled_from([8, 200, 5000]))
def test_pieces_hold_every_row_once_in_order(counts, seed, per_block):
    rng = np.random.default_rng(seed)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    rows = rng.standard_normal((3, offsets[-1]))
    pieces = Pieces.cut(offsets, list(rows))
    np.testing.assert_array_equal(pieces.offsets, offsets)
    for place in range(3):
        np.testing.assert_array_equal(pieces.rows(pieces.columns[:, place]), rows[place])
    assert np.count_nonzero(pieces.columns) == 3 * offsets[-1]
    assert pieces.columns.shape[2] in module._LENGTHS
    chosen = np.flatnonzero(rng.random(len(counts)) > 0.5)
    some = pieces.of(chosen)
    np.testing.assert_array_equal(np.diff(some.offsets), np.asarray(counts)[chosen])
    parts = [rows[0, a:b] for a, b in itertools.pairwise(offsets)]
    np.testing.assert_array_equal(some.rows(some.columns[:, 0]), np.concatenate([[], *(parts[k] for k in chosen)]))
    before, module.ROWS_PER_BLOCK = module.ROWS_PER_BLOCK, per_block
    try:
        blocks = list(pieces.blocks())
    finally:
        module.ROWS_PER_BLOCK = before
    sums, met = np.zeros(len(counts)), np.zeros(len(counts), dtype=int)
    for block in blocks:
        met[block.segments] += 1
        sums[block.segments] = block.totals(pieces.columns[block.pieces, 0].sum(axis=1))
        np.testing.assert_array_equal(
            pieces.rows(pieces.columns[block.pieces, 1], block),
            rows[1, offsets[block.segments.start] : offsets[block.segments.stop]],
        )
    assert (met == 1).all()
    np.testing.assert_allclose(sums, [part.sum() for part in parts], atol=1e-12)


def test_padding_is_bounded_for_short_and_long_segments():
    for count in (10, 20, 50, 100, 1000):
        counts = np.full(2000 // count + 1, count)
        offsets = np.concatenate([[0], np.cumsum(counts)])
        pieces = Pieces.cut(offsets, [np.ones(offsets[-1])])
        assert pieces.columns.size <= 1.65 * offsets[-1]


def test_longer_focal_lengths_draw_rays_to_the_axis_and_leave_padding_alone():
    rng = np.random.default_rng(0)
    rays = normalized(rng.standard_normal((4, 5, 3)))
    rays[2, 3:] = 0.0
    factors = np.array([1.0, 0.5, 2.0, 0.9])
    found = rescaled_rays(np.swapaxes(rays, 1, 2), factors)
    expected = rays * np.stack([factors, factors, np.ones(4)], axis=1)[:, None]
    length = np.linalg.norm(expected, axis=2, keepdims=True)
    expected = np.divide(expected, length, out=np.zeros_like(expected), where=length > 0)
    np.testing.assert_allclose(np.swapaxes(found, 1, 2), expected, atol=1e-15)
