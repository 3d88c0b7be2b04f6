"""Spreading matches over images: the number kept, coverage of sparse parts, and no say of other pairs."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from colmap_vg.geometry.directions import normalized
from colmap_vg.two_view.spread import CELLS, well_spread


def rays(u):
    return normalized(np.concatenate([u, np.ones((len(u), 1))], axis=1))


@given(counts=st.lists(st.integers(0, 60), min_size=1, max_size=6), limit=st.integers(0, 40), seed=st.integers(0, 50))
def test_each_pair_keeps_its_limit_whatever_the_others_are(counts, limit, seed):
    rng = np.random.default_rng(seed)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    bearings = rays(rng.standard_normal((offsets[-1], 2)))
    kept = well_spread(offsets, bearings, limit)
    for k, count in enumerate(counts):
        rows = slice(offsets[k], offsets[k + 1])
        assert kept[rows].sum() == (count if limit == 0 else min(count, limit))
        np.testing.assert_array_equal(kept[rows], well_spread(np.array([0, count]), bearings[rows], limit))


def test_a_crowd_does_not_take_the_place_of_a_few():
    rng = np.random.default_rng(0)
    crowd = rng.uniform(0.0, 1.0 / CELLS, (2000, 2))
    few = rng.uniform(-1.0, 1.0, (80, 2))
    u = np.concatenate([crowd, few])[rng.permutation(2080)]
    alone = np.abs(u).max(axis=1) > 2.0 / CELLS
    kept = well_spread(np.array([0, 2080]), rays(u), 150)
    assert kept.sum() == 150
    assert kept[alone].all()
