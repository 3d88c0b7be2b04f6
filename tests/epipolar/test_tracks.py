"""Tracks from matches, held against a plain union-find; points from rays."""

import numpy as np

from colmap_vg.epipolar.tracks import Tracks, spread_tracks, triangulated
from colmap_vg.geometry.directions import normalized


def plain_tracks(edges, offsets, keypoints1, keypoints2):
    """Sets of (image, keypoint), three images or more, none twice."""
    parent = {}

    def root(a):
        while parent.setdefault(a, a) != a:
            a = parent[a]
        return a

    for edge, (i, j) in enumerate(edges):
        for k in range(offsets[edge], offsets[edge + 1]):
            parent[root((int(i), int(keypoints1[k])))] = root((int(j), int(keypoints2[k])))
    groups = {}
    for a in list(parent):
        groups.setdefault(root(a), set()).add(a)
    return {frozenset(g) for g in groups.values() if len(g) >= 3 and len({image for image, _ in g}) == len(g)}


def ray_of(image, keypoint):
    """A ray that names its feature."""
    return normalized(np.array([0.001 * keypoint + 0.0001, 0.01 * image, 1.0]))


def test_tracks_are_those_of_union_find():
    rng = np.random.default_rng(0)
    edges = np.array([[i, j] for i in range(6) for j in range(i + 1, 6)])
    counts = rng.integers(0, 12, len(edges))
    offsets = np.concatenate([[0], np.cumsum(counts)])
    keypoints1, keypoints2 = (rng.integers(0, 60, offsets[-1]).astype(np.int32) for _ in range(2))
    image1, image2 = (np.repeat(edges[:, side], counts) for side in (0, 1))
    rays = [
        np.array([ray_of(i, k) for i, k in zip(image, keypoint, strict=True)])
        for image, keypoint in ((image1, keypoints1), (image2, keypoints2))
    ]
    tracks = spread_tracks(6, edges, offsets, keypoints1, keypoints2, *rays)
    name = {tuple(ray_of(i, k)): (i, k) for i in range(6) for k in range(60)}
    found = {
        frozenset(name[tuple(b)] for b in tracks.bearings[tracks.offsets[t] : tracks.offsets[t + 1]])
        for t in range(tracks.num_tracks)
    }
    expected = plain_tracks(edges, offsets, keypoints1, keypoints2)
    assert len(expected) > 5
    assert found <= expected
    for t in range(tracks.num_tracks):
        rows = slice(tracks.offsets[t], tracks.offsets[t + 1])
        assert [name[tuple(b)][0] for b in tracks.bearings[rows]] == tracks.images[rows].tolist()
    # Few as they are, no cell of an image has to choose among more than it may keep.
    assert len(found) >= 0.9 * len(expected)


def test_points_are_where_rays_meet():
    rng = np.random.default_rng(1)
    centers = rng.standard_normal((5, 3))
    points = rng.uniform([-1, -1, 7], [1, 1, 9], (7, 3))
    images = np.tile(np.arange(5), 7)
    rays = normalized(np.repeat(points, 5, axis=0) - centers[images])
    tracks = Tracks(5 * np.arange(8), images, rays)
    found = triangulated(tracks, np.tile(np.eye(3), (5, 1, 1)), centers)
    np.testing.assert_allclose(found, points, atol=1e-6)


def test_observations_leave_and_short_tracks_with_them():
    tracks = Tracks(np.array([0, 3, 7]), np.array([0, 1, 2, 0, 1, 2, 3]), np.tile([0.0, 0, 1], (7, 1)))
    kept = tracks.of(np.array([True, False, True, True, False, True, True]))
    assert kept.num_tracks == 1
    assert kept.images.tolist() == [0, 2, 3]
    nothing = tracks.of(np.zeros(7, dtype=bool))
    assert nothing.num_tracks == 0
    assert triangulated(nothing, np.zeros((0, 3, 3)), np.zeros((0, 3))).shape == (0, 3)
