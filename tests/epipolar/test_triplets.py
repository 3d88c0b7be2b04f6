"""Triplets: against a twin of loops, their limits, and what makes none."""

from itertools import combinations

import numpy as np
import pytest

from colmap_vg.epipolar import triplets as module
from colmap_vg.epipolar.triplets import find_triplets
from colmap_vg.geometry.directions import normalized


def matches(seed, *, num_images=6, num_keypoints=40, share=0.6):
    """Random matches of keypoints with random rays; the rays carry the image and keypoint they belong to."""
    rng = np.random.default_rng(seed)
    rays = normalized(rng.normal([0, 0, 4], 1, (num_images, num_keypoints, 3)))
    edges = np.array([e for e in combinations(range(num_images), 2) if rng.random() < 0.8])
    edges = np.where(rng.random(len(edges))[:, None] < 0.5, edges, edges[:, ::-1])
    chosen = [np.flatnonzero(rng.random(num_keypoints) < share) for _ in edges]
    partners = [rng.permutation(num_keypoints)[: len(rows)] for rows in chosen]
    offsets = np.concatenate([[0], np.cumsum([len(rows) for rows in chosen])])
    first, second = np.concatenate(chosen).astype(np.int32), np.concatenate(partners).astype(np.int32)
    edge = np.repeat(np.arange(len(edges)), np.diff(offsets))
    rays1, rays2 = rays[edges[edge, 0], first], rays[edges[edge, 1], second]
    return edges, offsets, first, second, rays1, rays2, np.tile(np.eye(3), (len(edges), 1, 1))


def twin(edges, offsets, first, second, rays1, rays2, _):
    """Shared keypoints of all pairs of half-edges, by dictionaries: {(edge, edge, middle): [(ray a, ray b, ray c)]}."""
    half = {}
    for e, ends in enumerate(edges):
        for side in (0, 1):
            own, other = ((first, rays1), (second, rays2)) if side == 0 else ((second, rays2), (first, rays1))
            rows = range(offsets[e], offsets[e + 1])
            half[e, int(ends[side])] = {int(own[0][r]): (other[1][r], own[1][r]) for r in rows}
    shared = {}
    for (e, b), (f, c) in combinations(half, 2):
        if b == c and e != f:
            points = sorted(set(half[e, b]) & set(half[f, b]))
            shared[min(e, f), max(e, f), b] = [
                (half[min(e, f), b][k][0], half[e, b][k][1], half[max(e, f), b][k][0]) for k in points
            ]
    return shared


@pytest.mark.parametrize("seed", range(4))
def test_all_shared_tracks_are_found(seed, monkeypatch):
    monkeypatch.setattr(module, "TRIPLETS_PER_IMAGE", 1000)
    given = matches(seed)
    found = find_triplets(*given, 0)
    expected = {k: v for k, v in twin(*given).items() if len(v) >= module.MIN_TRACKS}
    assert len(expected) > 5
    assert len(found.images) == len(expected)
    for q, (a, b, c) in enumerate(found.images):
        e, f = found.edges[q]
        assert sorted(given[0][e]) == sorted((a, b))
        assert sorted(given[0][f]) == sorted((b, c))
        tracks = expected[min(e, f), max(e, f), b]
        rays = found.bearings[:, :, found.offsets[q] : found.offsets[q + 1]].transpose(2, 0, 1)
        ordered = np.array([t if e < f else t[::-1] for t in tracks])
        assert sorted(map(str, rays.tolist())) == sorted(map(str, ordered.tolist()))


def test_limits_keep_the_worthiest_and_what_joins_edges(monkeypatch):
    monkeypatch.setattr(module, "TRIPLETS_PER_IMAGE", 3)
    given = matches(5)
    found = find_triplets(*given, 11)
    assert np.diff(found.offsets).max() == 11

    def worth(tracks):
        sine = [[np.linalg.norm(np.cross(x, b)) for x in (a, c)] for a, b, c in tracks]
        return np.prod(sine, axis=1).sum()

    tracks = {k: v for k, v in twin(*given).items() if len(v) >= module.MIN_TRACKS}
    ranked = sorted(tracks, key=lambda k: -worth(tracks[k]))
    group, expected = {}, set()
    for e, f, b in ranked:
        # Kruskal's forest joins edges by the worthiest; and each image keeps its best three.
        of_e, of_f = group.setdefault(e, {e}), group.setdefault(f, {f})
        if of_e is not of_f:
            of_e |= of_f
            group.update(dict.fromkeys(of_f, of_e))
            expected.add((e, f, b))
    for b in range(6):
        expected |= set([k for k in ranked if k[2] == b][:3])
    found_ones = {(*sorted(e), b) for e, b in zip(found.edges.tolist(), found.images[:, 1].tolist(), strict=True)}
    assert found_ones == expected


def test_pairs_of_one_pair_of_images_make_no_triplet():
    keypoints, rays = np.tile(np.arange(30, dtype=np.int32), 2), np.tile([0.0, 0.6, 0.8], (60, 1))
    found = find_triplets(
        np.array([[0, 1], [1, 0]]),
        np.array([0, 30, 60]),
        keypoints,
        keypoints,
        rays,
        rays,
        np.tile(np.eye(3), (2, 1, 1)),
        60,
    )
    assert len(found.images) == 0
    assert found.bearings.shape == (3, 3, 0)
    assert found.offsets.tolist() == [0]


def test_few_shared_keypoints_make_no_triplet():
    given = matches(7, num_keypoints=9, share=1.0)
    assert len(find_triplets(*given, 60).images) == 0


def test_no_matches_make_no_triplet():
    empty = np.zeros(0, dtype=np.int32)
    found = find_triplets(
        np.array([[0, 1], [1, 2]]),
        np.zeros(3, int),
        empty,
        empty,
        *np.zeros((2, 0, 3)),
        np.tile(np.eye(3), (2, 1, 1)),
        60,
    )
    assert len(found.images) == 0
