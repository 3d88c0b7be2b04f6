"""Databases of a walk in a room, seen through one lens and verified under the calibration that is stored."""

from pathlib import Path

import numpy as np
import pycolmap
from synthetic_databases import look_at

WIDTH, HEIGHT, NUM_IMAGES = 1200, 900, 14


def write_room(
    path: Path,
    lens: pycolmap.Camera,
    stored: pycolmap.Camera,
    noise_px: float = 0.5,
    seed: int = 0,
    tripod: float | None = None,
) -> np.ndarray:
    """A walk in a room with one lens, pairs verified by pycolmap under the calibration that is stored; the centres.

    On a tripod the camera turns about itself in the middle, and moves by some metres at random.
    """
    rng = np.random.default_rng(seed)
    turn = 2.0 * np.pi * np.arange(NUM_IMAGES) / NUM_IMAGES
    p = np.stack([1.5 * np.cos(turn), 0.15 * rng.standard_normal(NUM_IMAGES), 1.5 * np.sin(turn)], axis=1)
    targets = np.stack([-4.0 * np.cos(turn + 0.2), np.zeros(NUM_IMAGES), -4.0 * np.sin(turn + 0.2)], axis=1)
    if tripod is not None:
        p = tripod / np.sqrt(3.0) * rng.standard_normal((NUM_IMAGES, 3))
        targets = p + np.stack([np.cos(turn), 0.1 * rng.standard_normal(NUM_IMAGES), np.sin(turn)], axis=1)
    wall, X = rng.integers(6, size=900), rng.uniform(-1.0, 1.0, (900, 3))
    X[np.arange(900), wall // 2] = np.where(wall % 2 == 0, 1.0, -1.0)
    X *= np.array([4.0, 2.0, 4.0]) * rng.uniform(0.9, 1.0, (900, 1))
    poses = [look_at(c, t) for c, t in zip(p, targets, strict=True)]
    seen, keypoints = [], []
    for pose in poses:
        local = X @ pose.rotation.matrix().T + pose.translation
        near_axis = np.flatnonzero(local[:, 2] > np.linalg.norm(local, axis=1) * np.cos(np.radians(70.0)))
        pixels = np.asarray(lens.img_from_cam(local[near_axis]))
        inside = (pixels > 0).all(axis=1) & (pixels < [WIDTH, HEIGHT]).all(axis=1)
        # Polynomials turn back beyond their range: no lens sees there.
        back = np.asarray(lens.cam_from_img(np.nan_to_num(pixels))) - local[near_axis, :2] / local[near_axis, 2:]
        found = inside & (np.abs(back).max(axis=1) < 1e-3) & (rng.random(len(pixels)) < 0.85)
        seen.append(near_axis[found])
        keypoints.append(pixels[found] + noise_px * rng.standard_normal((int(found.sum()), 2)))
    pycolmap.set_random_seed(seed)
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        database.write_camera(stored, use_camera_id=True)
        for row in range(NUM_IMAGES):
            database.write_image(pycolmap.Image(name=f"{row}.jpg", camera_id=1, image_id=row + 1), use_image_id=True)
            database.write_keypoints(row + 1, keypoints[row].astype(np.float32))
        for i in range(NUM_IMAGES):
            for j in range(i + 1, NUM_IMAGES):
                _, a, b = np.intersect1d(seen[i], seen[j], return_indices=True)
                if len(a) >= 30:
                    matches = np.stack([a, b], axis=1).astype(np.uint32)
                    wrong = rng.random(len(a)) < 0.05
                    matches[wrong, 1] = rng.integers(len(keypoints[j]), size=int(wrong.sum()))
                    database.write_matches(i + 1, j + 1, matches)
                    geometry = pycolmap.estimate_two_view_geometry(stored, keypoints[i], stored, keypoints[j], matches)
                    database.write_two_view_geometry(i + 1, j + 1, geometry)
    return p


def camera(model: str, params: tuple[float, ...]) -> pycolmap.Camera:
    return pycolmap.Camera(
        camera_id=1, model=model, width=WIDTH, height=HEIGHT, params=list(params), has_prior_focal_length=True
    )
