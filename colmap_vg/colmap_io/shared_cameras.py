"""One calibration for photographs that start with the same one and show no sign of different lenses.

COLMAP gives each photograph without EXIF a camera of its own, and most are too weak to calibrate alone. While the
model is built they share one, in a copy of the database; the finished model has the database's own cameras again, with
equal parameters.
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
    """Ids of cameras of one focal length, given or found in common; two or more each."""
    if graph.camera_ids is None or graph.camera_focal_lengths is None:
        return []
    focals, group = np.unique(graph.camera_focal_lengths, return_inverse=True)
    members = [graph.camera_ids[group == g].tolist() for g in range(len(focals))]
    return [ids for ids in members if len(ids) > 1]


def merge_cameras(database_path: Path, groups: Sequence[Sequence[int]]) -> dict[int, int]:
    """Let the images of each group of cameras use one of them, where model, size and parameters agree.

    Parameters
    ----------
    database_path : Path
        A copy, of the current schema; it is changed.
    groups : sequence of sequence of int
        Camera ids.

    Returns
    -------
    dict of int to int
        For each camera that was replaced the one in its place.
    """
    replaced: dict[int, int] = {}
    with closing(sqlite3.connect(database_path)) as connection, connection:
        rows = connection.execute("SELECT camera_id, model, width, height, params FROM cameras").fetchall()
        # Databases of older schemas have no rigs, and pycolmap makes them when it loads one.
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


def with_own_cameras(
    cache: "pycolmap.DatabaseCache", model: "pycolmap.Reconstruction", replaced: dict[int, int]
) -> "pycolmap.Reconstruction":
    """The model on the database's own cameras.

    Parameters
    ----------
    cache : pycolmap.DatabaseCache
        Of the unchanged database.
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
