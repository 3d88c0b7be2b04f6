"""Simulated image sets: points seen by 3 to 15 images, one noisy keypoint in each, shared by all of its pairs."""

from typing import Literal

import numpy as np

from colmap_vg.epipolar.cameras import Cameras, gauged
from colmap_vg.epipolar.problem import EpipolarProblem, Lenses
from colmap_vg.epipolar.triplets import find_triplets
from colmap_vg.geometry.directions import normalized
from colmap_vg.simulation.ring_scenes import look_at, ring_cameras
from colmap_vg.two_view.sampson import residuals

FOCAL, HALF_SIZE, MIN_SHARED = 1000.0, 600.0, 20


def cameras_and_points(layout: Literal["ring", "street", "grid"], n: int, num_points: int, rng):
    """Rotations (n, 3, 3), centres (n, 3) and points (k, 3)."""
    if layout == "ring":
        return *ring_cameras(n, rng), rng.uniform(-1, 1, (num_points, 3))
    if layout == "street":
        p = np.stack([np.arange(n) * 0.5, *(0.1 * rng.standard_normal((2, n)))], axis=1)
        X = rng.uniform([-1, 3, -1.5], [n * 0.5 + 1, 6, 1.5], (num_points, 3))
        return look_at(p, p + [0, 4, 0] + 0.3 * rng.standard_normal((n, 3))), p, X
    side = int(np.ceil(np.sqrt(n)))
    flat = 0.6 * np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[:n]
    p = np.concatenate([flat, np.full((n, 1), 4.0)], axis=1) + 0.05 * rng.standard_normal((n, 3))
    X = rng.uniform([-1, -1, -0.5], [side * 0.6 + 1, side * 0.6 + 1, 0.5], (num_points, 3))
    return look_at(p, p + [0.01, 0.02, -4] + 0.3 * rng.standard_normal((n, 3))), p, X


def image_set(seed: int, layout, n: int, num_points: int, sigma_px: float, wrong: float = 0.0, free: bool = False):
    """The problem, and the true rotations and centres; wrong matches lie within 4 pixels of their epipolar lines."""
    rng = np.random.default_rng(seed)
    R, p, X = cameras_and_points(layout, n, num_points, rng)
    local = np.einsum("nab,nkb->nka", R, X[None] - p[:, None])
    pixels = FOCAL * local[..., :2] / local[..., 2:]
    seen = (local[..., 2] > 0.1) & (np.abs(pixels) < HALF_SIZE).all(axis=-1)
    for k in range(num_points):
        views = np.flatnonzero(seen[:, k])
        if len(views) == 0:
            continue
        near = np.argsort(np.abs(views - rng.choice(views)), kind="stable")
        seen[views[near[rng.integers(3, 16) :]], k] = False
    seen[:, seen.sum(axis=0) < 3] = False
    pixels = pixels + sigma_px * rng.standard_normal(pixels.shape)
    rays = normalized(np.concatenate([pixels / FOCAL, np.ones((*pixels.shape[:2], 1))], axis=2))
    edges, first, second = [], [], []
    for i in range(n):
        for j in range(i + 1, n):
            shared = np.flatnonzero(seen[i] & seen[j])
            if len(shared) >= MIN_SHARED:
                edges.append((i, j))
                first.append(shared)
                other = rng.choice(np.flatnonzero(seen[j]), len(shared))
                second.append(np.where(rng.random(len(shared)) < wrong, other, shared))
    problem = _problem(np.array(edges), first, second, rays, R, n, free)
    if wrong > 0:
        cameras = Cameras(R, gauged(p), Lenses(np.zeros(1)))
        relative, direction, _ = cameras.relative(problem.edges)
        near = np.abs(residuals(problem.matches(cameras.lenses), relative, direction)) < 4.0
        kept = np.split(near, problem.offsets[1:-1])
        first = [a[k] for a, k in zip(first, kept, strict=True)]
        second = [b[k] for b, k in zip(second, kept, strict=True)]
        problem = _problem(np.array(edges), first, second, rays, R, n, free)
    return problem, R, gauged(p)


def _problem(edges, first, second, rays, R, n, free):
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in first])])
    k1, k2 = np.concatenate(first).astype(np.int32), np.concatenate(second).astype(np.int32)
    edge = np.repeat(np.arange(len(edges)), np.diff(offsets))
    rays1, rays2 = rays[edges[edge, 0], k1], rays[edges[edge, 1], k2]
    relative = R[edges[:, 1]] @ np.swapaxes(R[edges[:, 0]], 1, 2)
    triplets = find_triplets(edges, offsets, k1, k2, rays1, rays2, relative, 60)
    return EpipolarProblem(
        n,
        edges,
        offsets,
        rays1,
        rays2,
        np.zeros(n, dtype=int),
        np.array([FOCAL]),
        np.array([free]),
        triplets if len(triplets.images) else None,
        k1,
        k2,
    )
