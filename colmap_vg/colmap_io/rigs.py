"""Read the rigs of a COLMAP database, and give a reconstruction their poses."""

import sqlite3
from contextlib import closing
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from colmap_vg.colmap_io.database import CAMERA_SENSOR, reading
from colmap_vg.errors import DatabaseError
from colmap_vg.geometry import so3
from colmap_vg.scene.rigs import Rigs

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


def read_rigs(database_path: str | PathLike[str], image_ids: IntArray) -> Rigs | None:
    """Read the rigs, sensors and frames of a database.

    Parameters
    ----------
    database_path : path
    image_ids : (n,) int64 array

    Returns
    -------
    Rigs or None
        None where no rig has two cameras or more, and for databases of older schemas.

    Raises
    ------
    DatabaseError
        An image has no frame, or its camera is not in its frame's rig.
    """
    with reading(database_path) as connection:
        if not _has_rigs(connection):
            return None
        sensors = connection.execute(
            f"SELECT rig_id, ref_sensor_id, 1, NULL FROM rigs WHERE ref_sensor_type = {CAMERA_SENSOR} UNION ALL"
            " SELECT rig_id, sensor_id, 0, sensor_from_rig FROM rig_sensors"
            f" WHERE sensor_type = {CAMERA_SENSOR} ORDER BY 1, 3 DESC, 2"
        ).fetchall()
        frames = connection.execute("SELECT frame_id, rig_id FROM frames ORDER BY frame_id").fetchall()
        images = connection.execute(
            f"SELECT data_id, frame_id, sensor_id FROM frame_data WHERE sensor_type = {CAMERA_SENSOR} ORDER BY data_id"
        ).fetchall()
    rig_of_frame = dict(frames)
    row_of_frame = {frame: row for row, (frame, _) in enumerate(frames)}
    row_of_sensor = {(rig, camera): row for row, (rig, camera, _, _) in enumerate(sensors)}
    place = {
        image: (row_of_frame.get(frame, -1), row_of_sensor.get((rig_of_frame.get(frame), camera), -1))
        for image, frame, camera in images
    }
    rows = np.array([place.get(int(i), (-1, -1)) for i in image_ids], dtype=np.int64).reshape(-1, 2)
    lost = np.flatnonzero((rows < 0).any(axis=1))
    if len(lost):
        raise DatabaseError(
            f"{database_path}: image {image_ids[lost[0]]} is in no frame of a rig with its camera; configure the rigs"
            " again (colmap rig_configurator)"
        )
    reference = np.array([bool(sensor[2]) for sensor in sensors], dtype=bool)
    poses = [_pose(blob, f"{database_path}: sensor {camera} of rig {rig}") for rig, camera, _, blob in sensors]
    rotations, translations = np.array([R for R, _ in poses]), np.array([t for _, t in poses])
    rotations[reference], translations[reference] = np.eye(3), 0.0
    return Rigs(
        frame_idx=rows[:, 0],
        sensor_idx=rows[:, 1],
        frame_ids=np.array([frame for frame, _ in frames], dtype=np.int64),
        rig_ids=np.array([sensor[0] for sensor in sensors], dtype=np.int64),
        camera_ids=np.array([sensor[1] for sensor in sensors], dtype=np.int64),
        rotations=rotations,
        translations=translations,
        reference=reference,
    )


def store_separated(database_path: str | PathLike[str], image_ids: IntArray, rigs: Rigs) -> None:
    """Make the separated sensors of a database rigs of their own, with a frame for each image.

    Parameters
    ----------
    database_path : path
        A copy of the database, with the current schema; modified in place.
    image_ids : (n,) int64 array
    rigs : Rigs
    """
    if rigs.separated is None:
        return
    sensors = np.flatnonzero(rigs.separated)
    alone = np.flatnonzero(rigs.separated[rigs.sensor_idx])
    cameras = rigs.camera_ids[sensors].tolist()
    frames = rigs.frame_ids[rigs.frame_idx[alone]].tolist()
    rig_of_frame = rigs.rig_ids[rigs.sensor_idx[alone]].tolist()
    with closing(sqlite3.connect(database_path)) as connection, connection:
        connection.executemany(
            f"DELETE FROM rig_sensors WHERE sensor_type = {CAMERA_SENSOR} AND sensor_id = ?",
            [(camera,) for camera in cameras],
        )
        connection.executemany(
            f"INSERT INTO rigs (rig_id, ref_sensor_id, ref_sensor_type) VALUES (?, ?, {CAMERA_SENSOR})",
            list(zip(rigs.rig_ids[sensors].tolist(), cameras, strict=True)),
        )
        connection.executemany(
            "INSERT INTO frames (frame_id, rig_id) VALUES (?, ?)", list(zip(frames, rig_of_frame, strict=True))
        )
        connection.executemany(
            f"UPDATE frame_data SET frame_id = ? WHERE sensor_type = {CAMERA_SENSOR} AND data_id = ?",
            list(zip(frames, image_ids[alone].tolist(), strict=True)),
        )
        connection.execute("DELETE FROM frames WHERE frame_id NOT IN (SELECT frame_id FROM frame_data)")


def _has_rigs(connection: sqlite3.Connection) -> bool:
    """Whether any rig has two cameras or more."""
    (tables,) = connection.execute("SELECT COUNT(*) FROM sqlite_master WHERE name = 'rig_sensors'").fetchone()
    if tables == 0:  # an older schema
        return False
    (sensors,) = connection.execute(f"SELECT COUNT(*) FROM rig_sensors WHERE sensor_type = {CAMERA_SENSOR}").fetchone()
    return bool(sensors > 0)


def _pose(blob: object, where: str) -> tuple[Array, Array]:
    """Rotation and translation of a stored pose (quaternion w, x, y, z, then translation); NaN where it is missing."""
    if blob is None or blob == b"":
        return np.full((3, 3), np.nan), np.full(3, np.nan)
    if not isinstance(blob, bytes) or len(blob) != 56:
        raise DatabaseError(f"{where}: its pose is damaged; configure the rigs again (colmap rig_configurator)")
    values = np.frombuffer(blob, dtype=np.float64)
    if not np.isfinite(values).all() or not np.linalg.norm(values[:4]) > 0:
        return np.full((3, 3), np.nan), np.full(3, np.nan)
    return so3.from_quaternion(values[[1, 2, 3, 0]][None])[0], values[4:].copy()
