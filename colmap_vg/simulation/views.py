"""Simulate keypoints and matches of cameras along a street, around an object or over a field, with known poses.

Fast enough for thousands of images: a k-d tree finds each image's points, and pairs match the points that both see.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from colmap_vg.errors import OptionError
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.simulation.ring_scenes import look_at

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

Layout = Literal["street", "ring", "drone"]

FOCAL_PX, WIDTH, HEIGHT = 1200.0, 1600, 1200
"""Focal length, width and height of all images, pixels; the horizontal field of view is 67 degrees."""
PAIRS_PER_IMAGE = 10
"""Mean number of pairs per image."""
MIN_SHARED = 30
"""Minimum number of common keypoints of a pair."""
WRONG_PAIR_MATCHES = 40
"""Number of matches of a wrong pair."""
DETECTED = 0.75
"""Share of the visible points that an image detects."""


@dataclass(frozen=True, eq=False)
class SyntheticViews:
    """Keypoints of images and matches of pairs, with the true poses.

    Attributes
    ----------
    cam_from_world_rotations : (n, 3, 3) array
    projection_centers : (n, 3) array
        World frame, metres.
    keypoints : tuple of (k, 2) arrays
        Pixels, with noise.
    pairs : (m, 2) int64 array
        Image rows, the first below the second.
    matches : tuple of (k, 2) int64 arrays
        Rows of the keypoints of each pair's images.
    relative_rotations : (m, 3, 3) array
        cam2_from_cam1 rotations that the matches agree with.
    directions : (m, 3) array
        Unit vectors from camera 1 to camera 2 that the matches agree with, in camera 1's frame.
    wrong : (m,) bool array
        Whether the pair's images have nothing in common, and its matches agree with a false relative pose.
    """

    cam_from_world_rotations: Array
    projection_centers: Array
    keypoints: tuple[Array, ...]
    pairs: IntArray
    matches: tuple[IntArray, ...]
    relative_rotations: Array
    directions: Array
    wrong: NDArray[np.bool_]


def synthetic_views(
    layout: Layout,
    num_images: int,
    *,
    num_keypoints: int = 900,
    noise_px: float = 0.5,
    wrong_match_share: float = 0.06,
    wrong_pair_share: float = 0.08,
    seed: int = 0,
) -> SyntheticViews:
    """Simulate the views of cameras in a layout, with an overlap that does not depend on their number.

    Parameters
    ----------
    layout : str
        "street": sideways along a curved street; "ring": around an object; "drone": downwards over a field, in rows.
    num_images : int
        3 or more.
    num_keypoints : int
        Approximate number per image.
    noise_px : float
        Standard deviation of keypoints, pixels.
    wrong_match_share, wrong_pair_share : float
        Share of wrong matches in correct pairs, and of wrong pairs among all pairs.
    seed : int

    Returns
    -------
    SyntheticViews

    Raises
    ------
    OptionError
        Fewer than three images, or an unknown layout.
    """
    if num_images < 3:
        raise OptionError(f"synthetic_views: num_images is {num_images}; use 3 or more")
    rng = np.random.default_rng(seed)
    R, p, points, reach = _layout(layout, num_images, num_keypoints / DETECTED, rng)
    seen, pixels = _visible(R, p, points, reach, rng)
    keypoints = [x + noise_px * rng.standard_normal(x.shape) for x in pixels]
    pairs = _best_pairs(seen, len(points))
    matches = [_shared(seen[i], seen[j]) for i, j in pairs]
    for (_, j), match in zip(pairs, matches, strict=True):
        bad = np.flatnonzero(rng.random(len(match)) < wrong_match_share)
        match[bad, 1] = rng.integers(len(keypoints[j]), size=len(bad))
    i, j = pairs.T
    rotations = R[j] @ np.swapaxes(R[i], 1, 2)
    directions = normalized(np.einsum("kab,kb->ka", R[i], p[j] - p[i]))
    wrong_pairs = _unrelated_pairs(
        pairs, num_images, round(len(pairs) * wrong_pair_share / (1 - wrong_pair_share)), rng
    )
    false = _false_geometry(wrong_pairs, keypoints, noise_px, rng)
    return SyntheticViews(
        R,
        p,
        tuple(keypoints),
        np.concatenate([pairs, wrong_pairs]),
        (*matches, *false[0]),
        np.concatenate([rotations, false[1]]),
        np.concatenate([directions, false[2]]),
        np.arange(len(pairs) + len(wrong_pairs)) >= len(pairs),
    )


def _layout(layout: Layout, n: int, visible: float, rng: np.random.Generator) -> tuple[Array, Array, Array, float]:
    """Rotations, centres, points, and the visual range of the cameras, metres.

    The density of the points is such that a camera sees about `visible` of them.
    """
    along = np.arange(n) + 0.1 * rng.standard_normal(n)
    if layout == "street":
        p = np.stack([along, 1.5 * np.sin(along / 9.0), 0.2 * rng.standard_normal(n)], axis=1)
        R = look_at(p, p + np.stack([0.35 * rng.standard_normal(n), np.full(n, 8.0), 0.2 * rng.standard_normal(n)], 1))
        low, high = np.array([-8.0, 7.0, -4.0]), np.array([n + 8.0, 11.0, 4.0])
        # At a distance of about 9 m a view covers 12 m by 9 m, of which the points fill 8 m of the height.
        return R, p, rng.uniform(low, high, (int(visible * (n + 16.0) / 12.0), 3)), 16.0
    if layout == "drone":
        across = max(int(np.ceil(np.sqrt(n))), 1)
        place = np.stack([np.arange(n) % across, np.arange(n) // across], axis=1) * np.array([9.0, 9.0])
        p = np.concatenate(
            [place + 0.8 * rng.standard_normal((n, 2)), 30.0 + 1.5 * rng.standard_normal((n, 1))], axis=1
        )
        down = look_at(np.zeros((n, 3)), np.tile([1e-3, 1.0, -40.0], (n, 1)))
        size = place.max(axis=0) + 40.0
        points = rng.uniform([-20.0, -20.0, 0.0], [*(size - 20.0), 6.0], (int(visible * np.prod(size) / 1130.0), 3))
        return so3.exp(0.05 * rng.standard_normal((n, 3))) @ down, p, points, 60.0
    if layout == "ring":
        # Neighbours are one metre apart and look from outside at a circular wall.
        radius = max(n / (2.0 * np.pi), 3.0)
        turn = 2.0 * np.pi * along / n
        outward = np.stack([np.cos(turn), np.sin(turn), np.zeros(n)], axis=1)
        p = (radius + 8.0 + 0.5 * rng.standard_normal((n, 1))) * outward + 0.5 * rng.standard_normal((n, 3))
        R = look_at(p, radius * outward + 0.3 * rng.standard_normal((n, 3)))
        count = int(visible * max(2.0 * np.pi * radius / 12.5, 2.0))
        turn, depth = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(-1.5, 1.5, count)
        wall = np.stack([np.cos(turn), np.sin(turn)], axis=1) * (radius + depth)[:, None]
        return R, p, np.concatenate([wall, rng.uniform(-3.5, 3.5, (count, 1))], axis=1), 13.0
    raise OptionError(f"synthetic_views: layout is {layout!r}; choose one of street, ring, drone")


def _visible(
    R: Array, p: Array, points: Array, reach: float, rng: np.random.Generator
) -> tuple[list[IntArray], list[Array]]:
    """Rows of the points that each image detects, ascending, and their pixels (k, 2)."""
    tree = cKDTree(points)
    seen, pixels = [], []
    for rotation, center, near in zip(R, p, tree.query_ball_point(p, reach, return_sorted=True), strict=True):
        rows = np.asarray(near, dtype=np.int64)
        local = (points[rows] - center) @ rotation.T
        front = local[:, 2] > 0.5
        rows, local = rows[front], local[front]
        x = FOCAL_PX * local[:, :2] / local[:, 2:] + np.array([WIDTH, HEIGHT]) / 2
        found = (x > 0.0).all(axis=1) & (x < [WIDTH, HEIGHT]).all(axis=1) & (rng.random(len(x)) < DETECTED)
        seen.append(rows[found])
        pixels.append(x[found])
    return seen, pixels


def _best_pairs(seen: list[IntArray], num_points: int) -> IntArray:
    """Pairs (m, 2) with most common points, at most `PAIRS_PER_IMAGE` times the number of images."""
    starts = np.concatenate([[0], np.cumsum([len(s) for s in seen])])
    sees = sp.csr_array((np.ones(starts[-1], dtype=np.int32), np.concatenate(seen), starts), (len(seen), num_points))
    shared = sp.coo_array(sp.triu(sees @ sees.T, k=1))
    i, j = shared.coords
    order = np.lexsort((j, i, -shared.data))[: PAIRS_PER_IMAGE * len(seen)]
    order = order[shared.data[order] >= MIN_SHARED]
    pairs = np.stack([i[order], j[order]], axis=1).astype(np.int64)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def _shared(one: IntArray, other: IntArray) -> IntArray:
    """Rows of keypoints (k, 2) of two images that are projections of the same point."""
    place = np.minimum(np.searchsorted(other, one), max(len(other) - 1, 0))
    hit = np.flatnonzero(other[place] == one)
    return np.stack([hit, place[hit]], axis=1)


def _unrelated_pairs(pairs: IntArray, num_images: int, count: int, rng: np.random.Generator) -> IntArray:
    """Draw at most `count` pairs of images that are not among the given ones."""
    drawn = np.sort(rng.integers(num_images, size=(4 * count, 2)), axis=1)
    keys = drawn[:, 0] * num_images + drawn[:, 1]
    fresh = (drawn[:, 0] != drawn[:, 1]) & ~np.isin(keys, pairs[:, 0] * num_images + pairs[:, 1])
    _, first = np.unique(keys[fresh], return_index=True)
    return np.asarray(drawn[fresh][np.sort(first)[:count]], dtype=np.int64)


def _false_geometry(
    pairs: IntArray, keypoints: list[Array], noise_px: float, rng: np.random.Generator
) -> tuple[list[IntArray], Array, Array]:
    """Add keypoints of false matches to the images; return the matches and the false relative poses they agree with."""
    m, k, middle = len(pairs), WRONG_PAIR_MATCHES, np.array([WIDTH, HEIGHT]) / 2
    rotations = so3.exp(0.15 * rng.standard_normal((m, 3)))
    directions = normalized(rng.standard_normal((m, 3)) * np.array([1.0, 1.0, 0.3]))
    matches = []
    for (i, j), R, d in zip(pairs, rotations, directions, strict=True):
        x1 = rng.uniform([0.1 * WIDTH, 0.1 * HEIGHT], [0.9 * WIDTH, 0.9 * HEIGHT], (k, 2))
        rays = np.concatenate([(x1 - middle) / FOCAL_PX, np.ones((k, 1))], axis=1)
        local = (rays * rng.uniform(4.0, 12.0, (k, 1)) - d) @ R.T
        x2 = FOCAL_PX * local[:, :2] / np.maximum(local[:, 2:], 1.0) + middle
        rows = []
        for image, x in ((i, x1), (j, x2)):
            rows.append(len(keypoints[image]) + np.arange(k))
            keypoints[image] = np.concatenate([keypoints[image], x + noise_px * rng.standard_normal((k, 2))])
        matches.append(np.stack(rows, axis=1))
    return matches, rotations, directions
