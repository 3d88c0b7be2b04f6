"""Keypoints and matches of an object with equal sides on a ground of its own, as matching and RANSAC leave them."""

import numpy as np

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.simulation.ring_scenes import look_at
from colmap_vg.simulation.views import FOCAL_PX, HEIGHT, WIDTH, SyntheticViews

MATCHING_ANGLE = np.radians(35.0)


def symmetric_views(
    num_images: int, num_sides: int, num_side_points: int = 150, num_ground_points: int = 60, seed: int = 0
) -> SyntheticViews:
    """Cameras on a ring; every pair is matched across that turn of the object which most of its keypoints allow.

    Parameters
    ----------
    num_images, num_sides : int
    num_side_points : int
        Of each side; all sides show the same.
    num_ground_points : int
        Per side, no two alike.
    seed : int
    """
    rng = np.random.default_rng(seed)
    turn = 2.0 * np.pi * (np.arange(num_images) + 0.1 * rng.standard_normal(num_images)) / num_images
    p = 6.0 * np.stack([np.cos(turn), np.sin(turn), np.full(num_images, 0.4)], axis=1)
    p += 0.1 * rng.standard_normal((num_images, 3))
    R = look_at(p, 0.1 * rng.standard_normal((num_images, 3)))
    sides = so3.exp(2.0 * np.pi * np.arange(num_sides)[:, None] / num_sides * np.array([[0.0, 0.0, 1.0]]))
    half = np.pi / num_sides
    base_turn = rng.uniform(-half, half, num_side_points)
    base = np.stack([1.5 * np.cos(base_turn), 1.5 * np.sin(base_turn), rng.uniform(-1.0, 1.0, num_side_points)], axis=1)
    base[:, :2] *= rng.uniform(0.8, 1.1, num_side_points)[:, None]
    count = num_ground_points * num_sides
    ground_turn, reach = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(1.6, 2.6, count)
    ground = np.stack([reach * np.cos(ground_turn), reach * np.sin(ground_turn), np.full(count, -1.0)], axis=1)
    points = np.concatenate([*(base @ side.T for side in sides), ground])
    outward = np.concatenate(
        [
            normalized(points[: num_sides * num_side_points] * np.array([1.0, 1.0, 0.0])),
            np.tile([0.0, 0.0, 1.0], (count, 1)),
        ]
    )
    label = np.concatenate([np.tile(np.arange(num_side_points), num_sides), num_side_points + np.arange(count)])
    on_side = np.concatenate([np.repeat(np.arange(num_sides), num_side_points), np.full(count, -1)])
    seen, keypoints = [], []
    for rotation, center in zip(R, p, strict=True):
        local = (points - center) @ rotation.T
        x = FOCAL_PX * local[:, :2] / local[:, 2:] + np.array([WIDTH, HEIGHT]) / 2
        facing = np.einsum("ka,ka->k", outward, normalized(center - points)) > 0.25
        inside = (x > 0).all(axis=1) & (x < [WIDTH, HEIGHT]).all(axis=1) & (local[:, 2] > 0.5)
        rows = np.flatnonzero(facing & inside & (rng.random(len(x)) < 0.8))
        seen.append(rows)
        keypoints.append(x[rows] + 0.5 * rng.standard_normal((len(rows), 2)))
    pairs, matches, relative, directions, wrong = [], [], [], [], []
    for i in range(num_images):
        for j in range(i + 1, num_images):
            best, best_side = np.zeros((0, 2), dtype=np.int64), 0
            for k in range(num_sides):
                # A point on side s of image i is taken for its copy on side s - k, which image j sees.
                side_i, side_j = on_side[seen[i]], on_side[seen[j]]
                on_ground = num_sides if k == 0 else -1
                side_j = np.where(side_j < 0, on_ground, (side_j + k) % num_sides)
                key_i = label[seen[i]] * (num_sides + 1) + np.where(side_i < 0, num_sides, side_i)
                key_j = np.where(side_j < 0, -1 - np.arange(len(side_j)), label[seen[j]] * (num_sides + 1) + side_j)
                _, a, b = np.intersect1d(key_i, key_j, return_indices=True)
                # Fewer features match the wider apart they are seen from.
                apart = (turn[j] - turn[i] + 2.0 * np.pi * k / num_sides + np.pi) % (2.0 * np.pi) - np.pi
                matched = rng.random(len(a)) < np.exp(-np.square(apart / MATCHING_ANGLE))
                a, b = a[matched], b[matched]
                if len(a) > len(best):
                    best, best_side = np.stack([a, b], axis=1).astype(np.int64), k
            if len(best) < 25:
                continue
            Q = sides[best_side]
            pairs.append((i, j))
            matches.append(best)
            relative.append(R[j] @ Q.T @ R[i].T)
            directions.append(R[i] @ normalized((Q @ p[j] - p[i])[None])[0])
            wrong.append(best_side != 0)
    return SyntheticViews(
        R,
        p,
        tuple(keypoints),
        np.array(pairs),
        tuple(matches),
        np.array(relative),
        np.array(directions),
        np.array(wrong),
    )
