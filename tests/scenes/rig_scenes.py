"""Databases of rigs with several cameras, by pycolmap's own synthesis, and rendered photographs of one."""

import sqlite3
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from colmap_vg import align_positions
from colmap_vg.demo.photographs import true_camera
from colmap_vg.demo.render import RayCaster, photograph, pixel_rays
from colmap_vg.demo.scene import build_ruin
from colmap_vg.demo.texture import paint
from colmap_vg.geometry import so3
from colmap_vg.simulation.ring_scenes import look_at

MAX_NUM_IMAGES = 2_147_483_647
RIGHT, RIGHT_CENTER = so3.exp(np.array([[0.0, -0.1, 0.02]]))[0], np.array([0.4, 0.0, 0.0])
"""Place of the right camera in the frame of the left one: rotation, and centre in metres."""


def make_rigs(
    path: Path,
    num_rigs: int = 1,
    num_cameras: int = 2,
    num_frames: int = 8,
    known: bool = True,
    spacing: float = 0.3,
    noise_px: float = 0.5,
    inlier_ratio: float = 1.0,
    seed: int = 0,
) -> pycolmap.Reconstruction:
    """A database of rigs, whose sensors' poses it holds if they are known; the truth is returned."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=num_rigs,
        num_cameras_per_rig=num_cameras,
        num_frames_per_rig=num_frames,
        num_points3D=150,
        inlier_match_ratio=inlier_ratio,
        sensor_from_rig_translation_stddev=spacing,
        camera_has_prior_focal_length=True,
    )
    with pycolmap.Database.open(path) as database:
        truth = pycolmap.synthesize_dataset(options, database)
        noise = pycolmap.SyntheticNoiseOptions(point2D_stddev=noise_px)
        pycolmap.synthesize_noise(noise, pycolmap.Reconstruction(truth), database)
        if not known:
            for rig in database.read_all_rigs():
                for sensor in rig.non_ref_sensors:
                    rig.reset_sensor_from_rig(sensor)
                database.update_rig(rig)
    return truth


def keep_pairs(path: Path, wanted: str) -> None:
    """Delete all pairs but those of which a condition on the cameras ``a`` and ``b`` of their images is true."""
    with closing(sqlite3.connect(path)) as connection, connection:
        camera = dict(connection.execute("SELECT image_id, camera_id FROM images"))
        for table in ("two_view_geometries", "matches"):
            for (pair,) in connection.execute(f"SELECT pair_id FROM {table}").fetchall():
                a, b = camera[pair // MAX_NUM_IMAGES], camera[pair % MAX_NUM_IMAGES]
                if not eval(wanted, {"a": a, "b": b}):
                    connection.execute(f"DELETE FROM {table} WHERE pair_id = ?", (pair,))


def errors(model: pycolmap.Reconstruction, truth: pycolmap.Reconstruction) -> tuple[float, float]:
    """Mean error of the positions after the best similarity, in the unit of the truth, and the similarity's scale."""
    ids = sorted(model.reg_image_ids())
    own, true = ([m.image(i).projection_center() for i in ids] for m in (model, truth))
    distances, similarity = align_positions(np.array(own), np.array(true))
    return float(distances.mean()), similarity.scale


def render_rig(folder: Path, num_frames: int = 7, seed: int = 0) -> np.ndarray:
    """Photographs ``left/0000.jpg``, ``right/0000.jpg``, ... of a pair of cameras 0.4 m apart; centres (2 n, 3)."""
    rng = np.random.default_rng(seed)
    caster = RayCaster(paint(build_ruin(rng), rng))
    rays = pixel_rays(true_camera())
    angle = np.radians(18.0) * np.arange(num_frames)
    centers = np.stack([4.0 * np.cos(angle), 4.0 * np.sin(angle), np.full(num_frames, 1.6)], axis=1)
    rotations = look_at(centers, np.tile([0.0, 0.0, 0.45], (num_frames, 1)))
    poses = {"left": (rotations, centers)}
    poses["right"] = (RIGHT @ rotations, centers + np.einsum("kba,b->ka", rotations, RIGHT_CENTER))
    for name, (R, C) in poses.items():
        (folder / name).mkdir(parents=True)
        for k in range(num_frames):
            pixels = photograph(caster, rays, R[k], C[k], np.random.default_rng(k))
            cv2.imwrite(str(folder / name / f"{k:04d}.jpg"), pixels)
    return np.concatenate([poses["left"][1], poses["right"][1]])
