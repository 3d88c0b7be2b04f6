"""Edges with known relative poses and noisy matched rays."""

from dataclasses import dataclass

import numpy as np

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized


@dataclass(frozen=True)
class MatchedRays:
    rotations: np.ndarray
    directions: np.ndarray
    offsets: np.ndarray
    bearings1: np.ndarray
    bearings2: np.ndarray
    homographies: np.ndarray  # of the plane of each edge; meaningful for planar edges only


def matched_rays(seed, counts, *, sigma=0.0, planar=False, baseline=1.0, outlier_share=0.0):
    """Points 3 to 7 units in front of camera 1, within 30°; sigma: radians of noise in each ray's tangent plane."""
    rng = np.random.default_rng(seed)
    m, counts = len(counts), np.asarray(counts)
    offsets = np.concatenate([[0], np.cumsum(counts)])
    edge = np.repeat(np.arange(m), counts)
    R = so3.exp(0.25 * rng.standard_normal((m, 3)))
    center = baseline * normalized(rng.standard_normal((m, 3)) * [1.0, 1.0, 0.3])
    slope = 0.5 * rng.standard_normal((m, 2))
    u = rng.uniform(-0.55, 0.55, (len(edge), 2))
    depth = rng.uniform(3.0, 7.0, len(edge))
    normal = normalized(np.concatenate([slope, np.ones((m, 1))], axis=1))
    rays = np.concatenate([u, np.ones((len(u), 1))], axis=1)
    if planar:
        depth = 5.0 * normal[edge, 2] / np.einsum("ki,ki->k", rays, normal[edge])
    points = rays * depth[:, None]
    x1 = normalized(points + 0.0)
    x2 = normalized(np.einsum("kij,kj->ki", R[edge], points - center[edge]))
    noisy = [normalized(x + sigma * rng.standard_normal(x.shape)) for x in (x1, x2)]
    bad = rng.random(len(edge)) < outlier_share
    noisy[1][bad] = normalized(noisy[1][bad] + 0.2 * rng.standard_normal((int(bad.sum()), 3)))
    t = -np.einsum("mij,mj->mi", R, center)
    H = R + t[:, :, None] * normal[:, None, :] / (5.0 * normal[:, 2])[:, None, None]
    return MatchedRays(R, normalized(center), offsets, noisy[0], noisy[1], H)
