"""Share intrinsics between images with the same initial calibration.

COLMAP gives each image without EXIF data its own camera, and most images have too few observations to calibrate one.
While a model is built such images share a camera, in a copy of the database; the finished model has the database's own
cameras again, with equal parameters.
"""

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap

from colmap_vg.colmap_io.loading import loaded_reconstruction
from colmap_vg.scene.view_graph import ViewGraph


def shared_cameras(graph: ViewGraph) -> list[list[int]]:
    """Groups of ids of two or more cameras with the same focal length."""
    if graph.camera_ids is None or graph.camera_focal_lengths is None:
        return []
    focals, group = np.unique(graph.camera_focal_lengths, return_inverse=True)
    members = [graph.camera_ids[group == g].tolist() for g in range(len(focals))]
    return [ids for ids in members if len(ids) > 1]


def merge_cameras(database_path: Path, groups: Sequence[Sequence[int]]) -> dict[int, int]:
    """Merge the cameras of each group that have the same model, size and parameters.

    Parameters
    ----------
    database_path : Path
        A copy of a database, with the current schema; modified in place.
    groups : sequence of sequence of int
        Camera ids.

    Returns
    -------
    dict of int to int
        For the id of each camera that was removed, the id of the camera that its images use now.
    """
    replaced: dict[int, int] = {}
    with closing(sqlite3.connect(database_path)) as connection, connection:
        rows = connection.execute("SELECT camera_id, model, width, height, params FROM cameras").fetchall()
        # Databases with older schemas have no rigs; pycolmap creates them on loading.
        rig_of = dict(connection.execute("SELECT ref_sensor_id, rig_id FROM rigs").fetchall())
        kind = {row[0]: (*row[1:], row[0] in rig_of) for row in rows}
        for ids in groups:
            firsts: dict[object, int] = {}
            for camera_id in sorted(ids):
                first = firsts.setdefault(kind[camera_id], camera_id)
                if first != camera_id:
                    replaced[camera_id] = first
        for old, new in replaced.items():
            connection.execute("UPDATE images SET camera_id = ? WHERE camera_id = ?", (new, old))
            connection.execute("UPDATE frame_data SET sensor_id = ? WHERE sensor_id = ?", (new, old))
            if old in rig_of:
                connection.execute("UPDATE frames SET rig_id = ? WHERE rig_id = ?", (rig_of[new], rig_of[old]))
                connection.execute("DELETE FROM rigs WHERE rig_id = ?", (rig_of[old],))
            connection.execute("DELETE FROM cameras WHERE camera_id = ?", (old,))
    return replaced


def with_database_cameras(
    cache: "pycolmap.DatabaseCache", model: "pycolmap.Reconstruction", replaced: dict[int, int]
) -> "pycolmap.Reconstruction":
    """Copy a model, with the database's own cameras in place of shared ones.

    Parameters
    ----------
    cache : pycolmap.DatabaseCache
        Of the database, without merged cameras.
    model : pycolmap.Reconstruction
        With shared cameras.
    replaced : dict of int to int
        From `merge_cameras`.

    Returns
    -------
    pycolmap.Reconstruction
    """
    own = loaded_reconstruction(cache)
    for camera_id, camera in own.cameras.items():
        shared = replaced.get(camera_id, camera_id)
        if model.exists_camera(shared):
            camera.params = model.camera(shared).params.tolist()
    for image_id in sorted(model.reg_image_ids()):
        image = own.image(image_id)
        own.frame(image.frame_id).set_cam_from_world(image.camera_id, model.image(image_id).cam_from_world())
        own.register_frame(image.frame_id)
    for point_id in sorted(model.point3D_ids()):
        point = model.point3D(point_id)
        own.add_point3D(np.asarray(point.xyz), point.track, np.asarray(point.color))
    own.update_point_3d_errors()
    return own
