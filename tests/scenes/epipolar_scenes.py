"""Matches in pixels between synthetic cameras of known focal lengths, for tests of self-calibration."""

from dataclasses import dataclass

import numpy as np

from colmap_vg.simulation.ring_scenes import look_at, nearest_neighbor_edges, ring_cameras


@dataclass(frozen=True)
class PixelScene:
    edges: np.ndarray
    camera_idx: np.ndarray
    offsets: np.ndarray
    points1: np.ndarray
    points2: np.ndarray
    focal_lengths: np.ndarray
    principal_points: np.ndarray
    image_sizes: np.ndarray


def pixel_scene(seed, focal_lengths, *, num_images=14, num_matches=120, sigma_px=0.5, turntable=False, planar=False):
    """A ring of cameras that looks at a blob of points; image k is taken by camera k modulo the number of cameras."""
    rng = np.random.default_rng(seed)
    focal = np.asarray(focal_lengths, dtype=float)
    c = len(focal)
    if turntable:
        turn = 2 * np.pi * np.arange(num_images) / num_images
        centers = np.stack([4 * np.cos(turn), 4 * np.sin(turn), np.zeros(num_images)], axis=1)
        rotations = look_at(centers, np.zeros_like(centers))
    else:
        rotations, centers = ring_cameras(num_images, rng)
    edges = nearest_neighbor_edges(centers, 4)
    camera = np.arange(num_images) % c
    points = rng.uniform(-1.0, 1.0, (num_matches, 3))
    if planar:
        points[:, 2] = 0.3 * points[:, 0]
    in_cameras = np.einsum("nab,nkb->nka", rotations, points[None] - centers[:, None])
    sizes = np.tile([1000, 800], (c, 1))
    principal = sizes / 2 + rng.uniform(-10, 10, (c, 2))
    pixels = focal[camera, None, None] * in_cameras[..., :2] / in_cameras[..., 2:] + principal[camera, None]
    m = len(edges)
    noisy = [pixels[edges[:, s]].reshape(-1, 2) + sigma_px * rng.standard_normal((m * num_matches, 2)) for s in (0, 1)]
    offsets = num_matches * np.arange(m + 1)
    return PixelScene(edges, camera, offsets, *noisy, focal, principal, sizes)
