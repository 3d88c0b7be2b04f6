"""Small COLMAP databases with known truth, and ways of changing and damaging copies of them."""

import hashlib
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap

MAX_NUM_IMAGES = 2_147_483_647
PINHOLE = ("SIMPLE_PINHOLE", (1280.0, 512.0, 384.0))


def make_database(
    path: Path,
    num_images: int = 10,
    num_points: int = 200,
    noise_px: float = 0.0,
    camera: tuple[str, tuple[float, ...]] = PINHOLE,
    has_prior_focal_length: bool = True,
    num_cameras_per_rig: int = 1,
    camera_per_image: bool = False,
    stored_poses: bool = False,
    seed: int = 1,
) -> pycolmap.Reconstruction:
    """Images around a cloud of points, all pairs matched and verified; the truth is returned."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=num_images if camera_per_image else 1,
        num_cameras_per_rig=num_cameras_per_rig,
        num_frames_per_rig=1 if camera_per_image else num_images // num_cameras_per_rig,
        num_points3D=num_points,
        camera_model_id=getattr(pycolmap.CameraModelId, camera[0]),
        camera_params=list(camera[1]),
        camera_has_prior_focal_length=has_prior_focal_length,
        two_view_geometry_has_relative_pose=stored_poses,
    )
    with pycolmap.Database.open(path) as database:
        truth = pycolmap.synthesize_dataset(options, database)
        if noise_px > 0:
            pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=noise_px), truth, database)
    return truth


def changed_copy(path: Path, target: Path, *statements: str | tuple[str, tuple[object, ...]]) -> Path:
    """A copy of a database after SQL statements."""
    shutil.copyfile(path, target)
    with closing(sqlite3.connect(target)) as connection:
        for statement in statements:
            sql, values = (statement, ()) if isinstance(statement, str) else statement
            connection.execute(sql, values)
        connection.commit()
    return target


def pair_id(image_id1: int, image_id2: int) -> int:
    """COLMAP's id of a pair."""
    return image_id1 * MAX_NUM_IMAGES + image_id2


def sha256(path: Path) -> str:
    """Fingerprint of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def centers(model: pycolmap.Reconstruction, image_ids: list[int]) -> np.ndarray:
    """Projection centres (n, 3) of images."""
    return np.array([model.image(i).projection_center() for i in image_ids])


def relative_pose(model: pycolmap.Reconstruction, image_id1: int, image_id2: int) -> tuple[np.ndarray, np.ndarray]:
    """cam2_from_cam1 rotation (3, 3), and the unit direction from camera 1 to camera 2 in camera 1's frame."""
    pose1, pose2 = model.image(image_id1).cam_from_world(), model.image(image_id2).cam_from_world()
    R1, R2 = pose1.rotation.matrix(), pose2.rotation.matrix()
    direction = R1 @ (model.image(image_id2).projection_center() - model.image(image_id1).projection_center())
    return R2 @ R1.T, direction / np.linalg.norm(direction)


def angle(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Angles between rotations (m, 3, 3) or unit vectors (m, 3), radians, exact for small ones."""
    if A.ndim == 3:
        return 2 * np.arcsin(np.minimum(np.linalg.norm(A - B, axis=(1, 2)) / np.sqrt(8), 1.0))
    return 2 * np.arcsin(np.minimum(np.linalg.norm(A - B, axis=1) / 2, 1.0))


def with_other_ids(path: Path, target: Path) -> Path:
    """A copy with image ids 1003, 1006, ... and camera ids 51, 52, ... in place of 1, 2, ..."""
    image, camera = "{0} = 1000 + 3 * {0}", "{0} = 50 + {0}"
    pair = f"pair_id = pair_id + {pair_id(1000, 1000)} + 2 * pair_id"  # pair ids are linear in the image ids
    return changed_copy(
        path,
        target,
        "PRAGMA foreign_keys = OFF",
        f"UPDATE images SET {image.format('image_id')}, {camera.format('camera_id')}",
        f"UPDATE keypoints SET {image.format('image_id')}",
        f"UPDATE descriptors SET {image.format('image_id')}",
        f"UPDATE matches SET {pair}",
        f"UPDATE two_view_geometries SET {pair}",
        f"UPDATE cameras SET {camera.format('camera_id')}",
        f"UPDATE rigs SET {camera.format('ref_sensor_id')}",
        f"UPDATE frame_data SET {image.format('data_id')}, {camera.format('sensor_id')}",
    )


def write_views(
    path: Path,
    poses: list[pycolmap.Rigid3d],
    points: np.ndarray,
    config: int,
    noise_px: float = 0.0,
    has_prior_focal_length: bool = True,
    seed: int = 0,
) -> pycolmap.Camera:
    """A database of given cameras (cam_from_world) that all see the same points, without matrices or stored poses."""
    rng = np.random.default_rng(seed)
    camera = pycolmap.Camera(
        camera_id=1,
        model="SIMPLE_PINHOLE",
        width=1024,
        height=768,
        params=[1280.0, 512.0, 384.0],
        has_prior_focal_length=has_prior_focal_length,
    )
    matches = np.stack([np.arange(len(points), dtype=np.uint32)] * 2, axis=1)
    with pycolmap.Database.open(path) as database:
        database.write_camera(camera, use_camera_id=True)
        for image_id, pose in enumerate(poses, start=1):
            image = pycolmap.Image(name=f"{image_id:02d}.jpg", camera_id=1, image_id=image_id)
            database.write_image(image, use_image_id=True)
            rays = points @ pose.rotation.matrix().T + pose.translation
            pixels = camera.img_from_cam(rays) + noise_px * rng.normal(size=(len(points), 2))
            database.write_keypoints(image_id, pixels.astype(np.float32))
        for i in range(1, len(poses) + 1):
            for j in range(i + 1, len(poses) + 1):
                geometry = pycolmap.TwoViewGeometry(config=config, inlier_matches=matches)
                database.write_two_view_geometry(i, j, geometry)
    return camera


def look_at(center: np.ndarray, target: np.ndarray) -> pycolmap.Rigid3d:
    """cam_from_world of a camera at a centre, its axis towards a target, its y axis about downwards (world's +y)."""
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross([0.0, 1.0, 0.0], z)
    R = np.stack([x / np.linalg.norm(x), np.cross(z, x / np.linalg.norm(x)), z])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(R), -R @ center)


def two_view_tracks_only(path: Path, image_id: int) -> None:
    """Give an image its own keypoints for each of its pairs, so that no point of it is seen by a third image."""
    with pycolmap.Database.open(path) as database:
        others = [image.image_id for image in database.read_all_images() if image.image_id != image_id]
        keypoints = database.read_keypoints(image_id)
        per_pair = len(keypoints) // len(others)
        for slot, other in enumerate(others):
            i, j = sorted((image_id, other))
            column = 0 if i == image_id else 1
            geometry = database.read_two_view_geometry(i, j)
            matches = geometry.inlier_matches
            own = np.arange(slot * per_pair, (slot + 1) * per_pair)
            geometry.inlier_matches = matches[np.isin(matches[:, column], own)]
            database.update_two_view_geometry(i, j, geometry)
            # What the other image's keypoint shares with third images is cut as well.
            used = geometry.inlier_matches[:, 1 - column]
            for third in others:
                if third != other:
                    a, b = sorted((other, third))
                    pair = database.read_two_view_geometry(a, b)
                    keep = ~np.isin(pair.inlier_matches[:, 0 if a == other else 1], used)
                    pair.inlier_matches = pair.inlier_matches[keep]
                    database.update_two_view_geometry(a, b, pair)


DAMAGES: dict[str, tuple[list[str | tuple[str, tuple[object, ...]]], tuple[str, ...]]] = {
    "keypoints cut off": (["UPDATE keypoints SET data = x'00' WHERE image_id = 2"], ("keypoints of image 2",)),
    "keypoints of wrong length": (
        ["UPDATE keypoints SET data = zeroblob(80) WHERE image_id = 2"],
        ("keypoints of image 2", "20 values"),
    ),
    "keypoints' rows are text": (["UPDATE keypoints SET rows = 'many' WHERE image_id = 3"], ("keypoints of image 3",)),
    "keypoints with one column": (
        ["UPDATE keypoints SET cols = 1, rows = rows * cols WHERE image_id = 3"],
        ("keypoints of image 3", "single coordinate"),
    ),
    "keypoint is NaN": (
        [
            (
                "UPDATE keypoints SET data = CAST(? || zeroblob(length(data) - 4) AS BLOB) WHERE image_id = 3",
                (b"\x00\x00\xc0\x7f",),
            )
        ],
        ("keypoints of image 3", "NaN"),
    ),
    "keypoints gone": (["DELETE FROM keypoints WHERE image_id = 3"], ("images 1 and 3", "keypoints")),
    "matches of wrong length": (
        [f"UPDATE two_view_geometries SET data = zeroblob(12) WHERE pair_id = {pair_id(1, 4)}"],
        ("images 1 and 4", "3 values"),
    ),
    "matches cut off": (
        [f"UPDATE two_view_geometries SET data = zeroblob(11) WHERE pair_id = {pair_id(1, 4)}"],
        ("images 1 and 4",),
    ),
    "matches are null": (
        [f"UPDATE two_view_geometries SET data = NULL WHERE pair_id = {pair_id(1, 4)}"],
        ("images 1 and 4",),
    ),
    "matches with four columns": (
        [f"UPDATE two_view_geometries SET cols = 4, data = CAST(data || data AS BLOB) WHERE pair_id = {pair_id(1, 4)}"],
        ("images 1 and 4", "4 columns"),
    ),
    "match out of range": (
        [
            f"UPDATE two_view_geometries SET data = CAST(zeroblob(length(data) - 4) || x'ffffff00' AS BLOB)"
            f" WHERE pair_id = {pair_id(2, 3)}"
        ],
        ("images 2 and 3", "16777215"),
    ),
    "configuration is text": (
        [f"UPDATE two_view_geometries SET config = 'good' WHERE pair_id = {pair_id(2, 3)}"],
        ("images 2 and 3", "good"),
    ),
    "self pair": (
        [f"UPDATE two_view_geometries SET pair_id = {pair_id(4, 4)} WHERE pair_id = {pair_id(1, 4)}"],
        ("images 4 and 4", "itself"),
    ),
    "pair in the wrong order": (
        [f"UPDATE two_view_geometries SET pair_id = {pair_id(4, 1)} WHERE pair_id = {pair_id(1, 4)}"],
        ("images 4 and 1", "order"),
    ),
    "pair of an unknown image": (
        [f"UPDATE two_view_geometries SET pair_id = {pair_id(1, 99)} WHERE pair_id = {pair_id(1, 4)}"],
        ("images 1 and 99", "does not exist"),
    ),
    "negative pair id": (
        [f"UPDATE two_view_geometries SET pair_id = -5 WHERE pair_id = {pair_id(1, 4)}"],
        ("does not exist",),
    ),
    "pair twice": (
        [
            "CREATE TABLE copied AS SELECT * FROM two_view_geometries",
            f"INSERT INTO copied SELECT * FROM two_view_geometries WHERE pair_id = {pair_id(1, 4)}",
            "DROP TABLE two_view_geometries",
            "ALTER TABLE copied RENAME TO two_view_geometries",
        ],
        ("images 1 and 4", "twice"),
    ),
    "F of wrong length": (
        [f"UPDATE two_view_geometries SET F = zeroblob(64) WHERE pair_id = {pair_id(1, 2)}"],
        ("F of pair of images 1 and 2", "8 values", "expected 9"),
    ),
    "E cut off": (
        [f"UPDATE two_view_geometries SET E = zeroblob(71) WHERE pair_id = {pair_id(1, 2)}"],
        ("E of pair of images 1 and 2",),
    ),
    "H is text": (
        [f"UPDATE two_view_geometries SET H = 'abc' WHERE pair_id = {pair_id(1, 2)}"],
        ("H of pair of images 1 and 2",),
    ),
    "qvec of wrong length": (
        [f"UPDATE two_view_geometries SET qvec = zeroblob(24) WHERE pair_id = {pair_id(1, 2)}"],
        ("qvec of pair of images 1 and 2", "3 values"),
    ),
    "params of wrong length": (["UPDATE cameras SET params = zeroblob(16)"], ("camera 1", "2 parameters")),
    "params cut off": (["UPDATE cameras SET params = zeroblob(15)"], ("camera 1",)),
    "params are null": (["UPDATE cameras SET params = NULL"], ("camera 1", "0 parameters")),
    "focal is NaN": (
        [("UPDATE cameras SET params = ?", (np.array([np.nan, 512.0, 384.0]).tobytes(),))],
        ("camera 1", "nan"),
    ),
    "focal is negative": (
        [("UPDATE cameras SET params = ?", (np.array([-1280.0, 512.0, 384.0]).tobytes(),))],
        ("camera 1", "-1280"),
    ),
    "camera model unknown": (["UPDATE cameras SET model = 99"], ("camera 1", "model 99")),
    "camera model is text": (["UPDATE cameras SET model = 'PINHOLE?'"], ("camera 1", "PINHOLE?")),
    "camera without size": (["UPDATE cameras SET width = 0"], ("camera 1", "0 x 768")),
    "camera missing": (
        ["PRAGMA foreign_keys = OFF", "UPDATE images SET camera_id = 7 WHERE image_id = 3"],
        ("image 3", "camera 7"),
    ),
    "name is not UTF-8": (
        ["UPDATE images SET name = CAST(x'ff2e706e67' AS TEXT) WHERE image_id = 2"],
        ("image 2", "UTF-8"),
    ),
    "image id is negative": (
        [
            "PRAGMA foreign_keys = OFF",
            "PRAGMA ignore_check_constraints = ON",
            "UPDATE images SET image_id = -3 WHERE image_id = 3",
        ],
        ("image -3", "its id"),
    ),
    "camera id is too large": (
        ["PRAGMA foreign_keys = OFF", "UPDATE cameras SET camera_id = 4294967296"],
        ("camera 4294967296", "its id"),
    ),
    "pair id is text": (
        [
            "CREATE TABLE copied AS SELECT * FROM two_view_geometries",
            f"UPDATE copied SET pair_id = 'one' WHERE pair_id = {pair_id(1, 4)}",
            "DROP TABLE two_view_geometries",
            "ALTER TABLE copied RENAME TO two_view_geometries",
        ],
        ("'one'",),
    ),
    "image twice": (
        [
            "CREATE TABLE copied AS SELECT * FROM images",
            "INSERT INTO copied SELECT * FROM images WHERE image_id = 2",
            "DROP TABLE images",
            "ALTER TABLE copied RENAME TO images",
        ],
        ("image 2", "twice"),
    ),
    "name twice": (
        [
            "CREATE TABLE copied AS SELECT * FROM images",
            "DROP TABLE images",
            "ALTER TABLE copied RENAME TO images",
            "UPDATE images SET name = 'same.jpg' WHERE image_id < 3",
        ],
        ("'same.jpg'", "several images"),
    ),
    "keypoints far outside": (
        [("UPDATE keypoints SET data = CAST(? || substr(data, 5) AS BLOB) WHERE image_id = 3", (b"\xec\x78\xad\x60",))],
        ("keypoints of image 3", "1e+20 pixels"),
    ),
    "camera of absurd size": (["UPDATE cameras SET width = 4611686018427387904"], ("camera 1", "its size")),
    "one of two focal lengths is zero": (
        [("UPDATE cameras SET model = 1, params = ?", (np.array([0.0, 1280.0, 512.0, 384.0]).tobytes(),))],
        ("camera 1", "focal length"),
    ),
    "principal point is huge": (
        [("UPDATE cameras SET params = ?", (np.array([1280.0, 1e300, 384.0]).tobytes(),))],
        ("camera 1", "1e+300"),
    ),
    "name is empty": (["UPDATE images SET name = '' WHERE image_id = 2"], ("image 2", "name")),
}
"""Statements that damage a database of four images or more, and what the error must name."""
