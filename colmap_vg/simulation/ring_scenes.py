"""Synthetic rings of cameras and view graphs with noise and outliers, with known poses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.scene.view_graph import ViewGraph

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SyntheticScene:
    """A view graph and its true poses.

    Attributes
    ----------
    graph : ViewGraph
    cam_from_world_rotations : (n, 3, 3) array
    projection_centers : (n, 3) array
        World frame.
    outlier : (m,) bool array
        Whether the relative pose of each edge is false.
    """

    graph: ViewGraph
    cam_from_world_rotations: Array
    projection_centers: Array
    outlier: NDArray[np.bool_]


def ring_cameras(num_images: int, rng: np.random.Generator, radius: float = 4.0) -> tuple[Array, Array]:
    """Cameras on a jittered ring that look at the origin: cam_from_world rotations (n, 3, 3), centres (n, 3)."""
    turn = 2.0 * np.pi * (np.arange(num_images) + 0.3 * rng.random(num_images)) / num_images
    distance = radius * (1.0 + 0.15 * rng.standard_normal(num_images))
    centers = np.stack(
        [distance * np.cos(turn), distance * np.sin(turn), 0.5 * radius * (rng.random(num_images) - 0.5)], axis=1
    )
    return look_at(centers, 0.1 * radius * rng.standard_normal((num_images, 3))), centers


def look_at(centers: Array, targets: Array) -> Array:
    """cam_from_world rotations (n, 3, 3) of cameras that look at targets, with the world's z axis up in the image."""
    forward = normalized(targets - centers)
    right = normalized(np.cross(forward, np.array([0.0, 0.0, 1.0])))
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def nearest_neighbor_edges(centers: Array, num_neighbors: int) -> NDArray[np.int64]:
    """Edges (m, 2), i < j, from each camera to its nearest neighbours."""
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    near = np.argsort(distance, axis=1)[:, 1 : num_neighbors + 1]
    pairs = np.stack([np.repeat(np.arange(len(centers)), near.shape[1]), near.ravel()], axis=1)
    return np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int64)


def scene_from_poses(
    cam_from_world_rotations: Array,
    projection_centers: Array,
    edges: NDArray[np.int64],
    *,
    rotation_sigma: float = 0.0,
    direction_sigma: float = 0.0,
    outlier_share: float = 0.0,
    rng: np.random.Generator,
) -> SyntheticScene:
    """Make the view graph of given cameras and edges, with isotropic noise and random outliers.

    The standard deviations are those of each tangent axis, radians.
    """
    R, p = cam_from_world_rotations, projection_centers
    i, j = edges[:, 0], edges[:, 1]
    relative = so3.perturbed(R[j] @ np.swapaxes(R[i], 1, 2), rotation_sigma, rng)
    direction = normalized(np.einsum("kab,kb->ka", R[i], p[j] - p[i]))
    turned = so3.perturbed(np.broadcast_to(np.eye(3), relative.shape), direction_sigma, rng)
    direction = np.einsum("kab,kb->ka", turned, direction)
    outlier = np.zeros(len(edges), dtype=bool)
    outlier[rng.permutation(len(edges))[: round(outlier_share * len(edges))]] = True
    relative[outlier] = so3.random(int(outlier.sum()), rng)
    direction[outlier] = normalized(rng.standard_normal((int(outlier.sum()), 3)))
    graph = ViewGraph(
        image_ids=np.arange(1, len(p) + 1),
        edges=edges,
        cam2_from_cam1_rotations=so3.project(relative),
        cam2_in_cam1_directions=normalized(direction),
        num_inliers=np.full(len(edges), 100),
    )
    return SyntheticScene(graph, R, p, outlier)


def ring_scene(
    num_images: int,
    num_neighbors: int = 6,
    *,
    rotation_sigma: float = 0.0,
    direction_sigma: float = 0.0,
    outlier_share: float = 0.0,
    seed: int = 0,
) -> SyntheticScene:
    """Make a ring of cameras whose edges link nearest neighbours, with noise as in :func:`scene_from_poses`."""
    rng = np.random.default_rng(seed)
    R, p = ring_cameras(num_images, rng)
    return scene_from_poses(
        R,
        p,
        nearest_neighbor_edges(p, num_neighbors),
        rotation_sigma=rotation_sigma,
        direction_sigma=direction_sigma,
        outlier_share=outlier_share,
        rng=rng,
    )
