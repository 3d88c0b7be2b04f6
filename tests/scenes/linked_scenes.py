"""Databases of scenes in which only chosen pairs are matched: streets, parts with few links, chains."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from synthetic_databases import changed_copy, look_at, pair_id

from colmap_vg import ViewGraph
from colmap_vg.geometry import so3

WIDTH, HEIGHT, FOCAL = 1024, 768, 1000.0


def write_scene(
    path: Path,
    poses: list[pycolmap.Rigid3d],
    points: np.ndarray,
    pairs: Iterable[tuple[int, int]],
    noise_px: float = 0.5,
    share_seen: float = 0.8,
    seed: int = 0,
    looks: np.ndarray | None = None,
    compared: Iterable[tuple[int, int]] = (),
) -> None:
    """Images of points (k, 3), each seen by a share of the images that could, and the pairs matched and verified.

    Points of the same number in `looks` (k,) look alike and match; pairs in `compared` besides were found to have no
    matches.
    """
    looks = np.arange(len(points)) if looks is None else looks
    pairs = list(pairs)
    rng = np.random.default_rng(seed)
    lens = pycolmap.Camera(
        camera_id=1, model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, WIDTH / 2, HEIGHT / 2]
    )
    lens.has_prior_focal_length = True
    seen, pixels = [], []
    for pose in poses:
        local = points @ pose.rotation.matrix().T + pose.translation
        front = np.flatnonzero(local[:, 2] > 0.1)
        projected = np.asarray(lens.img_from_cam(local[front]))
        found = (projected > 0).all(axis=1) & (projected < [WIDTH, HEIGHT]).all(axis=1)
        found &= rng.random(len(found)) < share_seen
        seen.append(looks[front[found]])
        pixels.append(projected[found] + noise_px * rng.standard_normal((int(found.sum()), 2)))
    pycolmap.set_random_seed(seed)
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        database.write_camera(lens, use_camera_id=True)
        for row, own in enumerate(pixels):
            database.write_image(
                pycolmap.Image(name=f"{row:03d}.jpg", camera_id=1, image_id=row + 1), use_image_id=True
            )
            database.write_keypoints(row + 1, own.astype(np.float32))
        for i, j in pairs:
            _, a, b = np.intersect1d(seen[i], seen[j], return_indices=True)
            matches = np.stack([a, b], axis=1).astype(np.uint32)
            geometry = pycolmap.estimate_two_view_geometry(lens, pixels[i], lens, pixels[j], matches)
            database.write_matches(i + 1, j + 1, matches)
            database.write_two_view_geometry(i + 1, j + 1, geometry)
        for i, j in sorted(set(compared) - set(pairs)):
            database.write_matches(i + 1, j + 1, np.zeros((0, 2), dtype=np.uint32))
            database.write_two_view_geometry(i + 1, j + 1, pycolmap.TwoViewGeometry())


def near(count: int, reach: int) -> list[tuple[int, int]]:
    """Pairs of a sequence not more than `reach` apart."""
    return [(i, j) for i in range(count) for j in range(i + 1, min(i + reach, count - 1) + 1)]


def street(num_images: int, seed: int = 0, num_points: int = 1500) -> tuple[list[pycolmap.Rigid3d], np.ndarray]:
    """A walk along a façade, a step of a twentieth of its length at a time; poses and points."""
    rng = np.random.default_rng(seed)
    x = np.arange(num_images) + 0.1 * rng.standard_normal(num_images)
    places = np.stack([x, 0.1 * rng.standard_normal(num_images), 0.2 * rng.standard_normal(num_images)], axis=1)
    aims = places + np.array([0.3, 0.0, 5.0]) + 0.2 * rng.standard_normal((num_images, 3))
    low, high = np.array([-4.0, -2.0, 4.0]), np.array([num_images + 3.0, 2.0, 6.5])
    return [look_at(c, a) for c, a in zip(places, aims, strict=True)], rng.uniform(low, high, (num_points, 3))


def alike_streets(
    num_images: int, alike: float, seed: int = 0
) -> tuple[list[pycolmap.Rigid3d], np.ndarray, np.ndarray]:
    """Two streets, the same façade over a share of both, all else their own; poses, points, and looks of points."""
    (poses, points), (others, elsewhere) = street(num_images, seed, 900), street(num_images, seed + 100, 900)
    low, high = points[:, 0].min(), points[:, 0].max()
    middle, half = (low + high) / 2.0, alike * (high - low) / 2.0
    facade, own = (np.abs(x[:, 0] - middle) < half for x in (points, elsewhere))
    second = np.concatenate([elsewhere[~own], points[facade]])
    looks = np.concatenate([np.arange(len(points)), len(points) + np.arange((~own).sum()), np.flatnonzero(facade)])
    away = np.array([1000.0, 0.0, 0.0])
    moved = [pycolmap.Rigid3d(o.rotation, o.translation - o.rotation.matrix() @ away) for o in others]
    return poses + moved, np.concatenate([points, second + away]), looks


def survey(columns: int, rows: int, seed: int = 0, num_points: int = 2000) -> tuple[list[pycolmap.Rigid3d], np.ndarray]:
    """Photographs from above in a grid, and hilly ground below; poses and points."""
    rng = np.random.default_rng(seed)
    x, z = (a.ravel().astype(float) for a in np.meshgrid(np.arange(columns), np.arange(rows)))
    places = np.stack([x, -4.0 + 0.2 * rng.standard_normal(len(x)), z], axis=1)
    places[:, ::2] += 0.1 * rng.standard_normal((len(x), 2))
    aims = places + np.array([0.0, 4.0, 0.5]) + 0.3 * rng.standard_normal((len(x), 3))
    points = rng.uniform([-2.5, 0.0, -2.5], [columns + 1.5, 0.8, rows + 1.5], (num_points, 3))
    return [look_at(c, a) for c, a in zip(places, aims, strict=True)], points


def projection_centers(poses: list[pycolmap.Rigid3d]) -> np.ndarray:
    """Centres (n, 3) of cam_from_world poses."""
    return np.array([-pose.rotation.matrix().T @ pose.translation for pose in poses])


def only_pairs(path: Path, target: Path, pairs: Iterable[tuple[int, int]]) -> Path:
    """A copy of a database with the geometries of some pairs of image ids only."""
    kept = ", ".join(str(pair_id(*sorted(pair))) for pair in pairs)
    delete = "DELETE FROM {} WHERE pair_id NOT IN ({})"
    return changed_copy(path, target, *(delete.format(table, kept) for table in ("matches", "two_view_geometries")))


def turned(graph: ViewGraph, edge: int, degrees: float, *, with_matches: bool) -> ViewGraph:
    """The graph with the second camera of an edge turned in its relative rotation, and its rays likewise or not."""
    turn = so3.exp(np.radians([[0.0, degrees, 0.0]]))[0]
    R, rays = graph.cam2_from_cam1_rotations.copy(), graph.inlier_bearings2.copy()
    R[edge] = turn @ R[edge]
    rows = slice(*graph.inlier_offsets[edge : edge + 2].tolist())
    if with_matches:
        rays[rows] = rays[rows] @ turn.T
    return replace(graph, cam2_from_cam1_rotations=R, inlier_bearings2=rays)
